//! A line of the log as one JSON object. The fields of this program's spans stand next to those of the event, so that a collector finds
//! a line by any of them. Spans of libraries are a list of their own.

use std::fmt::{self, Debug};

use serde::Serialize;
use serde_json::{Map, Value};
use tracing::field::{Field, Visit};
use tracing::{Event, Subscriber};
use tracing_subscriber::fmt::format::Writer;
use tracing_subscriber::fmt::time::{FormatTime, SystemTime};
use tracing_subscriber::fmt::{FmtContext, FormatEvent, FormatFields, FormattedFields};
use tracing_subscriber::registry::{LookupSpan, Scope, SpanRef};

/// Fields that the crate `log` adds to its events. Only the target is of use.
const OF_LOG: [&str; 4] = ["log.target", "log.module_path", "log.file", "log.line"];

/// See the module's text.
#[derive(Clone, Copy, Debug)]
pub(super) struct JsonLines;

#[derive(Serialize)]
struct Line<'a> {
    timestamp: String,
    level: &'a str,
    #[serde(flatten)]
    fields: Map<String, Value>,
    target: &'a str,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    spans: Vec<Map<String, Value>>,
}

impl<S, N> FormatEvent<S, N> for JsonLines
where
    S: Subscriber + for<'a> LookupSpan<'a>,
    N: for<'a> FormatFields<'a> + 'static,
{
    fn format_event(&self, context: &FmtContext<'_, S, N>, mut writer: Writer<'_>, event: &Event<'_>) -> fmt::Result {
        let (mut fields, mut spans) = (Fields::default(), Vec::new());
        for span in context.event_scope().into_iter().flat_map(Scope::from_root) {
            let mut written = written::<S, N>(&span);
            if is_ours(span.metadata().target()) {
                fields.0.extend(written);
            } else {
                written.insert("name".to_owned(), span.metadata().name().into());
                spans.push(written);
            }
        }
        // The event's own come last: they are newer.
        event.record(&mut fields);
        let [target, ..] = OF_LOG.map(|name| fields.0.remove(name));
        let mut timestamp = String::new();
        SystemTime.format_time(&mut Writer::new(&mut timestamp))?;
        let meta = event.metadata();
        let line = Line {
            timestamp,
            level: meta.level().as_str(),
            fields: fields.0,
            target: target.as_ref().and_then(Value::as_str).unwrap_or(meta.target()),
            spans,
        };
        writer.write_str(&serde_json::to_string(&line).map_err(|_| fmt::Error)?)?;
        writer.write_char('\n')
    }
}

/// A span of one of the operator's own crates: their names begin alike.
fn is_ours(target: &str) -> bool {
    target.starts_with("leaderboard_")
}

/// The fields of a span as they are kept with it, which is JSON text.
fn written<S, N>(span: &SpanRef<'_, S>) -> Map<String, Value>
where
    S: for<'a> LookupSpan<'a>,
    N: for<'a> FormatFields<'a> + 'static,
{
    let extensions = span.extensions();
    let text = extensions.get::<FormattedFields<N>>();
    text.and_then(|text| serde_json::from_str(&text.fields).ok())
        .unwrap_or_default()
}

#[derive(Default)]
struct Fields(Map<String, Value>);

impl Fields {
    fn insert(&mut self, field: &Field, value: impl Into<Value>) {
        self.0.insert(field.name().to_owned(), value.into());
    }
}

impl Visit for Fields {
    fn record_f64(&mut self, field: &Field, value: f64) {
        self.insert(field, value);
    }

    fn record_i64(&mut self, field: &Field, value: i64) {
        self.insert(field, value);
    }

    fn record_u64(&mut self, field: &Field, value: u64) {
        self.insert(field, value);
    }

    fn record_bool(&mut self, field: &Field, value: bool) {
        self.insert(field, value);
    }

    fn record_str(&mut self, field: &Field, value: &str) {
        self.insert(field, value);
    }

    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        self.insert(field, format!("{value:?}"));
    }
}
