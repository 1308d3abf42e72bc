//! Reads the world of one submission into a `View`: caches, memory and one short read from S3. Decides nothing.

pub mod job;
pub mod node;
pub mod pod;
pub mod report;

use std::sync::Arc;

use jiff::Timestamp;
use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::core::v1::Pod;
use kube::runtime::reflector::ObjectRef;
use kube::{Resource, ResourceExt};

use super::context::Context;
use super::decide::job_name;
use super::view::{JobSight, NodeSight, PodView, ReportSight, View};
use leaderboard_api::{Leaderboard, Submission, conditions, names};

/// Sees everything a pass may depend on.
pub async fn observe(context: &Context, submission: Arc<Submission>) -> View {
    let submission = context.memory.with_own_status(submission);
    let now = Timestamp::now();
    let namespace = submission.namespace().unwrap_or_default();
    let leaderboard = leaderboard(context, &submission, &namespace);
    let is_policy_in_place = leaderboard.as_ref().is_some_and(|l| context.is_policy_in_place(l));
    let status = submission.status.clone().unwrap_or_default();
    let name = job_name(&submission.name_any(), &status);
    let (job, pod) = children(context, &submission, &namespace, &name);
    let job = match job {
        JobSight::Ours(mut job) if pod.is_none() && job.end.is_none() => {
            job.failed_create = context.failed_create(&namespace, &job.name).await;
            JobSight::Ours(job)
        }
        other => other,
    };
    let node = match &pod {
        Some(pod) if pod.delete_by.is_some() => node::sight(context, pod).await,
        Some(pod) if pod.agent_started.is_some() && pod.run_ended.is_none() => node::recent_sight(context, pod).await,
        _ => NodeSight::Unknown,
    };
    let report = report::read(context, &submission, &job, pod.as_ref(), now).await;
    let record = leaderboard
        .as_ref()
        .and_then(|l| context.sync.record_view(l, &submission));
    let known = |name: &str| context.stores.submissions.get(&ObjectRef::new(name).within(&namespace));
    let evalai = context.sync.evalai_view(leaderboard.as_deref(), &submission, known);
    let turn = context.slots.turn(&submission, leaderboard.as_deref());
    let partial_told = context.memory.partial_told(&submission);
    let unread = context.memory.unread(&submission);
    let rerun_as = context.reruns.of(&submission);
    let evalai_writes_from = context.sync.hub.writes_from();
    View {
        now,
        submission,
        leaderboard,
        is_policy_in_place,
        turn,
        job,
        pod,
        node,
        report,
        evalai,
        record,
        partial_told,
        unread,
        rerun_as,
        evalai_writes_from,
    }
}

fn leaderboard(context: &Context, submission: &Submission, namespace: &str) -> Option<Arc<Leaderboard>> {
    let reference = ObjectRef::new(&submission.spec.leaderboard_name).within(namespace);
    context.stores.leaderboards.get(&reference)
}

fn children(context: &Context, submission: &Submission, namespace: &str, name: &str) -> (JobSight, Option<PodView>) {
    let reference = ObjectRef::<Job>::new(name).within(namespace);
    let Some(found) = context.stores.jobs.get(&reference) else {
        return (JobSight::Absent, None);
    };
    if !is_owned_by(&found, submission) {
        return (JobSight::Foreign, None);
    }
    let pod = context.stores.newest_pod(&found);
    let job = job::view(&found, pod.as_deref());
    (JobSight::Ours(job), pod.map(|pod| pod::view(&pod)))
}

fn is_owned_by(job: &Job, submission: &Submission) -> bool {
    let uid = submission.uid();
    job.owner_references().iter().any(|o| Some(&o.uid) == uid.as_ref())
}

/// Whether a Pod belongs to a Job.
pub(super) fn is_pod_of(pod: &Pod, job: &Job) -> bool {
    let uid = job.uid();
    pod.owner_references().iter().any(|o| Some(&o.uid) == uid.as_ref())
}

/// Whether the report of this submission has to be read at all.
fn report_matters(submission: &Submission, job: &JobSight) -> bool {
    let status = submission.status.as_ref();
    let known_job = status.is_some_and(|s| s.job_name.is_some()) || job.ours().is_some();
    let finished = status.is_some_and(|s| conditions::is_true(&s.conditions, conditions::FINISHED));
    known_job && !finished
}

/// The label selector of everything the operator makes for submissions.
pub fn children_selector() -> String {
    format!("{}={}", names::LABEL_MANAGED_BY, names::OPERATOR)
}

impl ReportSight {
    /// Nothing was stored for this attempt.
    pub fn is_nothing(&self) -> bool {
        matches!(self, Self::Absent | Self::Foreign)
    }
}

/// The key of an object in every map of the controller: its UID, which a name does not replace.
pub fn uid_of(object: &impl Resource) -> String {
    object.meta().uid.clone().unwrap_or_default()
}
