//! Creates and bumps Submissions: the only code that does. The bridge calls it for messages, the controller's leader
//! for what its sweep of EvalAI finds.
//!
//! `decide_ingest` is pure and holds all policy. `apply` carries it out and can run twice: names are deterministic, and a bump carries
//! the resourceVersion it was decided on. This module knows no queue, and only the swept rows of EvalAI.

use std::collections::BTreeMap;
use std::time::Duration;

use kube::Api;
use kube::api::{ObjectMeta, Patch, PatchParams, PostParams};
use serde_json::{Value, json};
use thiserror::Error;
use tracing::Span;

use crate::kubernetes::{CallError, call_within};
use leaderboard_api::ingested::SWEEP;
use leaderboard_api::{
    Attempt, EvalaiRef, Ingested, RefusedAttempt, State, Submission, SubmissionSpec, SubmissionStatus, names,
};
use leaderboard_base::spans as about;
use leaderboard_evalai::Swept;
use leaderboard_policy::intake::message::Message;
use leaderboard_policy::intake::route::{NotIngested, Outcome};

/// Age below which the sweep leaves a row alone, in milliseconds: its message may be on the way.
const SWEEP_AGE_MS: i64 = 120_000;

/// Longest time one request to the API server may take.
const CALL_LIMIT: Duration = Duration::from_secs(8);
/// How often a lost race is run again before the caller has to come back later.
const ROUNDS: usize = 6;
/// Most attempts that begin without a message after the last message. EvalAI lets hosts resume; it lets participants resume only if the
/// challenge has `allow_participants_resubmissions`. Any participant may write the row's status and times, so more attempts would be runs
/// without a grant. One is enough for a resume whose message was lost; a person who wants another one raises `spec.attempt`.
const MOST_WITHOUT_MESSAGE: usize = 1;

/// Where a submission that is to run comes from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Source {
    /// A message, by its id.
    Message(String),
    /// The sweep of EvalAI's lists, whose row shows this.
    Sweep(Swept),
}

impl Source {
    fn id(&self) -> &str {
        match self {
            Self::Message(id) => id,
            Self::Sweep(_) => SWEEP,
        }
    }
}

/// A submission that wants to run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Incoming {
    /// Its ids.
    pub evalai: EvalaiRef,
    /// The participant's image, if it is known.
    pub image: Option<String>,
    /// Where it comes from.
    pub source: Source,
    /// When, in milliseconds since 1970: SQS's SentTimestamp, or for the sweep the row's `rerun_resumed_at`, else its
    /// `submitted_at`.
    pub sent_ms: i64,
}

impl Incoming {
    /// The request of a message. `id` is the message's id in its queue; `sent_ms` is in milliseconds since 1970.
    pub fn of(message: &Message, id: String, sent_ms: i64) -> Self {
        Self {
            evalai: EvalaiRef {
                challenge: message.challenge,
                phase: message.phase,
                submission: message.submission,
            },
            image: message.image.clone(),
            source: Source::Message(id),
            sent_ms,
        }
    }
}

/// The step that an incoming submission needs.
#[derive(Clone, Debug, PartialEq)]
pub enum Ingest {
    /// There is none yet: create this one.
    Create(Box<Submission>),
    /// It has ended and is wanted again: raise its attempt, if it still is at the resourceVersion that was read.
    Bump(Attempt),
    /// It has ended, and no further attempt begins: it has finished, or EvalAI's row alone asks for one, which no message has announced.
    /// Note that, so that people see it.
    Refuse(Attempt),
    /// Write nothing.
    Leave(Outcome),
}

/// Why nothing could be done.
#[derive(Debug, Error)]
pub enum IngestError {
    /// A request failed in a way that may pass.
    #[error("{0}; it is retried")]
    Call(CallError),
    /// The API server will not take this object.
    #[error("the API server refuses Submission {name}: {text}")]
    Refused { name: String, text: String },
    /// Others changed the object each time.
    #[error("Submission {name} changed {ROUNDS} times while it was to be bumped; it is retried")]
    Contended { name: String },
}

impl From<IngestError> for NotIngested {
    fn from(error: IngestError) -> Self {
        match error {
            IngestError::Refused { text, .. } => Self::Refused(text),
            IngestError::Call(_) | IngestError::Contended { .. } => Self::Unknown,
        }
    }
}

/// Decides what an incoming submission means for the object of its name, read uncached.
fn decide_ingest(leaderboard: &str, existing: Option<&Submission>, incoming: &Incoming) -> Ingest {
    let Some(existing) = existing else {
        if was_run_before(&incoming.source) {
            return Ingest::Leave(Outcome::NotNew);
        }
        return Ingest::Create(Box::new(new_submission(leaderboard, incoming)));
    };
    if existing.metadata.deletion_timestamp.is_some() {
        return Ingest::Leave(Outcome::Deleting);
    }
    let spec = &existing.spec;
    if spec.leaderboard_name != leaderboard || spec.evalai != Some(incoming.evalai) {
        return Ingest::Leave(Outcome::IdTaken(owner(existing)));
    }
    if existing.metadata.resource_version.is_none() || !is_newer(existing, incoming) {
        return Ingest::Leave(Outcome::Repeat);
    }
    let progress = progress(existing);
    match progress {
        Progress::Live => return Ingest::Leave(Outcome::Repeat),
        Progress::Stopping => return Ingest::Leave(Outcome::Stopping),
        Progress::Finished | Progress::Ended => {}
    }
    let record = Ingested::of(existing).unwrap_or_default();
    let attempt = spec.attempt.next();
    let is_noted = record.refused.is_some_and(|refused| refused.attempt == attempt);
    match incoming.source {
        Source::Message(_) if progress == Progress::Ended => Ingest::Bump(attempt),
        Source::Sweep(Swept::Resuming)
            if is_resumable(existing) && record.without_message.len() < MOST_WITHOUT_MESSAGE =>
        {
            Ingest::Bump(attempt)
        }
        // Noted once: a row that is edited again and again is not worth a write each time.
        _ if is_noted => Ingest::Leave(Outcome::Repeat),
        _ => Ingest::Refuse(attempt),
    }
}

/// True if it is a row alone that shows an earlier run. Its participant can edit it, so it makes no object anew: not of a Submission
/// that was deleted, by a person or after its retention.
fn was_run_before(source: &Source) -> bool {
    matches!(source, Source::Sweep(Swept::Edited | Swept::Resuming))
}

/// How far the present attempt has come.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Progress {
    Live,
    /// It ends in a moment, as what may be resumed.
    Stopping,
    /// It has ended in a way that a resume can follow.
    Ended,
    /// It has finished, which is final.
    Finished,
}

fn progress(existing: &Submission) -> Progress {
    // A raised attempt that the controller has not begun yet is live, whatever has become of the one before.
    let is_of_present = |status: &&SubmissionStatus| !status.is_followed_by(existing.spec.attempt);
    let status = existing.status.as_ref().filter(is_of_present);
    let is_stopping = status.is_some_and(|status| status.times.stopping.is_some());
    match status.map(SubmissionStatus::state_of_conditions) {
        Some(State::Failed | State::Cancelled) => Progress::Ended,
        Some(State::Finished) => Progress::Finished,
        _ if is_stopping || existing.spec.cancel => Progress::Stopping,
        _ => Progress::Live,
    }
}

/// True if EvalAI can have resumed it: it resumes only what has failed. The row of one that a host cancelled was edited by its
/// participant, who takes no cancel back.
fn is_resumable(existing: &Submission) -> bool {
    let state = existing.status.as_ref().map(SubmissionStatus::state_of_conditions);
    state == Some(State::Failed) && !existing.spec.cancel
}

/// True if this was sent after what made or bumped the object.
fn is_newer(existing: &Submission, incoming: &Incoming) -> bool {
    let Some(recorded) = Ingested::of(existing) else {
        // Made by hand: only what was sent after it was made is a request to resume it.
        let created = existing.metadata.creation_timestamp.as_ref();
        return created.is_some_and(|time| incoming.sent_ms >= time.0.as_millisecond() + 1000);
    };
    let is_same = matches!(&incoming.source, Source::Message(id) if *id == recorded.message);
    // EvalAI notes the time of a resume before it sends the message. A swept row had kept its status for SWEEP_AGE_MS. So a message sent
    // within that time belongs to the resume that the sweep has already served.
    let grace = if recorded.message == SWEEP { SWEEP_AGE_MS } else { 0 };
    !is_same && incoming.sent_ms > recorded.sent.saturating_add(grace)
}

fn owner(existing: &Submission) -> String {
    let name = existing.metadata.name.as_deref().unwrap_or_default();
    let leaderboard = &existing.spec.leaderboard_name;
    match existing.spec.evalai {
        Some(of) => format!(
            "{name} belongs to leaderboard {leaderboard}, challenge {}, phase {}, submission {}",
            of.challenge, of.phase, of.submission
        ),
        None => format!("{name} belongs to leaderboard {leaderboard} and to no submission of EvalAI"),
    }
}

fn new_submission(leaderboard: &str, incoming: &Incoming) -> Submission {
    Submission {
        metadata: ObjectMeta {
            name: Some(names::submission(incoming.evalai.submission)),
            annotations: Some(BTreeMap::from([annotation(&record(None, incoming, Attempt::FIRST))])),
            labels: Some(BTreeMap::from([
                (names::LABEL_LEADERBOARD.to_owned(), leaderboard.to_owned()),
                (names::LABEL_PHASE.to_owned(), incoming.evalai.phase.to_string()),
            ])),
            finalizers: Some(vec![names::FINALIZER_SUBMISSION.to_owned()]),
            ..ObjectMeta::default()
        },
        spec: SubmissionSpec {
            leaderboard_name: leaderboard.to_owned(),
            image: incoming.image.clone(),
            evalai: Some(incoming.evalai),
            attempt: Attempt::FIRST,
            ..SubmissionSpec::default()
        },
        status: None,
    }
}

/// The note of an attempt that begins. A message resets the list of attempts without a message; a first run needs no entry in it.
fn record(existing: Option<&Submission>, incoming: &Incoming, attempt: Attempt) -> Ingested {
    let mut without_message = match incoming.source {
        Source::Message(_) => Vec::new(),
        Source::Sweep(_) => existing.and_then(Ingested::of).unwrap_or_default().without_message,
    };
    if matches!(incoming.source, Source::Sweep(Swept::Resuming | Swept::Rerun)) {
        without_message.push(attempt);
    }
    Ingested {
        message: incoming.source.id().to_owned(),
        sent: incoming.sent_ms,
        attempt: Some(attempt),
        without_message,
        refused: None,
    }
}

fn annotation(record: &Ingested) -> (String, String) {
    (names::ANNOTATION_INGESTED.to_owned(), json!(record).to_string())
}

/// The span of all log lines about an incoming submission, those of [`apply`] included.
pub fn span(namespace: &str, leaderboard: &str, submission: i64) -> Span {
    about::incoming(
        format_args!("{namespace}/{}", names::submission(submission)),
        leaderboard,
    )
}

/// Creates or bumps the Submission in the namespace of `api`, which is that of the Leaderboard. To be called in a [`span`], which then
/// has the object's attempt and trace.
pub async fn apply(api: &Api<Submission>, leaderboard: &str, incoming: &Incoming) -> Result<Outcome, IngestError> {
    let mut known = None;
    let outcome = rounds(api, leaderboard, incoming, &mut known).await;
    if let Some(known) = known {
        about::identify(known.spec.attempt.0, known.metadata.uid.as_deref().unwrap_or_default());
    }
    // The first line of each attempt.
    match &outcome {
        Ok(Outcome::Created) => tracing::info!("created"),
        Ok(Outcome::Bumped(_)) => tracing::info!("resumed"),
        _ => {}
    }
    outcome
}

/// Leaves in `existing` the object as it was last seen.
async fn rounds(
    api: &Api<Submission>,
    leaderboard: &str,
    incoming: &Incoming,
    existing: &mut Option<Submission>,
) -> Result<Outcome, IngestError> {
    let name = names::submission(incoming.evalai.submission);
    // Most are new, so the first try creates; the answer AlreadyExists makes the read necessary.
    if was_run_before(&incoming.source) {
        *existing = call(&name, "the read", api.get_opt(&name)).await?;
    }
    for _ in 0..ROUNDS {
        let done = match decide_ingest(leaderboard, existing.as_ref(), incoming) {
            Ingest::Create(fresh) => (create(api, &name, &fresh).await?, Outcome::Created),
            Ingest::Bump(attempt) => {
                let record = record(existing.as_ref(), incoming, attempt);
                let spec = json!({ "attempt": attempt, "cancel": false });
                let bumped = note(api, &name, existing.as_ref(), &record, &spec).await?;
                (bumped, Outcome::Bumped(attempt))
            }
            Ingest::Refuse(attempt) => {
                let record = refusal(existing.as_ref(), incoming, attempt);
                let noted = note(api, &name, existing.as_ref(), &record, &json!({})).await?;
                (noted, Outcome::Refused)
            }
            Ingest::Leave(outcome) => return Ok(outcome),
        };
        if let (Some(written), outcome) = done {
            *existing = Some(written);
            return Ok(outcome);
        }
        *existing = call(&name, "the read", api.get_opt(&name)).await?;
    }
    Err(IngestError::Contended { name })
}

/// The note of an attempt that does not begin.
fn refusal(existing: Option<&Submission>, incoming: &Incoming, attempt: Attempt) -> Ingested {
    let at = incoming.sent_ms;
    Ingested {
        refused: Some(RefusedAttempt { attempt, at }),
        ..existing.and_then(Ingested::of).unwrap_or_default()
    }
}

/// None if there is one of that name.
async fn create(api: &Api<Submission>, name: &str, fresh: &Submission) -> Result<Option<Submission>, IngestError> {
    let params = PostParams {
        field_manager: Some(names::MANAGER_INGEST.to_owned()),
        ..PostParams::default()
    };
    let request = api.create(&params, fresh);
    unless_lost(&[409], name, "the creation", request).await
}

/// Writes the annotation, and with it what changes of the spec. None if the object is no longer what the decision was made on.
async fn note(
    api: &Api<Submission>,
    name: &str,
    existing: Option<&Submission>,
    record: &Ingested,
    spec: &Value,
) -> Result<Option<Submission>, IngestError> {
    let (key, text) = annotation(record);
    let version = existing.and_then(|existing| existing.metadata.resource_version.as_deref());
    let patch = json!({
        "metadata": { "resourceVersion": version, "annotations": { key: text } },
        "spec": spec,
    });
    let params = PatchParams {
        field_manager: Some(names::MANAGER_INGEST.to_owned()),
        ..PatchParams::default()
    };
    let patch = Patch::Merge(patch);
    // 404: it was deleted between the read and the patch.
    unless_lost(&[404, 409], name, "the update", api.patch(name, &params, &patch)).await
}

/// The answer of a request that was carried out; none if it lost a race, which these statuses show.
async fn unless_lost<T>(
    lost: &[u16],
    name: &str,
    what: &'static str,
    request: impl Future<Output = kube::Result<T>>,
) -> Result<Option<T>, IngestError> {
    match call(name, what, request).await {
        Err(IngestError::Call(error)) if error.status().is_some_and(|status| lost.contains(&status.code)) => Ok(None),
        other => other.map(Some),
    }
}

async fn call<T>(
    name: &str,
    what: &'static str,
    request: impl Future<Output = kube::Result<T>>,
) -> Result<T, IngestError> {
    let object = format!("Submission {name}");
    let answer = call_within(CALL_LIMIT, what, &object, request).await;
    answer.map_err(|error| match error.status() {
        Some(status) if matches!(status.code, 400 | 422) => IngestError::Refused {
            name: name.to_owned(),
            text: status.message.clone(),
        },
        _ => IngestError::Call(error),
    })
}

#[cfg(test)]
mod tests;
