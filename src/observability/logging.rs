//! How the process logs: JSON lines for machines, plain text for a person's terminal, both on standard error.
//!
//! Called once by `main`; everybody else uses `tracing`. Standard output belongs to what a subcommand prints.

use std::io::IsTerminal;

use tracing::Subscriber;
use tracing_subscriber::EnvFilter;
use tracing_subscriber::filter::ParseError;
use tracing_subscriber::fmt::MakeWriter;
use tracing_subscriber::fmt::format::JsonFields;
use tracing_subscriber::util::SubscriberInitExt;

use super::json_lines::JsonLines;

/// The default filter. It drops warnings of libraries that this program repeats as sentences.
const DEFAULT_FILTER: &str = "info,kube_client=warn,kube_runtime=error,aws_config=warn,aws_smithy_runtime=warn,hyper=warn,hyper_util=warn,tower=warn,rustls=warn";

/// The format of a line.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Format {
    /// Text on a terminal, else JSON.
    #[default]
    Auto,
    /// One JSON object a line.
    Json,
    /// For people.
    Text,
}

/// Why logging could not be set up.
#[derive(Debug, thiserror::Error)]
pub enum LoggingError {
    #[error("the log filter {filter:?} can't be read: {source}; write for example info,leaderboard=debug")]
    Filter { filter: String, source: ParseError },
    #[error("logging was set up twice in this process")]
    Twice,
}

/// Logs to standard error from here on.
///
/// # Errors
/// If the filter cannot be read, or the process logs already.
pub fn init(format: Format, filter: Option<&str>) -> Result<(), LoggingError> {
    let subscriber = subscriber(format, filter, std::io::stderr, std::io::stderr().is_terminal())?;
    subscriber.try_init().map_err(|_| LoggingError::Twice)
}

/// Writes lines in this format.
///
/// # Errors
/// If the filter cannot be read.
pub fn subscriber<W>(
    format: Format,
    filter: Option<&str>,
    writer: W,
    is_terminal: bool,
) -> Result<Box<dyn Subscriber + Send + Sync>, LoggingError>
where
    W: for<'a> MakeWriter<'a> + Send + Sync + 'static,
{
    let text = filter.filter(|f| !f.trim().is_empty()).unwrap_or(DEFAULT_FILTER);
    let unreadable = |source| LoggingError::Filter {
        filter: text.to_owned(),
        source,
    };
    let filter = EnvFilter::try_new(text).map_err(unreadable)?;
    let base = tracing_subscriber::fmt().with_env_filter(filter).with_writer(writer);
    let is_text = format == Format::Text || (format == Format::Auto && is_terminal);
    if is_text {
        return Ok(Box::new(base.with_ansi(is_terminal).finish()));
    }
    let json = base.fmt_fields(JsonFields::new()).event_format(JsonLines);
    Ok(Box::new(json.finish()))
}

#[cfg(test)]
pub(crate) mod tests;
