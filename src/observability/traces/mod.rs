//! One trace for each submission: spans that are over, on their way to a collector.
//!
//! Called by `act`, which hands in a span once its end is stored. Nothing waits for a collector: the queue is bounded, and what does
//! not fit is counted and dropped. Without the feature `otel` nothing is kept and nothing sent.

#[cfg(feature = "otel")]
pub mod otlp;

use jiff::Timestamp;

use leaderboard_base::trace_id::TraceId;

/// A span that is over.
#[derive(Clone, Debug, PartialEq)]
pub struct Span {
    pub trace: TraceId,
    /// Id of the span; each process makes the same id for it.
    pub id: u64,
    /// None: the first of its trace.
    pub parent: Option<u64>,
    pub name: &'static str,
    pub kind: Kind,
    pub start: Timestamp,
    pub end: Timestamp,
    pub attributes: Vec<(&'static str, Value)>,
    /// The reason, if it failed.
    pub error: Option<&'static str>,
}

/// On which side of a request it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    Internal,
    /// It begins with a message.
    Consumer,
    /// Another system does the work.
    Client,
}

/// Value of an attribute. A text is an object's name or of a closed set.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Value {
    Text(String),
    Word(&'static str),
    Number(i64),
}

/// Where spans go; clones are the same. The default keeps none.
#[derive(Clone, Debug, Default)]
pub struct Traces(#[cfg(feature = "otel")] Option<otlp::Outlet>);

impl Traces {
    /// Takes spans, which are made only if somebody wants them.
    pub fn send(&self, spans: impl FnOnce() -> Vec<Span>) {
        #[cfg(feature = "otel")]
        if let Some(outlet) = &self.0 {
            outlet.send(spans());
        }
        #[cfg(not(feature = "otel"))]
        let _ = spans;
    }
}
