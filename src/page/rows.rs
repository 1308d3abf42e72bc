//! One submission as a line of the page: in the line, running, ended, failed. Pure.
//!
//! Texts that a stranger had a part in are cut to one line of bounded length here, whatever the API server has let in.

use jiff::Timestamp;
use kube::ResourceExt;
use leaderboard_api::text::{one_line, sentence};
use leaderboard_api::{
    Attempt, Failure, Metric, ReasonName, State, Submission, SubmissionStatus, WorkerStatus, conditions, reasons,
};
use serde::Serialize;

use super::phases::Phases;

/// Characters of a name of a stranger, and of a message.
const NAME: usize = 80;
const MESSAGE: usize = 300;

/// Which submission it is.
#[derive(Serialize, Clone, Debug, Default, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub(super) struct Who {
    pub namespace: String,
    pub name: String,
    pub leaderboard: String,
    pub track: Option<String>,
    pub team: Option<String>,
    pub is_check: bool,
}

/// A submission that waits.
#[derive(Serialize, Clone, Debug, PartialEq, Eq)]
pub(super) struct Waits {
    #[serde(flatten)]
    pub who: Who,
    pub position: Option<i32>,
    /// How long it may take, for people.
    pub eta: Option<String>,
    pub reason: Option<String>,
    pub message: String,
    /// In seconds since 1970, as all times of the page.
    pub since: Option<i64>,
}

/// A submission that runs.
#[derive(Serialize, Clone, Debug, PartialEq)]
pub(super) struct Runs {
    #[serde(flatten)]
    pub who: Who,
    pub score: Option<String>,
    #[serde(flatten)]
    pub run: Run,
}

/// The run of a submission.
#[derive(Serialize, Clone, Debug, PartialEq)]
pub(super) struct Run {
    pub attempt: Option<Attempt>,
    pub node: Option<String>,
    pub done: i32,
    pub total: i32,
    /// Name of what is counted.
    pub unit: String,
    /// Numbers and words of closed sets alone.
    pub workers: Vec<WorkerStatus>,
    pub phases: Phases,
}

/// A number with its name.
#[derive(Serialize, Clone, Debug, PartialEq, Eq)]
pub(super) struct Number {
    name: String,
    value: String,
}

/// A submission that has ended.
#[derive(Serialize, Clone, Debug, PartialEq, Eq)]
pub(super) struct Ended {
    #[serde(flatten)]
    pub who: Who,
    pub state: &'static str,
    /// Side that caused the failure.
    pub class: Option<&'static str>,
    pub score: Option<String>,
    /// Where the end has not arrived yet.
    pub open: Vec<&'static str>,
    pub phases: Phases,
}

/// A submission that has failed.
#[derive(Serialize, Clone, Debug, PartialEq, Eq)]
pub(super) struct Failed {
    #[serde(flatten)]
    pub who: Who,
    #[serde(flatten)]
    pub cause: Cause,
    pub time: Option<i64>,
}

/// Why a submission has failed.
#[derive(Serialize, Clone, Debug, PartialEq, Eq)]
pub(super) struct Cause {
    pub class: &'static str,
    pub reason: String,
    pub message: String,
}

/// When it ended.
pub(super) fn end(submission: &Submission) -> Option<Timestamp> {
    let status = submission.status.as_ref()?;
    let condition = || status.condition(conditions::FINISHED).map(|c| c.last_transition_time.0);
    status.times.finished.as_ref().map(|time| time.0).or_else(condition)
}

impl Who {
    fn of(submission: &Submission) -> Self {
        let status = submission.status.as_ref();
        let track = status.and_then(|status| status.track.as_ref());
        Self {
            namespace: submission.namespace().unwrap_or_default(),
            name: submission.name_any(),
            leaderboard: submission.spec.leaderboard_name.clone(),
            track: track.or(submission.spec.track.as_ref()).map(|track| name(track)),
            team: submission.team_name().as_deref().map(name),
            is_check: submission.spec.check,
        }
    }
}

pub(super) fn name(text: &str) -> String {
    one_line(text, NAME)
}

pub(super) fn message(text: &str) -> String {
    one_line(&sentence(text), MESSAGE)
}

/// Reads the status; an empty one before there is any.
fn with_status<T>(submission: &Submission, read: impl FnOnce(&SubmissionStatus) -> T) -> T {
    match &submission.status {
        Some(status) => read(status),
        None => read(&SubmissionStatus::default()),
    }
}

impl Waits {
    pub(super) fn of(submission: &Submission) -> Self {
        let created = submission.metadata.creation_timestamp.as_ref().map(|time| time.0);
        with_status(submission, |status| {
            // The attempt begins with this condition.
            let began = status.condition(conditions::FINISHED);
            let since = began.map(|c| c.last_transition_time.0).or(created);
            let waiting = status.waiting.as_deref();
            let meaning = status.present_reason().as_ref().and_then(ReasonName::known);
            let meaning = meaning.map(|reason| reasons::plain(reason.meaning()));
            let own = status.message.as_deref().unwrap_or_default();
            Self {
                who: Who::of(submission),
                position: waiting.map(|waiting| waiting.position),
                eta: waiting
                    .and_then(leaderboard_api::Waiting::eta)
                    .map(|eta| eta.to_string()),
                reason: status.reason.as_ref().map(|reason| name(reason.as_str())),
                message: match meaning {
                    Some(meaning) if own.is_empty() => message(&meaning),
                    _ => message(own),
                },
                since: since.map(Timestamp::as_second),
            }
        })
    }
}

impl Runs {
    pub(super) fn of(submission: &Submission) -> Self {
        with_status(submission, |status| Self {
            who: Who::of(submission),
            score: status.score.as_ref().map(|score| name(&score.text)),
            run: Run::of(submission, status),
        })
    }
}

impl Run {
    pub(super) fn of(submission: &Submission, status: &SubmissionStatus) -> Self {
        let progress = status.progress.as_ref();
        Self {
            attempt: status.attempt,
            node: status.node_name.as_deref().map(name),
            done: progress.map_or(0, |progress| progress.done),
            total: progress.map_or(0, |progress| progress.total),
            unit: progress.map(|progress| name(&progress.unit)).unwrap_or_default(),
            workers: status.workers.clone(),
            phases: Phases::of(submission),
        }
    }
}

impl Number {
    pub(super) fn new(of: &str, value: &str) -> Self {
        Self {
            name: name(of),
            value: name(value),
        }
    }

    /// The first so many metrics.
    pub(super) fn first(metrics: &[Metric], most: usize) -> Vec<Self> {
        let first = metrics.iter().take(most);
        first.map(|metric| Self::new(&metric.name, &metric.value)).collect()
    }
}

impl Ended {
    pub(super) fn of(submission: &Submission, state: State) -> Self {
        with_status(submission, |status| Self {
            who: Who::of(submission),
            state: state.as_str(),
            class: status.failure.as_ref().map(|failure| failure.class.as_str()),
            score: status.score.as_ref().map(|score| name(&score.text)),
            open: open(status),
            phases: Phases::of(submission),
        })
    }
}

/// The systems that have not got the end yet, and need it.
pub(super) fn open(status: &SubmissionStatus) -> Vec<&'static str> {
    let is_open = |type_: &str| status.condition(type_).is_some() && !status.is_delivered(type_);
    let open = conditions::SYSTEMS.into_iter().filter(|(type_, _)| is_open(type_));
    open.map(|(_, system)| system).collect()
}

impl Failed {
    pub(super) fn of(submission: &Submission, failure: &Failure) -> Self {
        Self {
            who: Who::of(submission),
            cause: Cause::of(failure),
            time: end(submission).map(Timestamp::as_second),
        }
    }
}

impl Cause {
    pub(super) fn of(failure: &Failure) -> Self {
        Self {
            class: failure.class.as_str(),
            reason: name(failure.reason.as_str()),
            message: message(&failure.message),
        }
    }
}
