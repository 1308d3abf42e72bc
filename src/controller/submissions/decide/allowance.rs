//! What simulators' failures cost a team. A submission whose simulator fails is not charged, and an agent can make a simulator
//! fail, so they are counted by team: after some of them the next one gets no further Job by itself. Hosts can resume it.
//!
//! Called by `end`.

use super::plan_builder::PlanBuilder;
use leaderboard_api::{Failure, reasons};

/// Submissions of a team that may end so in a Leaderboard within a day, each with all its Jobs.
const FREE_SUBMISSIONS: usize = 3;

/// Whether no further Job follows a failure, because of what the team had before.
pub(super) fn is_used_up(draft: &PlanBuilder<'_>, found: &Failure) -> bool {
    found.reason == reasons::SIMULATION_CRASHED && draft.view.simulator_failures_of_team >= FREE_SUBMISSIONS
}

/// Adds the team's count to what hosts read of a submission that ends so.
pub(super) fn counted(draft: &PlanBuilder<'_>, found: Failure) -> Failure {
    let team = draft.status.team.as_ref();
    let Some(team) = team.and_then(|team| team.id.as_deref().or(team.name.as_deref())) else {
        return found;
    };
    if found.reason != reasons::SIMULATION_CRASHED {
        return found;
    }
    let jobs = match draft.status.retry {
        0 => "1 Job".to_owned(),
        retry => format!("{} Jobs", retry + 1),
    };
    let submissions = match draft.view.simulator_failures_of_team {
        0 => "1 submission".to_owned(),
        before => format!("{} submissions", before + 1),
    };
    Failure {
        message: format!(
            "{} The attempt had {jobs}. Within a day {submissions} of team {team} ended like this in this Leaderboard; after \
             {FREE_SUBMISSIONS} of them a submission gets one Job only.",
            found.message
        ),
        ..found
    }
}
