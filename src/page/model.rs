//! The contents of the page, made of the cached Submissions and Leaderboards. Pure: the time is handed in.
//!
//! It has a bounded size however many objects there are: each list has its first so many, and how many there are in all.

use std::collections::BTreeMap;
use std::sync::Arc;

use jiff::{SignedDuration, Timestamp};
use kube::ResourceExt;
use leaderboard_api::text::{LONGEST_MESSAGE, one_line, sentence};
use leaderboard_api::{Leaderboard, State, Submission, SubmissionStatus, conditions};
use serde::Serialize;

use super::links;
use super::phases::{Phases, Typical, typical};
use super::rows::{Ended, Failed, Runs, Waits, end};
use super::standings::{Table, tables};

/// The longest lists. A view of all of them at their longest is under three quarters of a megabyte.
const LEADERBOARDS: usize = 50;
const TABLES: usize = 24;
const WAITING: usize = 200;
const RUNNING: usize = 60;
const ENDED: usize = 40;
const FAILURES: usize = 20;
/// A typical run is that of so many that ended last.
const TYPICAL: usize = 50;
/// A failure is recent for so many hours.
const RECENT_HOURS: i64 = 24;

/// Which replica answers, and of which installation.
#[derive(Serialize, Clone, Copy, Debug)]
#[serde(rename_all = "camelCase")]
pub(super) struct Replica<'a> {
    pub name: &'a str,
    /// Title that the installation has, or an empty text.
    pub title: &'a str,
    pub leads: bool,
    /// Its caches hold everything.
    pub is_complete: bool,
}

/// Everything that is shown.
#[derive(Serialize, Debug)]
pub(super) struct PageView<'a> {
    replica: Replica<'a>,
    version: &'static str,
    standings: List<Table>,
    leaderboards: List<Board>,
    waiting: List<Waits>,
    running: List<Runs>,
    ended: List<Ended>,
    failures: Failures,
}

/// The first of many.
#[derive(Serialize, Debug, PartialEq, Eq)]
pub(super) struct List<T> {
    /// How many there are in all.
    count: usize,
    rows: Vec<T>,
}

/// One Leaderboard.
#[derive(Serialize, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
struct Board {
    namespace: String,
    name: String,
    /// Why it is not Ready, if it is not.
    trouble: Option<String>,
    is_paused: bool,
    /// How many may run at once; none if nothing limits them.
    slots: Option<i32>,
    #[serde(flatten)]
    tally: Tally,
    evalai: Option<Budget>,
    /// Address of the challenge's page in EvalAI.
    challenge: Option<String>,
    typical: Option<Typical>,
}

/// Requests to EvalAI.
#[derive(Serialize, Debug, PartialEq, Eq)]
struct Budget {
    used: i32,
    limit: i32,
    /// Results that EvalAI does not have yet.
    waiting: i32,
}

/// Failures of the last hours.
#[derive(Serialize, Debug)]
struct Failures {
    classes: Vec<FailureCount>,
    #[serde(flatten)]
    list: List<Failed>,
}

/// How many failed for one reason.
#[derive(Serialize, Debug, PartialEq, Eq)]
struct FailureCount {
    class: &'static str,
    reason: String,
    count: usize,
}

/// Namespace and name.
type Key = (String, String);

/// The submissions of each kind, in the order in which they are shown.
#[derive(Default)]
struct Sorted<'a> {
    waiting: Vec<&'a Submission>,
    running: Vec<&'a Submission>,
    ended: Vec<(&'a Submission, State)>,
}

/// Numbers of a Leaderboard's submissions.
#[derive(Serialize, Default, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
struct Tally {
    /// How many slots are taken: a Pod that starts has one and does not run yet.
    in_use: usize,
    running: usize,
    waiting: usize,
    finished: usize,
    failed: usize,
    cancelled: usize,
    #[serde(skip)]
    last_runs: Vec<Phases>,
}

impl<'a> PageView<'a> {
    pub(super) fn of(
        replica: Replica<'a>,
        leaderboards: &[Arc<Leaderboard>],
        submissions: &[Arc<Submission>],
        now: Timestamp,
    ) -> Self {
        let leaderboards = by_name(leaderboards);
        let sorted = Sorted::of(submissions);
        let ended = sorted.ended.iter();
        Self {
            replica,
            version: env!("CARGO_PKG_VERSION"),
            standings: standings(&leaderboards),
            leaderboards: boards(&leaderboards, sorted.tallies()),
            waiting: List::of(&sorted.waiting, WAITING, |one| Waits::of(one)),
            running: List::of(&sorted.running, RUNNING, |one| Runs::of(one)),
            ended: List::of(&sorted.ended, ENDED, |(one, state)| Ended::of(one, *state)),
            failures: failures(ended.map(|(one, _)| *one), now),
        }
    }
}

impl<T> List<T> {
    fn of<S>(all: &[S], most: usize, row: impl Fn(&S) -> T) -> Self {
        Self {
            count: all.len(),
            rows: all.iter().take(most).map(row).collect(),
        }
    }
}

fn key(submission: &Submission) -> Key {
    let namespace = submission.namespace().unwrap_or_default();
    (namespace, submission.spec.leaderboard_name.clone())
}

impl<'a> Sorted<'a> {
    fn of(submissions: &'a [Arc<Submission>]) -> Self {
        let mut sorted = Self::default();
        for submission in submissions.iter().map(Arc::as_ref) {
            match submission.status.as_ref().and_then(SubmissionStatus::known_state) {
                None | Some(State::Pending) => sorted.waiting.push(submission),
                Some(State::Running | State::Resumed) => sorted.running.push(submission),
                Some(state) => sorted.ended.push((submission, state)),
            }
        }
        let created = |one: &Submission| one.metadata.creation_timestamp.as_ref().map(|time| time.0);
        let place = |one: &Submission| {
            let waiting = one.status.as_ref().and_then(|status| status.waiting.as_ref());
            waiting.map_or(i32::MAX, |waiting| waiting.position)
        };
        // Submissions in a line come first, each line in one piece.
        sorted.waiting.sort_by_cached_key(|one| {
            let place = place(one);
            (place == i32::MAX, key(one), place, created(one), one.name_any())
        });
        let started = |one: &Submission| {
            let status = one.status.as_ref();
            status.and_then(|status| status.times.started.as_ref().map(|time| time.0))
        };
        sorted
            .running
            .sort_by_cached_key(|one| (key(one), started(one), one.name_any()));
        sorted
            .ended
            .sort_by_cached_key(|(one, _)| (std::cmp::Reverse(end(one)), one.name_any()));
        sorted
    }

    fn tallies(&self) -> BTreeMap<Key, Tally> {
        let mut tallies: BTreeMap<Key, Tally> = BTreeMap::new();
        let has_slot = |one: &&&Submission| one.status.as_ref().is_some_and(SubmissionStatus::has_slot);
        for one in self.waiting.iter().chain(&self.running).filter(has_slot) {
            tallies.entry(key(one)).or_default().in_use += 1;
        }
        for one in &self.waiting {
            tallies.entry(key(one)).or_default().waiting += 1;
        }
        for one in &self.running {
            tallies.entry(key(one)).or_default().running += 1;
        }
        for (one, state) in &self.ended {
            let tally = tallies.entry(key(one)).or_default();
            match state {
                State::Failed => tally.failed += 1,
                State::Cancelled => tally.cancelled += 1,
                _ => tally.finished += 1,
            }
            // A check does a small part of the work: it says nothing about how long a run takes.
            let counts = *state == State::Finished && !one.spec.check;
            if counts && tally.last_runs.len() < TYPICAL {
                tally.last_runs.push(Phases::of(one));
            }
        }
        tallies
    }
}

fn name(leaderboard: &Leaderboard) -> Key {
    (leaderboard.namespace().unwrap_or_default(), leaderboard.name_any())
}

fn by_name(leaderboards: &[Arc<Leaderboard>]) -> Vec<&Leaderboard> {
    let mut all: Vec<&Leaderboard> = leaderboards.iter().map(Arc::as_ref).collect();
    all.sort_by_cached_key(|board| name(board));
    all
}

fn standings(leaderboards: &[&Leaderboard]) -> List<Table> {
    let tables: Vec<Table> = leaderboards.iter().flat_map(|board| tables(board)).collect();
    List::of(&tables, TABLES, Table::clone)
}

fn boards(leaderboards: &[&Leaderboard], mut tallies: BTreeMap<Key, Tally>) -> List<Board> {
    let first = leaderboards.iter().take(LEADERBOARDS);
    let rows = first.map(|leaderboard| {
        let tally = tallies.remove(&name(leaderboard)).unwrap_or_default();
        board(leaderboard, tally)
    });
    List {
        count: leaderboards.len(),
        rows: rows.collect(),
    }
}

fn board(leaderboard: &Leaderboard, tally: Tally) -> Board {
    let usage = leaderboard.status.as_ref().and_then(|status| status.evalai.as_ref());
    let budget = usage.map(|usage| Budget {
        used: usage.requests_last_minute,
        limit: usage.requests_per_minute,
        waiting: usage.backlog.as_ref().map_or(0, |backlog| backlog.waiting),
    });
    Board {
        namespace: leaderboard.namespace().unwrap_or_default(),
        name: leaderboard.name_any(),
        trouble: trouble(leaderboard),
        is_paused: leaderboard.spec.paused,
        slots: leaderboard.spec.concurrency.total,
        typical: typical(&tally.last_runs),
        tally,
        evalai: budget,
        challenge: leaderboard.spec.evalai.as_ref().and_then(links::challenge),
    }
}

fn trouble(leaderboard: &Leaderboard) -> Option<String> {
    let status = leaderboard.status.as_ref();
    let ready = status.and_then(|status| conditions::get(&status.conditions, conditions::READY));
    let Some(ready) = ready else {
        return Some("The operator has not processed it yet.".to_owned());
    };
    let text = format!("{}: {}", ready.reason, sentence(&ready.message));
    (ready.status != "True").then(|| one_line(&text, LONGEST_MESSAGE))
}

/// The submissions that failed lately, the latest first.
fn failures<'a>(ended: impl Iterator<Item = &'a Submission>, now: Timestamp) -> Failures {
    let limit = SignedDuration::from_hours(RECENT_HOURS);
    let recent = ended.take_while(|one| end(one).is_some_and(|at| now.duration_since(at) <= limit));
    let failed: Vec<_> = recent
        .filter_map(|one| one.status.as_ref().map(|status| (one, status)))
        .filter(|(_, status)| status.known_state() == Some(State::Failed))
        .filter_map(|(one, status)| Some((one, status.failure.as_ref()?)))
        .collect();
    let mut counts: BTreeMap<(&'static str, &str), usize> = BTreeMap::new();
    for (_, failure) in &failed {
        *counts
            .entry((failure.class.as_str(), failure.reason.as_str()))
            .or_default() += 1;
    }
    let class = |((class, reason), count): ((&'static str, &str), usize)| FailureCount {
        class,
        reason: one_line(reason, 64),
        count,
    };
    let mut classes: Vec<FailureCount> = counts.into_iter().map(class).collect();
    classes.sort_by_key(|class| std::cmp::Reverse(class.count));
    classes.truncate(FAILURES);
    Failures {
        classes,
        list: List::of(&failed, FAILURES, |(one, failure)| Failed::of(one, failure)),
    }
}

#[cfg(test)]
mod tests;
