//! Carries a plan out, in this order: finalizer, status, events, then the actions. A Job is created last, because a quota may refuse it for
//! hours. Decides nothing.
//!
//! Every step is safe to repeat. A failed status write ends the reconcile, because what follows would not be remembered.

use std::time::Duration;

use kube::api::{DeleteParams, Patch, PostParams, Preconditions};
use kube::runtime::events::{Event as KubeEvent, EventType, Recorder};
use kube::runtime::reflector::ObjectRef;
use kube::{Client, Resource, ResourceExt};
use serde_json::json;
use tokio::time::Instant;

use super::external::ExternalSystems;
use super::memory::Memory;
use super::observe::workers::Workers;
use super::spans;
use crate::kubernetes::objects::{Job, Meta, Pod};
use crate::kubernetes::{CallError, Watchable, Writer, Writes, call, call_within, recorder};
use crate::metrics::Metrics;
use crate::observability::traces::Traces;
use crate::runtime::objects::{key_of, log_span_of, uid};
use crate::runtime::settings::Settings;
use crate::runtime::stores::Stores;
use crate::runtime::writes::{apply_status, patch_by, set_finalizer};
use crate::slots::Slots;
use leaderboard_api::text::one_line;
use leaderboard_api::{JobNumber, ReasonName, RunPlan, State, Submission, SubmissionStatus, names};
use leaderboard_contract::run::Stop;
use leaderboard_pod_spec::job as job_spec;
use leaderboard_pod_spec::job::JobInput;
use leaderboard_policy::phases::{self, Ended, Phase};
use leaderboard_policy::submissions::{Action, Event, Plan, Question, StatusWrite, pinned};
use leaderboard_policy::view::View;

/// Name of the program in the events that it writes.
pub const CONTROLLER: &str = "controller";
/// Kubernetes refuses notes above 1 kB.
const LONGEST_NOTE: usize = 900;

/// The parts that carry a plan out.
#[derive(Clone, Copy)]
pub struct Uses<'a> {
    pub client: &'a Client,
    pub writer: &'a Writer,
    /// Writer of events that may repeat.
    pub recorder: &'a Recorder,
    pub settings: &'a Settings,
    pub stores: &'a Stores,
    pub memory: &'a Memory,
    pub workers: &'a Workers,
    pub slots: &'a Slots,
    pub external: &'a ExternalSystems,
    pub metrics: &'a Metrics,
    pub traces: &'a Traces,
}

/// A create that an admission webhook holds up keeps a permit that others wait for.
const CREATE_LIMIT: Duration = Duration::from_secs(10);

/// Why a reconcile could not carry its plan out.
#[derive(thiserror::Error, Debug)]
pub enum ActError {
    #[error(transparent)]
    Call(#[from] CallError),
    #[error("{object} has no plan although its Job is to be made; its Leaderboard may have been deleted just now")]
    NoPlan { object: String },
}

impl ActError {
    /// One word for metrics.
    pub fn label(&self) -> &'static str {
        match self {
            Self::Call(error) => error.reason(),
            Self::NoPlan { .. } => "plan",
        }
    }
}

/// Carries out a plan for what `view` shows.
///
/// Returns when to look again if the status has to wait for its turn.
pub async fn act(uses: Uses<'_>, view: &View, plan: Plan) -> Result<Option<Duration>, ActError> {
    let actor = Actor {
        uses,
        view,
        namespace: view.submission.namespace().unwrap_or_default(),
    };
    let mut version = view.submission.resource_version();
    if plan.actions.contains(&Action::SetFinalizer(true)) {
        version = actor.set_finalizer(true).await?;
    }
    let turn_in = actor.write_status(&plan.status, plan.write, version.as_deref()).await?;
    for event in &plan.events {
        actor.publish(event).await;
    }
    let ended = view.ended_at().unwrap_or(view.now);
    uses.workers
        .demand_report(&view.submission, &plan.status, ended, plan.report);
    // Last comes what the API server may refuse for as long as a quota is used up: it keeps nothing else from being done.
    let (creates, others): (Vec<_>, Vec<_>) = plan
        .actions
        .into_iter()
        .partition(|a| matches!(a, Action::CreateJob(_)));
    for action in others.into_iter().chain(creates) {
        actor.carry_out(action, &plan.status).await?;
    }
    Ok(turn_in)
}

struct Actor<'a> {
    uses: Uses<'a>,
    view: &'a View,
    namespace: String,
}

impl Actor<'_> {
    fn submission(&self) -> &Submission {
        &self.view.submission
    }

    fn name(&self) -> String {
        self.submission().name_any()
    }

    fn writes<K: Watchable>(&self) -> Writes<K> {
        Writes::new(self.uses.writer, &self.namespace)
    }

    /// Carries one action out, or hands it on: to the slots, the workers of S3, EvalAI or the table.
    async fn carry_out(&self, action: Action, status: &SubmissionStatus) -> Result<(), ActError> {
        let (uses, workers, submission) = (self.uses, self.uses.workers, self.submission());
        match action {
            // It went before the status.
            Action::SetFinalizer(true) => {}
            Action::SetFinalizer(false) => {
                self.set_finalizer(false).await?;
            }
            Action::CreateJob(number) => self.create_job(status, number).await?,
            Action::DeleteJob {
                name,
                uid,
                grace_seconds,
            } => self.delete_job(&name, &uid, grace_seconds).await?,
            Action::DeletePod { name, uid } => self.delete_pod(&name, &uid, 0).await?,
            Action::StopPod { pod, stop } => self.annotate_stop(&pod, stop).await?,
            Action::DeleteSubmission { uid, resource_version } => {
                self.delete_submission(uid, resource_version).await?;
            }
            Action::JoinLine(place) => uses.slots.join(submission, place),
            Action::Ask(question) => self.ask(question, status),
            Action::TakeOwnership => workers.want_fence(submission, status),
            Action::KeepLog { places } => workers.keep_log(submission, status, places),
            Action::UpdateEvalai(update) => {
                uses.external.update_evalai(workers, self.view, status, update);
            }
            Action::Forget => {
                uses.external.gone(&key_of(submission));
                workers.forget(uid(submission));
            }
            Action::Record(update) => uses.external.record(self.view, status, update),
        }
        Ok(())
    }

    fn ask(&self, question: Question, status: &SubmissionStatus) {
        let (uses, workers, submission) = (self.uses, self.uses.workers, self.submission());
        let (key, log) = (key_of(submission), log_span_of(submission));
        match question {
            Question::Row(row) => workers.rows.want(&key, *row, log),
            Question::Input(input) => workers.inputs.want(&key, *input, log),
            Question::Evalai => {
                uses.memory.asks_evalai(submission);
                uses.external.ask(self.view);
            }
            Question::EvalaiAnew => uses.external.hub.forget(&key),
            Question::EvalaisEnd => uses.external.follow(self.view, status),
        }
    }

    async fn set_finalizer(&self, wanted: bool) -> Result<Option<String>, ActError> {
        let set = set_finalizer(self.uses.writer, self.submission(), names::FINALIZER_SUBMISSION, wanted);
        Ok(set.await?)
    }

    /// Writes the status, if the object still has this version. Returns how long it waits for its turn.
    async fn write_status(
        &self,
        status: &SubmissionStatus,
        write: StatusWrite,
        version: Option<&str>,
    ) -> Result<Option<Duration>, ActError> {
        let waits = match write {
            StatusWrite::NotNow => return Ok(None),
            StatusWrite::InTurn => self.uses.memory.place_waits(self.submission(), Instant::now()),
            StatusWrite::Now => None,
        };
        if waits.is_some() {
            return Ok(waits);
        }
        let nothing = SubmissionStatus::default();
        let old = self.submission().status.as_ref().unwrap_or(&nothing);
        let version = apply_status(self.uses.writer, self.submission(), version, status).await?;
        let shown = self
            .uses
            .stores
            .submissions
            .get(&ObjectRef::from_obj(self.submission()));
        self.uses
            .memory
            .wrote(self.submission(), status, &version, shown.as_deref());
        self.log_transition(status);
        self.count_use(old, status);
        self.count_failure(old, status);
        self.note_phases(status);
        Ok(None)
    }

    /// Logs one line for each change of the state, its reason or the attempt, once it is stored. So the log alone shows the whole way
    /// of a submission.
    fn log_transition(&self, new: &SubmissionStatus) {
        let old = self.submission().status.as_ref();
        let standing =
            |status: &SubmissionStatus| (status.state_of_conditions(), status.reason.clone(), status.attempt);
        if new.attempt.is_none() || old.map(standing) == Some(standing(new)) {
            return;
        }
        tracing::info!(
            attempt = new.attempt.map(|attempt| attempt.0),
            from = old.map_or("none", |status| status.state_of_conditions().as_str()),
            to = new.state_of_conditions().as_str(),
            reason = new.reason.as_ref().map(ReasonName::as_str),
            "{}",
            new.message.as_deref().unwrap_or("the submission's state has changed")
        );
    }

    /// Metrics, log and trace of what has ended with the status that is stored now.
    fn note_phases(&self, new: &SubmissionStatus) {
        let ended = phases::ended(self.view, new);
        for one in &ended {
            let took = one.end.duration_since(one.start).unsigned_abs();
            let duration = self.uses.metrics.submissions.phases.of([one.phase.as_str()]);
            duration.observe(took.as_secs_f64());
            log_delivery(new, one);
        }
        if !ended.is_empty() {
            self.uses.traces.send(|| spans::of(&self.view.submission, new, &ended));
        }
    }

    /// Once it is stored, so that a write that fails counts nothing twice.
    fn count_use(&self, old: &SubmissionStatus, new: &SubmissionStatus) {
        let seconds = |status: &SubmissionStatus| status.usage.map_or(0, |usage| usage.gpu_seconds);
        let more = u64::try_from(seconds(new).saturating_sub(seconds(old))).unwrap_or(0);
        if more > 0 {
            let track = new.track.clone().unwrap_or_default();
            let team = self.view.submission.team();
            let submissions = &self.uses.metrics.submissions;
            submissions.gpus_used(self.leaderboard(), track, team, more);
        }
    }

    /// Each failed attempt once, when its end is stored.
    fn count_failure(&self, old: &SubmissionStatus, new: &SubmissionStatus) {
        let failed = |status: &SubmissionStatus| status.state_of_conditions() == State::Failed;
        let is_known = failed(old) && old.attempt == new.attempt;
        if let Some(failure) = new.failure.as_ref().filter(|_| failed(new) && !is_known) {
            let labels = [&self.leaderboard(), failure.class.as_str(), failure.reason.label()];
            let failures = &self.uses.metrics.submissions.failures;
            failures.of(labels.map(str::to_owned)).inc();
        }
    }

    /// As metrics name it.
    fn leaderboard(&self) -> String {
        format!("{}/{}", self.namespace, self.submission().spec.leaderboard_name)
    }

    async fn create_job(&self, status: &SubmissionStatus, number: JobNumber) -> Result<(), ActError> {
        let (Some(plan), Some(leaderboard)) = (&status.plan, &self.view.leaderboard) else {
            return Err(ActError::NoPlan { object: self.name() });
        };
        let plan = RunPlan {
            image: plan.image.as_deref().map(|image| pinned(image, status.image.as_ref())),
            ..plan.clone()
        };
        let object = job_spec::build_object(&JobInput {
            submission: self.submission(),
            leaderboard,
            plan: &plan,
            input: status.input.as_ref(),
            number,
            own: &self.uses.settings.own,
            failed_nodes: &status.failed_nodes,
            now: self.view.now,
        });
        let name = names::job(&self.name(), number);
        let api = self.writes::<Job>();
        let params = PostParams {
            field_manager: Some(names::MANAGER_CHILDREN.into()),
            ..PostParams::default()
        };
        let create = api.create(&params, &object);
        match call_within(CREATE_LIMIT, "creating the Job", &name, create).await {
            // Its name is ours alone; whose it is, the next reconcile sees.
            Err(error) if error.is_conflict() => Ok(()),
            Ok(_) => {
                self.uses.memory.created_job(self.submission(), name);
                Ok(())
            }
            Err(error) => {
                // The next reconcile shows it.
                if let Some(status) = error.refusal() {
                    let why = one_line(&status.message, LONGEST_NOTE);
                    self.uses.memory.refused_job(self.submission(), name, why);
                }
                Err(error.into())
            }
        }
    }

    async fn delete_job(&self, name: &str, uid: &str, grace_seconds: i64) -> Result<(), ActError> {
        // In the foreground the Job stays until its Pods are gone; a Pod that will never go must not hold it.
        let params = if grace_seconds > 0 {
            DeleteParams::foreground()
        } else {
            DeleteParams::background()
        };
        self.uses.memory.forget_job(self.submission());
        let params = params.preconditions(of_uid(uid));
        self.delete::<Job>("deleting the Job", name, &params).await?;
        let reference = ObjectRef::<Job>::new(name).within(&self.namespace);
        let Some(job) = self.uses.stores.jobs.get(&reference) else {
            return Ok(());
        };
        for pod in self.uses.stores.pods_of(&job) {
            let Meta { name, uid, .. } = &pod.metadata;
            self.delete_pod(name, uid, grace_seconds).await?;
        }
        Ok(())
    }

    /// The Job goes with it. A change since the decision, a resume for example, makes this fail, and the next reconcile decides anew.
    async fn delete_submission(&self, uid: String, resource_version: String) -> Result<(), ActError> {
        let params = DeleteParams::background().preconditions(Preconditions {
            uid: Some(uid),
            resource_version: Some(resource_version),
        });
        if self.delete::<Submission>("the deletion", &self.name(), &params).await? {
            tracing::info!("the Submission is deleted: retention.finishedSeconds have passed since its end");
        }
        Ok(())
    }

    async fn delete_pod(&self, name: &str, uid: &str, grace_seconds: i64) -> Result<(), ActError> {
        let params = DeleteParams {
            grace_period_seconds: u32::try_from(grace_seconds).ok(),
            preconditions: Some(of_uid(uid)),
            ..DeleteParams::default()
        };
        self.delete::<Pod>("deleting the Pod", name, &params).await?;
        Ok(())
    }

    /// Deletes what these parameters ask for; false where it is gone, or another object has its name.
    async fn delete<K: Watchable>(
        &self,
        what: &'static str,
        name: &str,
        params: &DeleteParams,
    ) -> Result<bool, ActError> {
        match call(what, name, self.writes::<K>().delete(name, params)).await {
            Ok(_) => Ok(true),
            Err(error) if error.is_gone() || error.is_conflict() => Ok(false),
            Err(error) => Err(error.into()),
        }
    }

    async fn annotate_stop(&self, pod: &str, stop: Stop) -> Result<(), ActError> {
        let patch = Patch::Merge(json!({ "metadata": { "annotations": { names::ANNOTATION_STOP: stop.as_str() } } }));
        let (api, params) = (self.writes::<Pod>(), patch_by(names::MANAGER_CHILDREN));
        match call("the stop annotation", pod, api.patch(pod, &params, &patch)).await {
            Err(error) if !error.is_gone() => Err(error.into()),
            _ => Ok(()),
        }
    }

    /// An event that cannot be written never fails a reconcile.
    async fn publish(&self, event: &Event) {
        let reference = self.submission().object_ref(&());
        let note = KubeEvent {
            type_: if event.warning {
                EventType::Warning
            } else {
                EventType::Normal
            },
            reason: event.reason.as_str().to_owned(),
            note: Some(one_line(&event.message, LONGEST_NOTE)),
            action: event.reason.as_str().to_owned(),
            secondary: None,
        };
        // Those of a good run do not repeat, and a recorder that is kept would hold each for minutes.
        let fresh = (!event.warning).then(|| recorder(self.uses.client, CONTROLLER));
        let published = fresh.as_ref().unwrap_or(self.uses.recorder).publish(&note, &reference);
        if let Err(error) = call("an event", &self.name(), published).await {
            tracing::warn!(reason = %event.reason, "{error}");
        }
    }
}

/// Logs that EvalAI or the table has an end: this changes no state, so it has a line of its own.
fn log_delivery(new: &SubmissionStatus, ended: &Ended) {
    let by = match ended.phase {
        Phase::Record => "the table has the end",
        Phase::Publish => "EvalAI has the end",
        _ => return,
    };
    tracing::info!(attempt = new.attempt.map(|attempt| attempt.0), "{by}");
}

/// The object of this UID alone.
fn of_uid(uid: &str) -> Preconditions {
    Preconditions {
        uid: Some(uid.into()),
        resource_version: None,
    }
}

#[cfg(test)]
mod tests;
