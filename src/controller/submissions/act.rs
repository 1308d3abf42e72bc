//! Carries a plan out: finalizer, status, children, requests, events, in this order. Decides nothing.
//!
//! Every step is safe to repeat. A failed status write ends the pass, because what follows would not be remembered.

use std::time::Duration;

use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::core::v1::Pod;
use kube::api::{
    ApiResource, DeleteParams, DynamicObject, Patch, PatchParams, PostParams, Preconditions, PropagationPolicy,
};
use kube::runtime::events::{Event as KubeEvent, EventType};
use kube::{Api, Resource, ResourceExt};
use serde_json::json;

use super::archive::request::LogDemand;
use super::decide::{Action, Event, LogPlace, Plan};
use super::job_spec::{self, JobInput};
use super::observe::{is_pod_of, uid_of};
use super::significance::{Change, change, patience};
use super::view::View;
use crate::controller::runtime::context::{CALL_TIMEOUT, Context};
use leaderboard_api::client_errors;
use leaderboard_api::{State, Submission, SubmissionStatus, names};

/// What a pass could not carry out.
#[derive(thiserror::Error, Debug)]
pub enum ActError {
    #[error("{what} of {object} failed: {}", client_errors::kube(source))]
    Kubernetes {
        what: &'static str,
        object: String,
        source: Box<kube::Error>,
    },
    #[error("{what} of {object}: the API server did not answer within {} s", CALL_TIMEOUT.as_secs())]
    Silent { what: &'static str, object: String },
    #[error("{object} has no plan although its Job is to be made; its Leaderboard may have been deleted just now")]
    NoPlan { object: String },
}

impl ActError {
    /// One word for metrics.
    pub fn label(&self) -> &'static str {
        match self {
            Self::Kubernetes { .. } => "kubernetes",
            Self::Silent { .. } => "timeout",
            Self::NoPlan { .. } => "plan",
        }
    }
}

/// Carries out a plan for what `view` shows.
///
/// Returns when to look again if a status of mere progress was held back.
pub async fn act(context: &Context, view: &View, plan: Plan) -> Result<Option<Duration>, ActError> {
    let actor = Actor {
        context,
        view,
        namespace: view.submission.namespace().unwrap_or_default(),
    };
    if plan.actions.contains(&Action::AddFinalizer) {
        actor.set_finalizer(true).await?;
    }
    let held_back = actor.write_status(&plan.status).await?;
    for event in &plan.events {
        actor.publish(event).await;
    }
    context
        .archive_workers
        .demand(&view.submission, &plan.status, plan.report);
    for action in &plan.actions {
        actor.carry_out(action, &plan.status).await?;
    }
    Ok(held_back)
}

struct Actor<'a> {
    context: &'a Context,
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

    fn api<K>(&self) -> Api<K>
    where
        K: Resource<Scope = k8s_openapi::NamespaceResourceScope>,
        K::DynamicType: Default,
    {
        Api::namespaced(self.context.client.clone(), &self.namespace)
    }

    async fn carry_out(&self, action: &Action, status: &SubmissionStatus) -> Result<(), ActError> {
        match action {
            Action::AddFinalizer => Ok(()),
            Action::ReleaseFinalizer => self.set_finalizer(false).await,
            Action::CreateJob { attempt, retry } => self.create_job(status, *attempt, *retry).await,
            Action::DeleteJob {
                name,
                uid,
                grace_seconds,
            } => self.delete_job(name, uid, *grace_seconds).await,
            Action::ForceDeletePod { name, uid } => self.delete_pod(name, uid, 0).await,
            Action::TakeOwnership => {
                self.context.archive_workers.want_fence(self.submission(), status);
                Ok(())
            }
            Action::AnnotateStop { pod, stop } => {
                let patch = json!({ "metadata": { "annotations": { names::ANNOTATION_STOP: stop.as_str() } } });
                self.patch::<Pod>("the stop annotation", pod, &patch).await
            }
            Action::SetJobTtl { name, seconds } => {
                let patch = json!({ "spec": { "ttlSecondsAfterFinished": seconds } });
                self.patch::<Job>("the time to live", name, &patch).await
            }
            Action::KeepLog { places } => {
                self.keep_log(places, status);
                Ok(())
            }
            Action::ReadTexts { of } => {
                self.context.archive_workers.want_texts(self.submission(), status, *of);
                Ok(())
            }
            Action::JoinLine(place) => {
                self.context.slots.join(self.submission(), place.clone());
                Ok(())
            }
            Action::AskEvalai => {
                self.context.external.ask(self.view);
                Ok(())
            }
            Action::FollowEvalai => {
                self.context.external.follow(self.view, status);
                Ok(())
            }
            Action::UpdateEvalai(update) => {
                self.context
                    .external
                    .update_evalai(self.context, self.view, status, *update);
                Ok(())
            }
            Action::ForgetEvalai => {
                self.context.external.forget_evalai(self.submission());
                Ok(())
            }
            Action::Forget => {
                self.context.external.forget(self.submission());
                self.context.archive_workers.forget(&uid_of(self.submission()));
                Ok(())
            }
            Action::Record { end } => {
                self.context.external.record(self.view, status, *end);
                Ok(())
            }
            Action::DeleteSubmission { uid, resource_version } => self.delete_submission(uid, resource_version).await,
        }
    }

    fn keep_log(&self, places: &[LogPlace], status: &SubmissionStatus) {
        let demand = LogDemand {
            attempt: status.attempt.unwrap_or(1),
            retry: status.retry,
            places: places.to_vec(),
            is_over: status.times.finished.is_some(),
        };
        self.context.archive_workers.want_log(self.submission(), status, demand);
    }

    async fn set_finalizer(&self, wanted: bool) -> Result<(), ActError> {
        let present = self.submission().finalizers().to_vec();
        let mut finalizers: Vec<String> = present
            .into_iter()
            .filter(|f| f != names::FINALIZER_SUBMISSION)
            .collect();
        if wanted {
            finalizers.push(names::FINALIZER_SUBMISSION.into());
        }
        // The resource version keeps other controllers' finalizers safe: a concurrent change makes this write fail.
        let patch = json!({ "metadata": {
            "resourceVersion": self.submission().metadata.resource_version,
            "finalizers": finalizers,
        } });
        let params = PatchParams {
            field_manager: Some(names::MANAGER_FINALIZER.into()),
            ..PatchParams::default()
        };
        let (api, name, body) = (self.api::<Submission>(), self.name(), Patch::Merge(&patch));
        let call = api.patch(&name, &params, &body);
        match self.call("the finalizer", &self.name(), call).await {
            Err(error) if !wanted && is_gone(&error) => Ok(()),
            other => other.map(|_| ()),
        }
    }

    async fn write_status(&self, status: &SubmissionStatus) -> Result<Option<Duration>, ActError> {
        let old = self.submission().status.clone().unwrap_or_default();
        match change(&old, status) {
            Change::Nothing => return Ok(None),
            Change::Place => {
                let position = status.waiting.as_ref().map_or(0, |w| w.position);
                let now = tokio::time::Instant::now();
                let waits = self.context.memory.place_waits(self.submission(), position, now);
                if waits.is_some() {
                    return Ok(waits);
                }
            }
            Change::Progress => {
                let patience = patience(self.view.leaderboard.as_ref().map(|l| &l.spec));
                let since = self.context.memory.since_write(self.submission());
                if let Some(left) = since.and_then(|since| patience.checked_sub(since)) {
                    return Ok(Some(left));
                }
            }
            Change::Real => {}
        }
        let patch = json!({
            "apiVersion": Submission::api_version(&()),
            "kind": Submission::kind(&()),
            "metadata": { "name": self.name(), "uid": uid_of(self.submission()) },
            "status": status,
        });
        let params = PatchParams::apply(names::MANAGER_STATUS).force();
        let (api, name, body) = (self.api::<Submission>(), self.name(), Patch::Apply(&patch));
        let call = api.patch_status(&name, &params, &body);
        let answer = self.call("the status", &self.name(), call).await?;
        self.context.memory.wrote(&answer);
        self.log_transition(status);
        Ok(None)
    }

    /// One line for each change of the state, its reason or the attempt, written when it is stored: what a submission went
    /// through can be read from the log without anything else.
    fn log_transition(&self, new: &SubmissionStatus) {
        let old = self.submission().status.as_ref();
        let standing = |status: &SubmissionStatus| (status.state, status.reason.clone(), status.attempt);
        if old.map(standing).unwrap_or_default() == standing(new) {
            return;
        }
        tracing::info!(
            submission = %format_args!("{}/{}", self.namespace, self.name()),
            leaderboard = self.submission().spec.leaderboard_name,
            attempt = new.attempt,
            from = old.and_then(|status| status.state).map_or("none", State::as_str),
            to = new.state.map_or("none", State::as_str),
            reason = new.reason,
            "{}", new.message.as_deref().unwrap_or("the submission's state has changed")
        );
    }

    async fn create_job(&self, status: &SubmissionStatus, attempt: i64, retry: i32) -> Result<(), ActError> {
        let (Some(plan), Some(leaderboard)) = (&status.plan, &self.view.leaderboard) else {
            return Err(ActError::NoPlan { object: self.name() });
        };
        let settings = &self.context.settings;
        let object = job_spec::build_object(&JobInput {
            submission: self.submission(),
            leaderboard,
            plan,
            attempt,
            retry,
            operator_image: &settings.image,
            image_pull_policy: settings.image_pull_policy.as_deref(),
            region: settings.region.as_deref(),
            now: self.view.now,
        });
        let name = names::job(&self.name(), attempt, retry);
        let resource = ApiResource::erase::<Job>(&());
        let api: Api<DynamicObject> = Api::namespaced_with(self.context.client.clone(), &self.namespace, &resource);
        let params = PostParams {
            field_manager: Some(names::MANAGER_CHILDREN.into()),
            ..PostParams::default()
        };
        let call = api.create(&params, &object);
        match self.call("creating the Job", &name, call).await {
            // Its name is ours alone; whose it is, the next pass sees.
            Err(error) if is_conflict(&error) => Ok(()),
            other => other.map(|_| ()),
        }
    }

    async fn delete_job(&self, name: &str, uid: &str, grace_seconds: i64) -> Result<(), ActError> {
        // In the foreground the Job stays until its Pods are gone; a Pod that will never go must not hold it.
        let propagation = if grace_seconds > 0 {
            PropagationPolicy::Foreground
        } else {
            PropagationPolicy::Background
        };
        let params = DeleteParams {
            propagation_policy: Some(propagation),
            preconditions: Some(Preconditions {
                uid: Some(uid.into()),
                resource_version: None,
            }),
            ..DeleteParams::default()
        };
        let api = self.api::<Job>();
        let call = api.delete(name, &params);
        match self.call("deleting the Job", name, call).await {
            Err(error) if !is_gone(&error) && !is_conflict(&error) => return Err(error),
            _ => {}
        }
        let stores = &self.context.stores;
        let pods: Vec<_> = stores
            .pods
            .state()
            .into_iter()
            .filter(|pod| self.is_of_job(pod, name))
            .collect();
        for pod in pods {
            self.delete_pod(&pod.name_any(), &uid_of(pod.as_ref()), grace_seconds)
                .await?;
        }
        Ok(())
    }

    /// Its Job goes with it. A change since the decision, a resume for example, makes this fail, and the next reconcile decides anew.
    async fn delete_submission(&self, uid: &str, resource_version: &str) -> Result<(), ActError> {
        let name = self.name();
        let params = DeleteParams {
            propagation_policy: Some(PropagationPolicy::Background),
            preconditions: Some(Preconditions {
                uid: Some(uid.into()),
                resource_version: Some(resource_version.into()),
            }),
            ..DeleteParams::default()
        };
        let api = self.api::<Submission>();
        let call = api.delete(&name, &params);
        match self.call("deleting the Submission", &name, call).await {
            Err(error) if is_gone(&error) || is_conflict(&error) => {}
            other => {
                other?;
                let submission = format_args!("{}/{name}", self.namespace);
                tracing::info!(%submission, "the Submission is deleted: retention.finishedSeconds have passed since its end");
            }
        }
        Ok(())
    }

    fn is_of_job(&self, pod: &Pod, job: &str) -> bool {
        let reference = kube::runtime::reflector::ObjectRef::<Job>::new(job).within(&self.namespace);
        self.context
            .stores
            .jobs
            .get(&reference)
            .is_some_and(|job| is_pod_of(pod, &job))
    }

    async fn delete_pod(&self, name: &str, uid: &str, grace_seconds: i64) -> Result<(), ActError> {
        let params = DeleteParams {
            grace_period_seconds: u32::try_from(grace_seconds).ok(),
            preconditions: Some(Preconditions {
                uid: Some(uid.into()),
                resource_version: None,
            }),
            ..DeleteParams::default()
        };
        let api = self.api::<Pod>();
        let call = api.delete(name, &params);
        match self.call("deleting the Pod", name, call).await {
            Err(error) if !is_gone(&error) && !is_conflict(&error) => Err(error),
            _ => Ok(()),
        }
    }

    async fn patch<K>(&self, what: &'static str, name: &str, patch: &serde_json::Value) -> Result<(), ActError>
    where
        K: Resource<Scope = k8s_openapi::NamespaceResourceScope>
            + Clone
            + std::fmt::Debug
            + serde::de::DeserializeOwned,
        K::DynamicType: Default,
    {
        let params = PatchParams {
            field_manager: Some(names::MANAGER_CHILDREN.into()),
            ..PatchParams::default()
        };
        let (api, body) = (self.api::<K>(), Patch::Merge(patch));
        let call = api.patch(name, &params, &body);
        match self.call(what, name, call).await {
            Err(error) if is_gone(&error) => Ok(()),
            other => other.map(|_| ()),
        }
    }

    async fn call<T>(
        &self,
        what: &'static str,
        object: &str,
        call: impl Future<Output = Result<T, kube::Error>>,
    ) -> Result<T, ActError> {
        match tokio::time::timeout(CALL_TIMEOUT, call).await {
            Ok(Ok(answer)) => Ok(answer),
            Ok(Err(source)) => Err(ActError::Kubernetes {
                what,
                object: object.into(),
                source: Box::new(source),
            }),
            Err(_) => Err(ActError::Silent {
                what,
                object: object.into(),
            }),
        }
    }

    /// An event that cannot be told never fails a pass.
    async fn publish(&self, event: &Event) {
        let reference = self.submission().object_ref(&());
        let note = KubeEvent {
            type_: if event.warning {
                EventType::Warning
            } else {
                EventType::Normal
            },
            reason: event.reason.clone(),
            note: Some(truncate(&event.message)),
            action: event.reason.clone(),
            secondary: None,
        };
        let call = self.context.recorder.publish(&note, &reference);
        match tokio::time::timeout(CALL_TIMEOUT, call).await {
            Ok(Ok(())) => {}
            Ok(Err(error)) => {
                let error = client_errors::kube(&error);
                tracing::warn!(submission = %self.name(), reason = %event.reason, error, "an event could not be written");
            }
            Err(_) => tracing::warn!(submission = %self.name(), reason = %event.reason, "an event was not answered"),
        }
    }
}

/// Kubernetes refuses notes above 1 kB.
fn truncate(text: &str) -> String {
    match text.char_indices().nth(900) {
        Some((end, _)) => format!("{} …", &text[..end]),
        None => text.to_owned(),
    }
}

fn is_gone(error: &ActError) -> bool {
    matches!(error, ActError::Kubernetes { source, .. } if matches!(source.as_ref(), kube::Error::Api(status) if status.code == 404))
}

fn is_conflict(error: &ActError) -> bool {
    matches!(error, ActError::Kubernetes { source, .. } if matches!(source.as_ref(), kube::Error::Api(status) if status.code == 409))
}

#[cfg(test)]
#[path = "act_tests.rs"]
mod tests;
