//! Pins the plan of a submission: what is run stays as it was accepted, however its Leaderboard is edited.

use super::status::{PlanBuilder, Terms};
use crate::controller::submissions::view::{EvalaiInfo, Standing};
use leaderboard_api::{Attempt, LeaderboardSpec, RunPlan, effective};

pub(super) fn pin(draft: &mut PlanBuilder<'_>, terms: Terms<'_>, image: String) {
    let Terms {
        leaderboard,
        track,
        info,
    } = terms;
    let resumed = info.is_some_and(|i| i.standing == Standing::Resumed);
    let plan = if let Some(pinned) = draft.status.plan.take() {
        again(draft, leaderboard, pinned, image)
    } else {
        let resume = resumed || draft.spec().attempt > Attempt::FIRST || draft.is_adopted();
        let plan = effective::plan(leaderboard, track, draft.submission().run_id(), image, resume);
        let plan = if draft.spec().check { plan.of_check() } else { plan };
        RunPlan {
            earlier_attempts: attempts_before(draft, info),
            submission_uid: draft.submission().metadata.uid.clone(),
            ..plan
        }
    };
    draft.status.results_url = Some(effective::results_url(&plan.storage, &plan.run_id));
    draft.status.plan = Some(plan);
    if draft.status.times.accepted.is_none() {
        draft.status.times.accepted = Some(draft.time());
    }
}

/// The plan of a submission that has one. A person who hands it over has it take up what is stored.
fn again(draft: &PlanBuilder<'_>, leaderboard: &LeaderboardSpec, pinned: RunPlan, image: String) -> RunPlan {
    let pinned = RunPlan {
        resume: pinned.resume || draft.is_adopted(),
        ..pinned
    };
    if draft.status.retry > 0 || draft.status.job_name.is_some() {
        return pinned;
    }
    // The host's images belong to the attempt and follow the Leaderboard until its first Job is made; all else belongs to the submission.
    RunPlan {
        // The same, unless an earlier attempt had none.
        image,
        ..pinned.renewed(leaderboard)
    }
}

/// How many attempts the table's row counts before those of an object that was made anew, as EvalAI's row names their Jobs: the table takes
/// no attempt that is not above its own. An object with a history asks the table alone, since participants can edit EvalAI's row.
fn attempts_before(draft: &PlanBuilder<'_>, info: Option<&EvalaiInfo>) -> i64 {
    let is_new = draft.spec().attempt == Attempt::FIRST;
    let resumed = info.filter(|info| is_new && info.standing == Standing::Resumed);
    resumed.and_then(|info| info.last_attempt).map_or(0, |last| last.0)
}
