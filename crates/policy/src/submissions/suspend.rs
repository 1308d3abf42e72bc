//! A Job that is suspended: by the webhook of Kueue until a queue has room, by its preemption in mid-run, or by a person.
//!
//! Kubernetes then deletes the Job's Pods and makes none. The submission keeps its slot, because the Job may be resumed at any moment. No
//! deadline of ours runs, a run keeps its state, and nothing counts as lost: the next Pod of the same Job resumes from S3.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;

use super::run;
use super::status::PlanBuilder;
use super::waits::Wait;
use crate::view::{JobView, Suspension};
use leaderboard_api::conditions::{self, Truth};
use leaderboard_api::{Reason, names};

/// The message before the next Pod of a resumed Job is there.
pub(super) const RESUMED: &str = "The Job was suspended and is resumed. A new Pod will resume from the results in S3.";

/// Shows what a suspended Job waits for. Returns whether the Job is suspended and is to go on.
pub(super) fn holds(draft: &mut PlanBuilder<'_>, job: &JobView) -> bool {
    if draft.is_to_stop() {
        return false;
    }
    let Some(suspension) = &job.suspension else {
        goes_on(draft);
        return false;
    };
    if draft.is_running() {
        // Time from here on does not count as time of the run.
        let since = suspension.since.map_or(draft.now(), |since| since.min(draft.now()));
        draft.condition_at(&Time(since), conditions::RUNNING, Truth::False, Reason::Suspended, "");
    } else if is_new(draft, job) {
        run::update_evalai(draft);
        return true;
    }
    let what = message(draft, job, suspension);
    if suspension.queue.is_some() {
        draft.waits_since(Reason::Suspended, &what);
    } else {
        draft.stalls_after(Wait::SUSPENDED, Reason::Suspended, &what);
    }
    draft.show(Reason::Suspended, what);
    run::update_evalai(draft);
    run::record_progress(draft);
    draft.look_again(Wait::RUN);
    true
}

/// Shows that the Job is resumed. A later step may show the wait of its next Pod instead.
fn goes_on(draft: &mut PlanBuilder<'_>) {
    if !draft.status.shows(Reason::Suspended) {
        return;
    }
    draft.waits(Reason::Preparing);
    if draft.is_running() {
        draft.replacing(RESUMED);
    } else {
        draft.show(Reason::Preparing, "The Job is resumed; its Pod is being prepared.");
    }
}

/// True if the queue may still admit the Job without a wait: that costs no write then.
fn is_new(draft: &mut PlanBuilder<'_>, job: &JobView) -> bool {
    let is_shown = draft.status.shows(Reason::Suspended);
    let is_early = |created| draft.waits_until(Wait::SUSPENDED.shown_at(created));
    !is_shown && job.created.is_some_and(is_early)
}

fn message(draft: &PlanBuilder<'_>, job: &JobView, suspension: &Suspension) -> String {
    let ran = draft.is_running();
    let next = match &suspension.queue {
        Some(queue) => format!(
            "Kueue's LocalQueue {queue} has to admit it: `kubectl describe workloads` in this namespace shows why it waits."
        ),
        None => format!(
            "It has no label {}, so nothing may resume it by itself. `kubectl get job {} -o yaml --show-managed-fields` names who has set \
             spec.suspend; for a queue of Kueue set jobLabels in the Leaderboard.",
            names::LABEL_KUEUE_QUEUE,
            job.name
        ),
    };
    let kept = if ran {
        " A new Pod then resumes from the results in S3."
    } else {
        ""
    };
    format!("Job {} is suspended, and no deadline runs. {next}{kept}", job.name)
}

/// True if the present Job was suspended after its last Pod got a node, and goes on.
pub(super) fn was_resumed(draft: &PlanBuilder<'_>) -> bool {
    let scheduled = draft.status.times.scheduled.as_ref().map(|time| time.0);
    let started = draft.view.job.ours().and_then(|job| job.started);
    started
        .zip(scheduled)
        .is_some_and(|(started, scheduled)| started > scheduled)
}
