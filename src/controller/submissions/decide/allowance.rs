//! What infrastructure failures cost a team that an agent can cause as well. An attempt that ends so is not charged, so they are counted
//! by team: after some of them within a day the next one gets no further Job by itself, and a host may have the next one in a row
//! charged.
//!
//! Called by `end`. Whose fault a row of them is, is decided by `team_history`.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;

use super::failure;
use super::next_steps::Steps;
use super::plan_builder::PlanBuilder;
use leaderboard_api::infrastructure_failures::{CAN_BE_CAUSED, MAX_NODES, MAX_RECENT_TIMES};
use leaderboard_api::{Failure, FailureClass, InfrastructureFailures, OnRepeatedInfrastructure, reasons};

/// Attempts of a team that may end so in a Leaderboard within a day, each with all its Jobs. A Submission remembers as many.
const FREE_ATTEMPTS: usize = MAX_RECENT_TIMES;

/// Whether no further Job follows a failure, because of what the team had before.
pub(super) fn is_used_up(draft: &PlanBuilder<'_>, found: &Failure) -> bool {
    is_counted(found) && (draft.view.team.within_a_day >= FREE_ATTEMPTS || is_charged(draft))
}

/// Counts a failure that ends an attempt: in its status, and in what hosts read of it. It may be the agent's after all.
pub(super) fn counted(draft: &mut PlanBuilder<'_>, found: Failure) -> Failure {
    if !is_counted(&found) {
        return found;
    }
    note(draft);
    let status = &draft.status;
    let team = status
        .team
        .as_ref()
        .and_then(|team| team.id.as_deref().or(team.name.as_deref()));
    let Some(team) = team.map(str::to_owned) else {
        return found;
    };
    if is_charged(draft) {
        return repeated(draft, &found, &team);
    }
    let jobs = match draft.status.retry {
        0 => "1 Job".to_owned(),
        retry => format!("{} Jobs", retry + 1),
    };
    let history = &draft.view.team;
    let attempts = match history.within_a_day {
        0 => "1 attempt".to_owned(),
        before if history.may_be_more => format!("at least {} attempts", before + 1),
        before => format!("{} attempts", before + 1),
    };
    Failure {
        message: format!(
            "{} The attempt had {jobs}. Within a day {attempts} of team {team} ended like this in this Leaderboard; after \
             {FREE_ATTEMPTS} of them an attempt gets one Job only.",
            found.message
        ),
        ..found
    }
}

fn is_counted(found: &Failure) -> bool {
    // Only an agent's image belongs to a pair.
    let is_of_hosts = found.reason == reasons::IMAGE_PULL && found.pair.is_none();
    found.class == FailureClass::Infrastructure && !is_of_hosts && CAN_BE_CAUSED.contains(&found.reason.as_str())
}

fn is_charged(draft: &PlanBuilder<'_>) -> bool {
    let retries = draft.retries();
    let free = usize::try_from(retries.infrastructure).unwrap_or(0);
    let node = draft.status.node_name.as_deref();
    retries.on_repeated_infrastructure == OnRepeatedInfrastructure::Charge && draft.view.team.blames_agent(node, free)
}

/// One more in the status of the submission.
fn note(draft: &mut PlanBuilder<'_>) {
    let now = Time(draft.now());
    let node = draft.status.node_name.clone();
    let none = || InfrastructureFailures {
        number: 0,
        first_time: now.clone(),
        last_time: now.clone(),
        recent_times: Vec::new(),
        nodes: Vec::new(),
    };
    let known = draft
        .status
        .infrastructure_failures
        .get_or_insert_with(|| Box::new(none()));
    let mut times = known.known_times().to_vec();
    times.push(now.clone());
    times.drain(..times.len().saturating_sub(MAX_RECENT_TIMES));
    known.recent_times = times;
    known.number = known.number.saturating_add(1);
    known.last_time = now;
    let is_new = |node: &String| !known.nodes.contains(node);
    if let Some(node) = node.filter(is_new).filter(|_| known.nodes.len() < MAX_NODES) {
        known.nodes.push(node);
    }
}

/// The failure of an attempt that ends like those before it.
fn repeated(draft: &PlanBuilder<'_>, found: &Failure, team: &str) -> Failure {
    let history = &draft.view.team;
    let others = match history.others.finished {
        1 => "a run of another team".to_owned(),
        runs => format!("{runs} runs of other teams"),
    };
    let before = match history.in_a_row {
        1 => "The attempt of the same team before it".to_owned(),
        attempts => format!("The {attempts} attempts of the same team before it"),
    };
    let meanwhile = format!(
        "{before} ended because of the infrastructure as well, while {others} with the same simulator finished."
    );
    let what = format!("{} {meanwhile}", found.message);
    let steps = Steps {
        hosts: format!(
            "Team {team}: {}",
            reasons::plain(reasons::of(reasons::REPEATED_FAILURES).map_or("", |reason| reason.next_step))
        ),
        participant: "Check what your agent does to its simulator, its memory and its disk, and submit again; ask the challenge's \
                      hosts if it is not the cause."
            .to_owned(),
    };
    let charged = failure::participant(reasons::REPEATED_FAILURES, &what, &steps);
    Failure {
        pair: found.pair,
        participant_message: Some(format!("The run ended early. {meanwhile} {}", steps.participant)),
        ..charged
    }
}
