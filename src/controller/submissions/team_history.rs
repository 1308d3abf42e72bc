//! How the attempts of a team have ended, next to those of the other teams of its Leaderboard, and how many GPU seconds each team has
//! used. Pure but for its lock.
//!
//! Told by the cache of Submissions of each change, so that nobody walks through all that have ended. `observe` asks it for `decide`, the
//! reconcile of a Leaderboard shows it. What counts is in each Submission's status, so a resume, which takes the failure away, does not
//! take it out of the count; only a run that finishes does.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::{Arc, Mutex};

use jiff::{SignedDuration, Timestamp};

use crate::lock::lock;
use leaderboard_api::infrastructure_failures::MAX_TEAMS;
use leaderboard_api::{
    InfrastructureFailures, Leaderboard, MAX_USING_TEAMS, Submission, TeamFailures, TeamUse, conditions, reasons,
};

/// Finishes of a Leaderboard that are remembered with their nodes, the latest: enough to compare a team's failures with.
const FINISHES: usize = 1_000;
/// How long ended attempts count against further Jobs.
const A_DAY: SignedDuration = SignedDuration::from_hours(24);

/// Attempts of one team that ended because of the infrastructure in ways that an agent can cause, before the present one.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TeamHistory {
    /// Within a day.
    pub within_a_day: usize,
    /// Whether there may have been more of them within a day than their Submissions remember.
    pub may_be_more: bool,
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

/// What the teams of all Leaderboards have come to. Clones are the same.
#[derive(Clone, Default)]
pub struct Teams(Arc<Mutex<HashMap<String, Board>>>);

/// One Leaderboard.
#[derive(Default)]
struct Board {
    teams: BTreeMap<String, Team>,
    /// The latest, the oldest first.
    finishes: BTreeSet<Finish>,
}

#[derive(Default)]
struct Team {
    /// Its Submissions that count for anything here.
    submissions: usize,
    /// Also of one that was deleted since.
    last_finish: Option<Timestamp>,
    /// By the UID of the Submission.
    failures: BTreeMap<String, Failures>,
    gpu_seconds: i64,
}

struct Failures {
    simulator: Option<String>,
    of: InfrastructureFailures,
}

#[derive(Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Finish {
    at: Timestamp,
    uid: String,
    team: String,
    simulator: Option<String>,
    node: Option<String>,
}

/// What a Submission counts for: it has an end of some attempt, or of a Job that had a GPU.
#[derive(PartialEq)]
struct Ended {
    board: String,
    team: String,
    uid: String,
    simulator: Option<String>,
    finish: Option<Finish>,
    failures: Option<InfrastructureFailures>,
    gpu_seconds: i64,
}

impl Teams {
    /// The cache has changed.
    pub fn changed(&self, before: Option<&Submission>, now: Option<&Submission>) {
        let (before, now) = (before.and_then(Ended::of), now.and_then(Ended::of));
        if before == now {
            return;
        }
        let mut boards = lock(&self.0);
        if let Some(ended) = before
            && let Some(board) = boards.get_mut(&ended.board)
        {
            board.leaves(&ended);
            if board.teams.is_empty() {
                boards.remove(&ended.board);
            }
        }
        if let Some(ended) = now {
            boards.entry(ended.board.clone()).or_default().enters(ended);
        }
    }

    /// The history of a submission's team.
    pub fn history(&self, submission: &Submission, now: Timestamp) -> TeamHistory {
        let boards = lock(&self.0);
        let board = boards.get(&key(submission));
        let team = submission.team();
        let found = board
            .zip(team)
            .map(|(board, team)| board.history(submission, team, now));
        found.unwrap_or_default()
    }

    /// The teams of a Leaderboard that have such failures in a row, those with the most first.
    pub fn failures(&self, leaderboard: &Leaderboard) -> Vec<TeamFailures> {
        self.of(leaderboard, Board::failures)
    }

    /// The teams of a Leaderboard that have used the most GPU seconds, the most first.
    pub fn gpu_use(&self, leaderboard: &Leaderboard) -> Vec<TeamUse> {
        self.of(leaderboard, Board::gpu_use)
    }

    fn of<T>(&self, leaderboard: &Leaderboard, read: impl FnOnce(&Board) -> Vec<T>) -> Vec<T> {
        let meta = &leaderboard.metadata;
        let name = meta.name.as_deref().unwrap_or_default();
        let boards = lock(&self.0);
        boards
            .get(&key_of(meta.namespace.as_deref(), name))
            .map(read)
            .unwrap_or_default()
    }
}

impl Ended {
    fn of(submission: &Submission) -> Option<Self> {
        let (finished, failures) = (finish(submission), failures(submission));
        let gpu_seconds = gpu_seconds(submission);
        if finished.is_none() && failures.is_none() && gpu_seconds <= 0 {
            return None;
        }
        let team = submission.team()?.to_owned();
        let uid = submission.metadata.uid.clone().unwrap_or_default();
        let simulator = simulator(submission).map(str::to_owned);
        let finish = finished.map(|at| Finish {
            at,
            uid: uid.clone(),
            team: team.clone(),
            simulator: simulator.clone(),
            node: submission.status.as_ref().and_then(|status| status.node_name.clone()),
        });
        Some(Self {
            board: key(submission),
            team,
            uid,
            simulator,
            finish,
            failures: failures.cloned(),
            gpu_seconds: gpu_seconds.max(0),
        })
    }
}

impl Board {
    fn enters(&mut self, ended: Ended) {
        let team = self.teams.entry(ended.team).or_default();
        team.submissions += 1;
        team.gpu_seconds = team.gpu_seconds.saturating_add(ended.gpu_seconds);
        team.last_finish = team.last_finish.max(ended.finish.as_ref().map(|finish| finish.at));
        if let Some(of) = ended.failures {
            let simulator = ended.simulator;
            team.failures.insert(ended.uid, Failures { simulator, of });
        }
        self.finishes.extend(ended.finish);
        if self.finishes.len() > FINISHES {
            self.finishes.pop_first();
        }
    }

    fn leaves(&mut self, ended: &Ended) {
        if let Some(finish) = &ended.finish {
            self.finishes.remove(finish);
        }
        let Some(team) = self.teams.get_mut(&ended.team) else {
            return;
        };
        team.submissions -= 1;
        team.gpu_seconds = team.gpu_seconds.saturating_sub(ended.gpu_seconds);
        team.failures.remove(&ended.uid);
        if team.submissions == 0 {
            self.teams.remove(&ended.team);
        }
    }

    fn history(&self, submission: &Submission, name: &str, now: Timestamp) -> TeamHistory {
        let Some(team) = self.teams.get(name) else {
            return TeamHistory::default();
        };
        let all = team.failures.values().map(|failures| &failures.of);
        let (within_a_day, may_be_more) = all
            .map(|one| within_a_day(one, now))
            .fold((0, false), |(sum, any), (recent, more)| (sum + recent, any || more));
        let since = team.in_a_row().map(|one| one.first_time.0).min();
        TeamHistory {
            within_a_day,
            may_be_more,
            in_a_row: team.in_a_row().map(number).sum(),
            nodes: team.in_a_row().flat_map(|one| one.nodes.iter().cloned()).collect(),
            others: since.map_or_else(Others::default, |since| self.others(submission, name, since)),
        }
    }

    /// What other teams came to with the same simulator.
    fn others(&self, submission: &Submission, team: &str, since: Timestamp) -> Others {
        let mut found = Others::default();
        let Some(simulator) = simulator(submission) else {
            return found;
        };
        let finishes = self.finishes.iter().rev().take_while(|finish| finish.at >= since);
        for finish in finishes.filter(|one| one.team != team && one.simulator.as_deref() == Some(simulator)) {
            found.finished += 1;
            found.finished_on.extend(finish.node.clone());
        }
        let others = self.teams.iter().filter(|(other, _)| *other != team);
        let failures = others.flat_map(|(_, other)| other.failures.values());
        for one in failures.filter(|one| one.simulator.as_deref() == Some(simulator) && one.of.last_time.0 >= since) {
            found.failed += number(&one.of);
            found.failed_on.extend(one.of.nodes.iter().cloned());
        }
        found
    }

    fn failures(&self) -> Vec<TeamFailures> {
        let of_team = |(name, team): (&String, &Team)| {
            let number = |sum: i32, one: &InfrastructureFailures| sum.saturating_add(one.number);
            Some(TeamFailures {
                team: name.clone(),
                number: team.in_a_row().fold(0, number),
                last_time: team
                    .in_a_row()
                    .map(|one| &one.last_time)
                    .max_by_key(|time| time.0)?
                    .clone(),
            })
        };
        let mut teams: Vec<TeamFailures> = self.teams.iter().filter_map(of_team).collect();
        teams.sort_by(|one, other| other.number.cmp(&one.number).then_with(|| one.team.cmp(&other.team)));
        teams.truncate(MAX_TEAMS);
        teams
    }

    fn gpu_use(&self) -> Vec<TeamUse> {
        let used = self.teams.iter().filter(|(_, team)| team.gpu_seconds > 0);
        let mut found: Vec<(&String, i64)> = used.map(|(name, team)| (name, team.gpu_seconds)).collect();
        found.sort_by_key(|(_, gpu_seconds)| Reverse(*gpu_seconds));
        found.truncate(MAX_USING_TEAMS);
        let shown = found.into_iter().map(|(team, gpu_seconds)| TeamUse {
            team: team.clone(),
            gpu_seconds,
        });
        shown.collect()
    }
}

impl Team {
    /// Failures since it has last finished.
    fn in_a_row(&self) -> impl Iterator<Item = &InfrastructureFailures> {
        let all = self.failures.values().map(|failures| &failures.of);
        all.filter(|one| Some(one.last_time.0) > self.last_finish)
    }
}

fn key(submission: &Submission) -> String {
    key_of(
        submission.metadata.namespace.as_deref(),
        &submission.spec.leaderboard_name,
    )
}

/// Namespace and Leaderboard.
fn key_of(namespace: Option<&str>, leaderboard: &str) -> String {
    format!("{}/{leaderboard}", namespace.unwrap_or_default())
}

/// What the Jobs of a submission have used.
fn gpu_seconds(submission: &Submission) -> i64 {
    let usage = submission.status.as_ref().and_then(|status| status.usage);
    usage.map_or(0, |usage| usage.gpu_seconds)
}

fn failures(submission: &Submission) -> Option<&InfrastructureFailures> {
    submission.status.as_ref()?.infrastructure_failures.as_deref()
}

fn number(failures: &InfrastructureFailures) -> usize {
    usize::try_from(failures.number).unwrap_or(0)
}

/// How many of them ended within a day, as far as the Submission remembers, and whether there may be more.
fn within_a_day(failures: &InfrastructureFailures, now: Timestamp) -> (usize, bool) {
    let known = failures.known_times();
    let recent = known.iter().filter(|time| now.duration_since(time.0) < A_DAY).count();
    (recent, recent == known.len() && recent < number(failures))
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
