//! How the process logs: JSON lines for machines, plain text for a person's terminal, both on standard error.
//!
//! Called once by `main`; everybody else uses `tracing`. Standard output belongs to what a subcommand prints.

use std::io::IsTerminal;

use tracing::Subscriber;
use tracing_subscriber::EnvFilter;
use tracing_subscriber::filter::ParseError;
use tracing_subscriber::fmt::MakeWriter;
use tracing_subscriber::util::SubscriberInitExt;

/// What is logged when nothing else is wished. The libraries' own warnings are repeated by us as sentences.
pub const DEFAULT_FILTER: &str = "info,kube_client=warn,kube_runtime=error,aws_config=warn,aws_smithy_runtime=warn,hyper=warn,hyper_util=warn,tower=warn,rustls=warn";

/// How lines look.
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
    #[error("the log filter {filter:?} can't be read: {source}; write for example info,leaderboard_operator=debug")]
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

fn subscriber<W>(
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
    let json = base
        .json()
        .flatten_event(true)
        .with_current_span(false)
        .with_span_list(true);
    Ok(Box::new(json.with_ansi(false).finish()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;
    use std::sync::{Arc, Mutex};

    #[derive(Clone, Default)]
    struct Lines(Arc<Mutex<Vec<u8>>>);

    impl Write for Lines {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            self.0.lock().unwrap().extend_from_slice(bytes);
            Ok(bytes.len())
        }

        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    fn logged(format: Format, filter: Option<&str>, is_terminal: bool) -> String {
        let lines = Lines::default();
        let writer = lines.clone();
        let subscriber = subscriber(format, filter, move || writer.clone(), is_terminal).unwrap();
        tracing::subscriber::with_default(subscriber, || {
            let _span = tracing::info_span!("pass", submission = "submission-7").entered();
            tracing::info!(attempt = 2, "started");
            tracing::debug!("a detail");
        });
        let bytes = lines.0.lock().unwrap().clone();
        String::from_utf8(bytes).unwrap()
    }

    #[test]
    fn json_lines_hold_the_fields_and_the_spans_and_no_escapes() {
        for is_terminal in [true, false] {
            let text = logged(Format::Json, None, is_terminal);
            let line: serde_json::Value = serde_json::from_str(text.trim_end()).unwrap();
            assert_eq!(
                (&line["message"], &line["attempt"], &line["level"]),
                (&"started".into(), &2.into(), &"INFO".into())
            );
            assert_eq!(line["spans"][0]["submission"], "submission-7");
            assert!(!text.contains('\u{1b}'), "{text}");
        }
    }

    #[test]
    fn auto_is_json_unless_a_person_reads_and_colors_are_for_terminals() {
        assert!(logged(Format::Auto, None, false).starts_with('{'));
        let text = logged(Format::Auto, None, true);
        assert!(
            !text.starts_with('{') && text.contains('\u{1b}') && text.contains("submission-7"),
            "{text}"
        );
        assert!(!logged(Format::Text, None, false).contains('\u{1b}'));
    }

    #[test]
    fn the_filter_rules_and_an_unreadable_one_is_refused() {
        assert_eq!(logged(Format::Json, Some("debug"), false).lines().count(), 2);
        assert_eq!(logged(Format::Json, Some("warn"), false), "");
        assert_eq!(logged(Format::Json, Some(" "), false).lines().count(), 1);
        let error = subscriber(Format::Json, Some("info,=="), std::io::sink, false)
            .err()
            .unwrap();
        assert!(error.to_string().contains("info,=="), "{error}");
    }
}
