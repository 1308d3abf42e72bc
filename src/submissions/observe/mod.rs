//! Reads the world of one submission into a `View`: caches and memory. Decides nothing.

pub mod causes;
pub mod job;
pub mod node;
pub mod pod;
pub mod workers;

use std::sync::Arc;

use kube::ResourceExt;
use kube::runtime::reflector::ObjectRef;

use super::external::ExternalSystems;
use super::memory::Memory;
use super::{failure_log, fences, reports};
use crate::kubernetes::objects::Job;
use crate::runtime::objects::uid;
use crate::runtime::stores::Stores;
use crate::slots::Slots;
use causes::Causes;
use leaderboard_api::{Leaderboard, Submission, SubmissionStatus};
use leaderboard_base::clock::Clock;
use leaderboard_policy::submissions::job_name;
use leaderboard_policy::view::{NodeView, ObservedJob, PodView, Requested, View};
use workers::Workers;

/// The sources of a submission's view.
#[derive(Clone, Copy)]
pub struct Uses<'a> {
    pub clock: &'a Clock,
    pub stores: &'a Stores,
    pub memory: &'a Memory,
    pub workers: &'a Workers,
    pub slots: &'a Slots,
    pub causes: &'a Causes,
    pub external: &'a ExternalSystems,
}

/// Reads everything a reconcile may depend on. `is_policy_in_place` returns whether the NetworkPolicy of a Leaderboard is.
pub fn observe(uses: Uses<'_>, submission: Arc<Submission>, is_policy_in_place: impl Fn(&Leaderboard) -> bool) -> View {
    let workers = uses.workers;
    let submission = uses.memory.with_own_status(submission);
    let now = uses.clock.now();
    let leaderboard = uses.stores.leaderboard_for(&submission);
    let (job, pod) = children(uses, &submission);
    let status = submission.status.as_ref();
    let is_over = status.is_some_and(SubmissionStatus::has_ended);
    let pod_uid = pod.as_ref().map(|pod| pod.uid.as_str());
    let (key, number) = (uid(submission.as_ref()), status.map(SubmissionStatus::job_number));
    let number = number.unwrap_or_default();
    let board = leaderboard.as_deref();
    let waited = uses.memory.evalai_waited(&submission);
    let may_create = matches!(job, ObservedJob::Absent { .. } | ObservedJob::Foreign);
    View {
        now,
        // Comparing it takes longer than reading the rest.
        is_policy_in_place: may_create && board.is_some_and(is_policy_in_place),
        not_allowed: board.and_then(|board| uses.external.refusal(board)),
        row: workers.rows.get(key),
        input: workers.inputs.get(key),
        turn: uses.slots.turn(&submission, board),
        node: node(uses, pod.as_ref()),
        report: reports::seen(&workers.reports.get(key), number, pod_uid),
        requested: Requested {
            fence: fences::seen(&workers.fences.get(key), number),
            log: failure_log::seen(&workers.logs.get(key), number, is_over),
        },
        evalai: uses.external.evalai_view(board, &submission, waited),
        record: board.and_then(|board| uses.external.record_view(board, &submission)),
        written_ago: uses.memory.since_write(&submission),
        submission,
        leaderboard,
        job,
        pod,
    }
}

/// The Job that the present attempt should have, and its newest Pod.
fn children(uses: Uses<'_>, submission: &Submission) -> (ObservedJob, Option<PodView>) {
    let namespace = submission.namespace().unwrap_or_default();
    let nothing = SubmissionStatus::default();
    let status = submission.status.as_ref().unwrap_or(&nothing);
    let name = job_name(&submission.name_any(), status);
    let reference = ObjectRef::<Job>::new(&name).within(&namespace);
    let Some(found) = uses.stores.jobs.get(&reference) else {
        let is_awaited = uses.memory.awaits_job(submission, &name);
        let job = if is_awaited {
            ObservedJob::Created
        } else {
            ObservedJob::Absent {
                refused: uses.memory.refusal(submission, &name),
            }
        };
        return (job, None);
    };
    if !found.metadata.is_owned_by(uid(submission)) {
        return (ObservedJob::Foreign, None);
    }
    uses.memory.forget_job(submission);
    let pod = uses.stores.newest_pod(&found);
    let mut job = job::view(&found, pod.as_deref());
    let Some(pod) = pod else {
        job.failed_create = uses.causes.refusal(&job.uid).filter(|_| job.end.is_none());
        return (ObservedJob::Ours(job), None);
    };
    uses.causes.has_pod(&job.uid);
    let mut pod = pod::view(&pod);
    if pod.unschedulable.is_some() {
        pod.scale_up = uses.causes.scale_up(&pod.uid);
    }
    (ObservedJob::Ours(job), Some(pod))
}

/// The node of a Pod that has not ended.
fn node(uses: Uses<'_>, pod: Option<&PodView>) -> NodeView {
    let name = pod.filter(|pod| pod.needs_node()).and_then(|pod| pod.node.as_deref());
    name.map(|name| node::watched(uses.stores, name)).unwrap_or_default()
}
