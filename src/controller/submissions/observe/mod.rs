//! Reads the world of one submission into a `View`: caches and memory. Decides nothing.

pub mod job;
pub mod lookups;
pub mod node;
pub mod pod;
pub mod team;

use std::sync::Arc;

use jiff::{SignedDuration, Timestamp};
use kube::ResourceExt;
use kube::runtime::reflector::ObjectRef;

use super::decide::job_name;
use super::view::{ObservedJob, ObservedNode, ObservedReport, PodView, View};
pub use crate::controller::objects::{children_selector, uid_of};
use crate::controller::runtime::context::Context;
use crate::kubernetes::objects::Job;
use leaderboard_api::{Leaderboard, Submission, conditions};

/// A Job that has had no Pod for so long may have been refused one. Asking for the events of each at once costs the API server more
/// than all the rest.
const REFUSED_AFTER: SignedDuration = SignedDuration::from_secs(45);

/// Sees everything a pass may depend on.
pub fn observe(context: &Context, submission: Arc<Submission>) -> View {
    let submission = context.memory.with_own_status(submission);
    let now = Timestamp::now();
    let namespace = submission.namespace().unwrap_or_default();
    let leaderboard = leaderboard(context, &submission, &namespace);
    let is_policy_in_place = leaderboard.as_ref().is_some_and(|l| context.is_policy_in_place(l));
    let status = submission.status.clone().unwrap_or_default();
    let name = job_name(&submission.name_any(), &status);
    let this = || ObjectRef::from_obj(submission.as_ref());
    let (job, pod) = children(context, &submission, &namespace, &name);
    let job = match job {
        ObservedJob::Ours(mut job) if pod.is_none() && job.end.is_none() => {
            if job.created.is_some_and(|at| now.duration_since(at) >= REFUSED_AFTER) {
                job.failed_create = context.lookups.refusal(&namespace, &job.name, this());
            }
            ObservedJob::Ours(job)
        }
        other => other,
    };
    let matters = |pod: &&PodView| pod.delete_by.is_some() || (pod.agent_started.is_some() && pod.run_ended.is_none());
    let node = pod.as_ref().filter(matters).and_then(|pod| pod.node.as_ref());
    let node = node.map_or(ObservedNode::Unknown, |name| {
        node::watched(&context.stores, name).unwrap_or_else(|| context.lookups.node(name, this()))
    });
    let is_over = conditions::is_true(&status.conditions, conditions::FINISHED);
    let pod_uid = pod.as_ref().map(|pod| pod.uid.as_str());
    let archive = context.archive_workers.observe(&submission, pod_uid, is_over);
    let record = leaderboard
        .as_ref()
        .and_then(|l| context.external.record_view(l, &submission));
    let known = |name: &str| context.stores.submissions.get(&ObjectRef::new(name).within(&namespace));
    let evalai = context.external.evalai_view(leaderboard.as_deref(), &submission, known);
    let turn = context.slots.turn(&submission, leaderboard.as_deref());
    let simulator_failures_of_team = if may_end(&submission, &job) {
        team::simulator_failures(&context.stores.submissions, &submission, now)
    } else {
        0
    };
    let partial_sent = context.memory.partial_sent(&submission);
    let rerun_as = context.reruns.of(&submission);
    let evalai_writes_from = context.external.hub.writes_from();
    View {
        now,
        submission,
        leaderboard,
        is_policy_in_place,
        turn,
        job,
        pod,
        node,
        report: archive.report.report,
        report_stage: archive.report.stage,
        report_waited: archive.report.waited,
        texts: archive.texts,
        fence: archive.fence,
        log: archive.log,
        evalai,
        record,
        partial_sent,
        rerun_as,
        simulator_failures_of_team,
        evalai_writes_from,
    }
}

/// Whether this may be the reconcile that ends it. Only then what other submissions came to is looked up.
fn may_end(submission: &Submission, job: &ObservedJob) -> bool {
    let is_under_way = matches!(job, ObservedJob::Ours(job) if job.end.is_none());
    let Some(status) = &submission.status else { return false };
    let is_finished = conditions::is_true(&status.conditions, conditions::FINISHED);
    status.job_name.is_some() && !is_finished && (status.failure.is_some() || !is_under_way)
}

fn leaderboard(context: &Context, submission: &Submission, namespace: &str) -> Option<Arc<Leaderboard>> {
    let reference = ObjectRef::new(&submission.spec.leaderboard_name).within(namespace);
    context.stores.leaderboards.get(&reference)
}

fn children(context: &Context, submission: &Submission, namespace: &str, name: &str) -> (ObservedJob, Option<PodView>) {
    let reference = ObjectRef::<Job>::new(name).within(namespace);
    let Some(found) = context.stores.jobs.get(&reference) else {
        return (ObservedJob::Absent, None);
    };
    if !is_owned_by(&found, submission) {
        return (ObservedJob::Foreign, None);
    }
    let pod = context.stores.newest_pod(&found);
    let job = job::view(&found, pod.as_deref());
    (ObservedJob::Ours(job), pod.map(|pod| pod::view(&pod)))
}

fn is_owned_by(job: &Job, submission: &Submission) -> bool {
    job.metadata
        .is_owned_by(submission.metadata.uid.as_deref().unwrap_or_default())
}

impl ObservedReport {
    /// Nothing was stored for this attempt.
    pub fn is_nothing(&self) -> bool {
        matches!(self, Self::Absent | Self::Foreign)
    }
}
