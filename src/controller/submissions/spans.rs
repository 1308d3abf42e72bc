//! The spans of phases that are over. Pure.
//!
//! A trace has one root, the intake, and below it an attempt for each that the submission had, with the phases of that attempt. What
//! other systems take after the end of an attempt is below the root. No attribute holds a text that a participant has chosen.

use sha2::{Digest, Sha256};

use super::phases::{Ended, Phase, restarted};
use super::view::View;
use crate::controller::objects::uid_of;
use crate::observability::trace_id::TraceId;
use crate::observability::traces::{Kind, Span, Value};
use leaderboard_api::{Submission, SubmissionStatus, names, reasons};

/// The spans of what has ended with `new`.
pub fn of(view: &View, new: &SubmissionStatus, ended: &[Ended]) -> Vec<Span> {
    let submission = &view.submission;
    let new = restarted(view, new).unwrap_or(new);
    let uid = uid_of(submission.as_ref());
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
        let mut attributes = common(submission, new);
        attributes.extend(particular(view, new, one.phase));
        Span {
            trace: TraceId::of(&uid),
            id: own,
            parent,
            name: one.phase.as_str(),
            kind: kind(submission, one.phase),
            start: one.start,
            end: one.end,
            attributes,
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

fn common(submission: &Submission, new: &SubmissionStatus) -> Vec<(&'static str, Value)> {
    let meta = &submission.metadata;
    let text = |text: Option<&str>| Value::Text(text.unwrap_or_default().to_owned());
    vec![
        ("k8s.namespace.name", text(meta.namespace.as_deref())),
        ("leaderboard.name", text(Some(&submission.spec.leaderboard_name))),
        ("leaderboard.submission", text(meta.name.as_deref())),
        ("leaderboard.attempt", Value::Number(new.attempt.unwrap_or_default().0)),
    ]
}

/// What is worth knowing of one phase.
fn particular(view: &View, new: &SubmissionStatus, phase: Phase) -> Vec<(&'static str, Value)> {
    let old = view.submission.status.as_ref();
    match phase {
        Phase::Intake => view.submission.spec.evalai.map_or_else(Vec::new, |evalai| {
            vec![
                ("evalai.challenge", Value::Number(evalai.challenge)),
                ("evalai.phase", Value::Number(evalai.phase)),
                ("evalai.submission", Value::Number(evalai.submission)),
            ]
        }),
        Phase::Attempt => of_attempt(new),
        Phase::Schedule | Phase::Start | Phase::Run => {
            let job = old.filter(|old| old.attempt == new.attempt).unwrap_or(new).job_number();
            let job = names::job(view.submission.metadata.name.as_deref().unwrap_or_default(), job);
            let node = [Some(new), old]
                .into_iter()
                .flatten()
                .find_map(|of| of.node_name.clone());
            let node = node.map(|node| ("k8s.node.name", Value::Text(node)));
            let mut found = vec![("k8s.job.name", Value::Text(job))];
            found.extend(node);
            found
        }
        Phase::Accept | Phase::Wait | Phase::Archive | Phase::Record | Phase::Publish => Vec::new(),
    }
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
    Some(reasons::of(&failure.reason).map_or("Other", |reason| reason.name))
}
