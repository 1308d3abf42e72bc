//! How the attempts of a team have ended, next to those of the other teams of its Leaderboard. Pure.
//!
//! `observe` makes it for `decide`, the reconcile of a Leaderboard shows it, the metrics count it. What counts is in each Submission's
//! status, so a resume, which takes the failure away, does not take it out of the count; only a run that finishes does.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use jiff::{SignedDuration, Timestamp};

use super::team_use;
use leaderboard_api::infrastructure_failures::MAX_TEAMS;
use leaderboard_api::{InfrastructureFailures, Submission, TeamFailures, conditions, reasons};

/// How long ended attempts count against further Jobs.
const A_DAY: SignedDuration = SignedDuration::from_hours(24);

/// Attempts of one team that ended because of the infrastructure in ways that an agent can cause, before the present one.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TeamHistory {
    /// Within a day.
    pub within_a_day: usize,
    /// Since a run of the team last finished.
    pub in_a_row: usize,
    /// Nodes of those in a row.
    pub nodes: BTreeSet<String>,
    /// What other teams' runs with the same simulator came to since the first of those in a row.
    pub others: Others,
}

/// Ends of other teams' runs.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Others {
    pub finished: usize,
    pub finished_on: BTreeSet<String>,
    /// Those that ended because of the infrastructure, too.
    pub failed: usize,
    pub failed_on: BTreeSet<String>,
}

impl TeamHistory {
    /// Whether the agent is the likeliest cause of one more such end, on `node`: it is not the first in a row, other teams' runs
    /// finish with this simulator, and no single node explains the ends. A node on which other teams' runs fail, too, proves nothing.
    pub fn blames_agent(&self, node: Option<&str>, free_in_a_row: usize) -> bool {
        let others = &self.others;
        let nodes = self.nodes.iter().map(String::as_str).chain(node);
        let good: BTreeSet<&str> = nodes.filter(|node| !others.failed_on.contains(*node)).collect();
        let is_no_node = good.len() >= 2 || good.iter().any(|node| others.finished_on.contains(*node));
        self.in_a_row >= free_in_a_row.max(1) && others.finished > others.failed && is_no_node
    }
}

/// The history of a submission's team. `all`: the Submissions of its Leaderboard that have an end of some attempt.
pub fn of(all: &[Arc<Submission>], submission: &Submission, now: Timestamp) -> TeamHistory {
    let Some(team) = submission.team() else {
        return TeamHistory::default();
    };
    let own = all.iter().filter(|other| other.team() == Some(team));
    let last_finish = own.clone().filter_map(|one| finish(one)).max();
    let failures: Vec<&InfrastructureFailures> = own.filter_map(|one| failures(one)).collect();
    let is_recent = |one: &&&InfrastructureFailures| now.duration_since(one.last_time.0) < A_DAY;
    let row: Vec<_> = failures
        .iter()
        .filter(|one| Some(one.last_time.0) > last_finish)
        .collect();
    let since = row.iter().map(|one| one.first_time.0).min();
    TeamHistory {
        within_a_day: failures.iter().filter(is_recent).map(|one| number(one)).sum(),
        in_a_row: row.iter().map(|one| number(one)).sum(),
        nodes: row.iter().flat_map(|one| one.nodes.iter().cloned()).collect(),
        others: since.map_or_else(Others::default, |since| others(all, submission, team, since)),
    }
}

fn others(all: &[Arc<Submission>], submission: &Submission, team: &str, since: Timestamp) -> Others {
    let simulator = simulator(submission);
    let is_other = |one: &&Arc<Submission>| one.team().is_some_and(|other| other != team);
    let is_same = |one: &&Arc<Submission>| simulator.is_some() && self::simulator(one) == simulator;
    let mut found = Others::default();
    for one in all.iter().filter(is_other).filter(is_same) {
        if finish(one).is_some_and(|at| at >= since) {
            found.finished += 1;
            let node = one.status.as_ref().and_then(|status| status.node_name.clone());
            found.finished_on.extend(node);
        }
        if let Some(failures) = failures(one).filter(|failures| failures.last_time.0 >= since) {
            found.failed += number(failures);
            found.failed_on.extend(failures.nodes.iter().cloned());
        }
    }
    found
}

/// The teams of a Leaderboard that have such failures in a row, those with the most first.
pub fn teams(all: &[Arc<Submission>]) -> Vec<TeamFailures> {
    let mut last_finish: BTreeMap<&str, Timestamp> = BTreeMap::new();
    for one in all {
        if let Some((team, at)) = one.team().zip(finish(one)) {
            let last = last_finish.entry(team).or_insert(at);
            *last = at.max(*last);
        }
    }
    let mut found: BTreeMap<&str, TeamFailures> = BTreeMap::new();
    for one in all {
        let Some((team, failures)) = one.team().zip(failures(one)) else {
            continue;
        };
        if last_finish.get(team).is_some_and(|at| failures.last_time.0 <= *at) {
            continue;
        }
        let known = found.entry(team).or_insert_with(|| TeamFailures {
            team: team.to_owned(),
            number: 0,
            last_time: failures.last_time.clone(),
        });
        known.number = known.number.saturating_add(failures.number);
        if failures.last_time.0 > known.last_time.0 {
            known.last_time = failures.last_time.clone();
        }
    }
    let mut teams: Vec<TeamFailures> = found.into_values().collect();
    teams.sort_by(|one, other| other.number.cmp(&one.number).then_with(|| one.team.cmp(&other.team)));
    teams.truncate(MAX_TEAMS);
    teams
}

/// By what the cache finds the Submissions of a Leaderboard that have an end of some attempt, or of a Job that had a GPU.
pub fn index(submission: &Submission) -> Option<String> {
    let has_end =
        finish(submission).is_some() || failures(submission).is_some() || team_use::gpu_seconds(submission) > 0;
    has_end.then(|| key(submission))
}

/// Namespace and Leaderboard.
pub fn key(submission: &Submission) -> String {
    let namespace = submission.metadata.namespace.as_deref().unwrap_or_default();
    key_of(namespace, &submission.spec.leaderboard_name)
}

/// The same of a Leaderboard itself.
pub fn key_of(namespace: &str, leaderboard: &str) -> String {
    format!("{namespace}/{leaderboard}")
}

fn failures(submission: &Submission) -> Option<&InfrastructureFailures> {
    submission.status.as_ref()?.infrastructure_failures.as_ref()
}

fn number(failures: &InfrastructureFailures) -> usize {
    usize::try_from(failures.number).unwrap_or(0)
}

/// When it ended with results that count.
fn finish(submission: &Submission) -> Option<Timestamp> {
    let status = submission.status.as_ref()?;
    let end = status.condition(conditions::FINISHED)?;
    let is_finish = end.status == "True" && end.reason == reasons::FINISHED;
    is_finish.then(|| status.times.finished.as_ref().map(|time| time.0))?
}

fn simulator(submission: &Submission) -> Option<&str> {
    let plan = submission.status.as_ref()?.plan.as_ref()?;
    Some(plan.simulator_image.as_str())
}

#[cfg(test)]
#[path = "team_history_tests.rs"]
mod tests;
