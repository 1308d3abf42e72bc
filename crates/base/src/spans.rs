//! The fields that all log lines about one submission share: its name, its Leaderboard, its attempt and its trace.
//!
//! A reconcile runs in a span with these fields. It hands work to another task with [`LogSpan`], so that the lines of that task
//! have them too.

use std::fmt;
use std::sync::Arc;

use tracing::Span;
use tracing::field::Empty;

use super::trace_id::TraceId;

/// The span of a submission whose object may not be there yet. `submission` is `namespace/name`. Its attempt and its trace follow by [`identify`].
pub fn incoming(submission: impl fmt::Display, leaderboard: &str) -> Span {
    tracing::error_span!("submission", %submission, leaderboard, attempt = Empty, trace_id = Empty)
}

/// Adds what the object shows to the span of [`incoming`] that is current.
pub fn identify(attempt: i64, uid: &str) {
    let span = Span::current();
    if !span.is_disabled() {
        span.record("attempt", attempt);
        span.record("trace_id", tracing::field::display(TraceId::of(uid)));
    }
}

/// The span of a submission, for the task that does what was asked for it. Two pieces of work that differ in it alone are the same.
///
/// Work may wait for hours, so this is what the span is made of: a span takes several times as much as long as it lives.
#[derive(Clone, Default)]
pub struct LogSpan(Option<Arc<Fields>>);

struct Fields {
    submission: Box<str>,
    leaderboard: Box<str>,
    attempt: i64,
    uid: Box<str>,
}

impl LogSpan {
    /// Span of a submission that has an object. `submission` is `namespace/name`.
    pub fn of(submission: impl fmt::Display, leaderboard: &str, attempt: i64, uid: &str) -> Self {
        Self(Some(Arc::new(Fields {
            submission: submission.to_string().into(),
            leaderboard: leaderboard.into(),
            attempt,
            uid: uid.into(),
        })))
    }

    /// To be entered for the work's lines. It has level ERROR: a filter that lets an error through lets its fields through as well.
    pub fn span(&self) -> Span {
        let Some(of) = &self.0 else { return Span::none() };
        tracing::error_span!(
            "submission",
            submission = %of.submission,
            leaderboard = &*of.leaderboard,
            attempt = of.attempt,
            trace_id = %TraceId::of(&of.uid)
        )
    }
}

impl PartialEq for LogSpan {
    fn eq(&self, _: &Self) -> bool {
        true
    }
}

impl Eq for LogSpan {}

impl fmt::Debug for LogSpan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("LogSpan")
    }
}
