//! The spans of phases that are over. Pure.
//!
//! A trace has one root, the intake. Below it is an attempt for each that the submission had, with the phases of that attempt. The time
//! that other systems take after the end of an attempt is below the root. No attribute holds a text that a participant has chosen.

use sha2::{Digest, Sha256};

use crate::observability::traces::{Kind, Span, Value};
use crate::runtime::objects::uid_of;
use leaderboard_api::{Submission, SubmissionStatus, names};
use leaderboard_base::trace_id::TraceId;
use leaderboard_policy::phases::{Ended, Phase, restarted};

/// The spans of what has ended with `new`.
pub fn of(submission: &Submission, new: &SubmissionStatus, ended: &[Ended]) -> Vec<Span> {
    let new = restarted(submission, new).unwrap_or(new);
    let uid = uid_of(submission);
    let root = id(&uid, Phase::Intake, 0);
    let attempt = new.attempt.unwrap_or_default();
    let of_attempt = id(&uid, Phase::Attempt, attempt.0);
    let span = |one: &Ended| {
        let (own, parent) = match one.phase {
            Phase::Intake => (root, None),
            Phase::Attempt => (of_attempt, Some(root)),
            Phase::Record | Phase::Publish => (leaf(&uid, one), Some(root)),
            _ => (leaf(&uid, one), Some(of_attempt)),
        };
        Span {
            trace: TraceId::of(&uid),
            id: own,
            parent,
            name: one.phase.as_str(),
            kind: kind(submission, one.phase),
            start: one.start,
            end: one.end,
            attributes: attributes(submission, new, one.phase),
            error: failed(new, one.phase),
        }
    };
    ended.iter().map(span).collect()
}

fn id(uid: &str, phase: Phase, number: i64) -> u64 {
    let digest = Sha256::digest(format!("{uid}/{}/{number}", phase.as_str()));
    u64::from_be_bytes(std::array::from_fn(|at| digest[at]))
}

/// Phases that come more than once differ by their beginning.
fn leaf(uid: &str, ended: &Ended) -> u64 {
    id(uid, ended.phase, ended.start.as_millisecond())
}

fn kind(submission: &Submission, phase: Phase) -> Kind {
    match phase {
        Phase::Intake if submission.spec.evalai.is_some() => Kind::Consumer,
        Phase::Record | Phase::Publish => Kind::Client,
        _ => Kind::Internal,
    }
}

/// Attributes of a phase: those that all phases have, and its own.
fn attributes(submission: &Submission, new: &SubmissionStatus, phase: Phase) -> Vec<(&'static str, Value)> {
    let (meta, old) = (&submission.metadata, submission.status.as_ref());
    let name = meta.name.as_deref().unwrap_or_default();
    let namespace = meta.namespace.as_deref().unwrap_or_default();
    let text = |text: &str| Value::Text(text.to_owned());
    let mut found = vec![
        ("k8s.namespace.name", text(namespace)),
        ("leaderboard.name", text(&submission.spec.leaderboard_name)),
        ("leaderboard.submission", text(name)),
        ("leaderboard.attempt", Value::Number(new.attempt.unwrap_or_default().0)),
    ];
    match phase {
        Phase::Intake => found.extend(submission.spec.evalai.into_iter().flat_map(|evalai| {
            [
                ("evalai.challenge", Value::Number(evalai.challenge)),
                ("evalai.phase", Value::Number(evalai.phase)),
                ("evalai.submission", Value::Number(evalai.submission)),
            ]
        })),
        Phase::Attempt => found.extend(of_attempt(new)),
        Phase::Schedule | Phase::Start | Phase::Run => {
            let job = old.filter(|old| old.attempt == new.attempt).unwrap_or(new).job_number();
            found.push(("k8s.job.name", Value::Text(names::job(name, job))));
            let mut nodes = [Some(new), old].into_iter().flatten();
            let node = nodes.find_map(|of| of.node_name.as_deref());
            found.extend(node.map(|node| ("k8s.node.name", text(node))));
        }
        Phase::Accept | Phase::Wait | Phase::Archive | Phase::Record | Phase::Publish => {}
    }
    found
}

fn of_attempt(new: &SubmissionStatus) -> Vec<(&'static str, Value)> {
    let mut found = vec![
        ("leaderboard.state", Value::Word(new.state_of_conditions().as_str())),
        ("leaderboard.retries", Value::Number(new.retry.into())),
    ];
    if let Some(progress) = &new.progress {
        found.push(("leaderboard.done", Value::Number(progress.done.into())));
        found.push(("leaderboard.total", Value::Number(progress.total.into())));
    }
    if let Some(failure) = &new.failure {
        found.push(("leaderboard.failure.class", Value::Word(failure.class.as_str())));
    }
    found
}

/// The reason of an attempt that has failed, of the closed set.
fn failed(new: &SubmissionStatus, phase: Phase) -> Option<&'static str> {
    let failure = new.failure.as_ref().filter(|_| phase == Phase::Attempt)?;
    Some(failure.reason.label())
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;
    use serde_json::{Value as Json, json};

    use super::*;
    use leaderboard_api::{Attempt, Reason};

    fn submission(attempt: i64, status: &Json) -> Submission {
        serde_json::from_value(json!({
            "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Submission",
            "metadata": {"name": "sub", "namespace": "ns", "uid": "uid-1"},
            "spec": {
                "leaderboardName": "carla", "image": "team/agent:1", "attempt": attempt,
                "evalai": {"challenge": 1, "phase": 2, "submission": 3},
            },
            "status": status,
        }))
        .unwrap()
    }

    fn status(fields: Json) -> SubmissionStatus {
        serde_json::from_value(fields).unwrap()
    }

    fn ended(phase: Phase) -> Ended {
        Ended {
            phase,
            start: Timestamp::from_second(10).unwrap(),
            end: Timestamp::from_second(120).unwrap(),
        }
    }

    #[test]
    fn what_a_restart_ends_is_of_the_attempt_before() {
        let old = json!({"attempt": 1, "jobName": "sub-1"});
        let new = status(json!({"attempt": 2, "conditions": [{
            "type": "Finished", "status": "False", "reason": Reason::Replacing, "message": "m",
            "lastTransitionTime": "2026-01-01T00:00:00Z",
        }]}));
        let spans = of(&submission(2, &old), &new, &[ended(Phase::Run), ended(Phase::Attempt)]);
        let attempt = ("leaderboard.attempt", Value::Number(1));
        assert!(spans.iter().all(|span| span.attributes.contains(&attempt)), "{spans:?}");
    }

    #[test]
    fn the_spans_of_a_failed_attempt_are_one_tree_that_names_the_reason() {
        let failed = json!({
            "attempt": 1, "state": "Failed",
            "failure": {"class": "Participant", "reason": Reason::AgentCrashed, "message": "m"},
            "conditions": [{
                "type": "Finished", "status": "True", "reason": Reason::AgentCrashed, "message": "m",
                "lastTransitionTime": "2026-01-01T00:00:00Z",
            }],
        });
        let submission = submission(1, &json!({"attempt": 1}));
        let spans = of(
            &submission,
            &status(failed),
            &[ended(Phase::Run), ended(Phase::Attempt)],
        );
        let [run, attempt] = &spans[..] else {
            panic!("{spans:?}")
        };
        assert_eq!((run.name, run.parent), ("run", Some(attempt.id)));
        assert_eq!((run.error, attempt.error), (None, Some(Reason::AgentCrashed.as_str())));
        assert_eq!(run.trace, TraceId::of("uid-1"));
        for expected in [
            ("leaderboard.state", Value::Word("Failed")),
            ("leaderboard.failure.class", Value::Word("Participant")),
        ] {
            assert!(attempt.attributes.contains(&expected), "{expected:?}");
        }
        let chosen = Value::Text("team/agent:1".into());
        let mut texts = spans.iter().flat_map(|span| &span.attributes);
        assert!(texts.all(|(_, value)| *value != chosen), "a text of the participant");
    }

    #[test]
    fn ids_are_the_same_in_every_process_and_the_intake_is_the_root() {
        let phases = [ended(Phase::Intake), ended(Phase::Accept)];
        let new = status(json!({"attempt": Attempt::FIRST}));
        let spans = of(&submission(1, &Json::Null), &new, &phases);
        assert_eq!(spans, of(&submission(1, &Json::Null), &new, &phases));
        let (intake, accept) = (&spans[0], &spans[1]);
        assert_eq!(
            (intake.name, intake.parent, intake.kind),
            ("intake", None, Kind::Consumer)
        );
        assert_eq!(accept.name, "accept");
        assert!(accept.parent.is_some_and(|parent| parent != intake.id));
        let text = |text: &str| Value::Text(text.to_owned());
        assert!(intake.attributes.contains(&("leaderboard.submission", text("sub"))));
        assert!(intake.attributes.contains(&("leaderboard.attempt", Value::Number(1))));
    }
}
