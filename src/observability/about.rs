//! What all log lines about one submission share: a span with its name, its Leaderboard, its attempt and its trace.
//!
//! A reconcile runs in such a span. What it hands to another task, it hands over with [`LogSpan`], so that the lines of that task
//! have the same fields.

use std::fmt;
use std::sync::Arc;

use tracing::Span;
use tracing::field::Empty;

use super::trace_id::TraceId;
use leaderboard_api::Attempt;

/// The span of a submission that has an object. `submission` is `namespace/name`.
///
/// Of the level ERROR: a filter that lets an error through lets its fields through as well.
pub fn submission(submission: impl fmt::Display, leaderboard: &str, attempt: Attempt, uid: &str) -> Span {
    tracing::error_span!(
        "submission",
        %submission,
        leaderboard,
        attempt = attempt.0,
        trace_id = %TraceId::of(uid)
    )
}

/// The span of a submission whose object may not be there yet. Its attempt and its trace follow by [`identify`].
pub fn incoming(submission: impl fmt::Display, leaderboard: &str) -> Span {
    tracing::error_span!("submission", %submission, leaderboard, attempt = Empty, trace_id = Empty)
}

/// Adds what the object shows to the span of [`incoming`] that is current.
pub fn identify(attempt: Attempt, uid: &str) {
    let span = Span::current();
    if !span.is_disabled() {
        span.record("attempt", attempt.0);
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
    attempt: Attempt,
    uid: Box<str>,
}

impl LogSpan {
    /// That of [`submission`].
    pub fn of(submission: impl fmt::Display, leaderboard: &str, attempt: Attempt, uid: &str) -> Self {
        Self(Some(Arc::new(Fields {
            submission: submission.to_string().into(),
            leaderboard: leaderboard.into(),
            attempt,
            uid: uid.into(),
        })))
    }

    /// To be entered for the work's lines.
    pub fn span(&self) -> Span {
        self.0.as_deref().map_or_else(Span::none, |fields| {
            let Fields {
                submission: name,
                leaderboard,
                attempt,
                uid,
            } = fields;
            submission(name, leaderboard, *attempt, uid)
        })
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

#[cfg(test)]
mod tests {
    use super::super::logging::tests::Lines;
    use super::*;

    #[test]
    fn work_of_another_task_logs_with_the_fields_of_who_asked_for_it() {
        let lines = Lines::default();
        let _guard = lines.collect();
        let log = LogSpan::of("ns/one", "carla", Attempt(2), "uid");
        tracing::warn!("nothing is known");
        log.span().in_scope(|| tracing::warn!(why = "slow", "late"));
        let found = lines.take_json();
        assert_eq!(found.len(), 2);
        assert_eq!(found[0].get("submission"), None);
        let fields = ["submission", "leaderboard", "attempt", "trace_id", "why", "message"].map(|name| &found[1][name]);
        let trace = TraceId::of("uid").to_string();
        let expected = serde_json::json!(["ns/one", "carla", 2, trace, "slow", "late"]);
        assert_eq!(serde_json::json!(fields), expected);
    }

    #[test]
    fn what_comes_in_is_identified_once_its_object_is_known() {
        let lines = Lines::default();
        let _guard = lines.collect();
        incoming("ns/one", "carla").in_scope(|| {
            tracing::info!("before");
            identify(Attempt(3), "uid");
            tracing::info!("after");
        });
        let found = lines.take_json();
        assert_eq!((found[0].get("attempt"), found[0].get("trace_id")), (None, None));
        assert_eq!(found[0]["submission"], "ns/one");
        assert_eq!(
            (&found[1]["attempt"], &found[1]["submission"]),
            (&3.into(), &"ns/one".into())
        );
        assert_eq!(found[1]["trace_id"], TraceId::of("uid").to_string());
    }
}
