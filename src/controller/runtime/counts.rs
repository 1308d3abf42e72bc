//! Joins the controller's parts to the process's metrics: loads and states every few seconds.
//!
//! How many Submissions stand where is counted as their cache changes, so that nobody walks through all.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use jiff::Timestamp;
use kube::ResourceExt;

use super::gpu_holders::{Holder, Holders};
use crate::controller::leaderboards::operator;
use crate::controller::objects::board_name;
use crate::controller::submissions::decide::awaits_publication;
use crate::kubernetes::Store;
use crate::lock::lock;
use crate::observability::Observability;
use crate::observability::metrics::{BoardState, OfSubmission, Standing};
use crate::services::evalai::Hub;
use leaderboard_api::{FailureClass, Leaderboard, State, Submission, SubmissionStatus, conditions, reasons};

/// How often what is not an event is shown: more often than anybody scrapes.
const EVERY: Duration = Duration::from_secs(5);
/// So many failures in a row are worth a host's look.
const REPEATED: i32 = 3;
/// All states, so that one without submissions has 0.
const STATES: [State; 6] = [
    State::Pending,
    State::Running,
    State::Resumed,
    State::Finished,
    State::Failed,
    State::Cancelled,
];
/// What a comparison may show.
const COMPARED: [&str; 4] = [
    reasons::SAME_END,
    reasons::DIFFERENT_END,
    reasons::DIFFERENT_ROUTES,
    reasons::AWAITING_OTHER_END,
];

/// Keeps gauges true until the stop.
pub(super) async fn keep(
    hub: Hub,
    leaderboards: Store<Leaderboard>,
    census: Arc<Census>,
    us: String,
    telemetry: Observability,
) {
    let mut tick = tokio::time::interval(EVERY);
    let mut shown: BTreeSet<String> = BTreeSet::new();
    let mut standings: BTreeMap<Standing, usize> = BTreeMap::new();
    let mut holders: BTreeSet<OfSubmission> = BTreeSet::new();
    loop {
        tokio::select! { _ = tick.tick() => {}, () = telemetry.stop.wait() => return }
        let load = hub.load();
        telemetry.metrics.set_evalai_load(load.used, load.limit, load.waiting);
        for count in standings.values_mut() {
            *count = 0;
        }
        standings.extend(census.standings());
        for (state, count) in states(&standings) {
            telemetry.metrics.set_submissions(state, count);
        }
        for (standing, count) in &standings {
            telemetry.metrics.set_standing(*standing, *count);
        }
        standings.retain(|_, count| *count > 0);
        for (reason, count) in census.compared() {
            telemetry.metrics.set_observed(reason, count);
        }
        telemetry
            .metrics
            .set_repeating_teams(repeating_teams(&leaderboards.state()));
        let now = Timestamp::now();
        let boards = boards(&leaderboards.state(), &census, &us, now);
        for (leaderboard, state) in &boards {
            telemetry.metrics.set_leaderboard(leaderboard, *state);
        }
        for gone in shown.iter().filter(|leaderboard| !boards.contains_key(*leaderboard)) {
            telemetry.metrics.forget_leaderboard(gone);
        }
        holders = show_gpu_use(&telemetry, census.gpu_use(boards.keys(), now), &holders);
        shown = boards.into_keys().collect();
    }
}

/// Shows what the submissions have used that hold GPUs, and those no more that held some before.
fn show_gpu_use(
    telemetry: &Observability,
    used: BTreeMap<OfSubmission, i64>,
    before: &BTreeSet<OfSubmission>,
) -> BTreeSet<OfSubmission> {
    for gone in before.iter().filter(|of| !used.contains_key(*of)) {
        telemetry.metrics.forget_live_gpu_use(gone);
    }
    for (of, seconds) in &used {
        telemetry.metrics.set_live_gpu_use(of, *seconds);
    }
    used.into_keys().collect()
}

/// What there is of Submissions, in numbers.
#[derive(Default)]
pub(super) struct Census(Mutex<Counted>);

#[derive(Default)]
struct Counted {
    standings: BTreeMap<Standing, usize>,
    compared: BTreeMap<&'static str, usize>,
    /// By Leaderboard, as `namespace/name`.
    waits: BTreeMap<String, Waits>,
    holders: Holders,
}

/// Since when Submissions of a Leaderboard wait, and how many since the same time.
#[derive(Default)]
struct Waits {
    pending: BTreeMap<Timestamp, usize>,
    unpublished: BTreeMap<Timestamp, usize>,
}

/// What one Submission adds.
#[derive(PartialEq)]
struct Entry {
    standing: Standing,
    compared: Option<&'static str>,
    wait: Option<Wait>,
    holder: Option<Holder>,
}

#[derive(PartialEq)]
struct Wait {
    board: String,
    is_pending: bool,
    since: Timestamp,
}

impl Census {
    /// The cache has changed.
    pub(super) fn changed(&self, before: Option<&Submission>, now: Option<&Submission>) {
        let (before, now) = (before.map(Entry::of), now.map(Entry::of));
        if before == now {
            return;
        }
        let mut counted = lock(&self.0);
        for (entry, is_there) in [(before, false), (now, true)] {
            if let Some(entry) = entry {
                counted.take(entry, is_there);
            }
        }
    }

    fn standings(&self) -> BTreeMap<Standing, usize> {
        lock(&self.0).standings.clone()
    }

    /// By the reason of their comparison, those without one left out.
    fn compared(&self) -> [(&'static str, usize); COMPARED.len()] {
        let counted = lock(&self.0);
        COMPARED.map(|reason| (reason, counted.compared.get(reason).copied().unwrap_or(0)))
    }

    /// What those submissions of these Leaderboards have used until now that hold GPUs.
    fn gpu_use<'a>(&self, boards: impl Iterator<Item = &'a String>, now: Timestamp) -> BTreeMap<OfSubmission, i64> {
        let counted = lock(&self.0);
        boards.flat_map(|board| counted.holders.gpu_use(board, now)).collect()
    }

    /// How long the oldest have waited.
    fn show_waits(&self, boards: &mut BTreeMap<String, BoardState>, now: Timestamp) {
        let counted = lock(&self.0);
        let age = |waits: &BTreeMap<Timestamp, usize>| {
            let oldest = waits.keys().next().map(|since| now.duration_since(*since));
            oldest.and_then(|age| Duration::try_from(age).ok()).unwrap_or_default()
        };
        for (name, board) in boards {
            if let Some(waits) = counted.waits.get(name) {
                board.oldest_pending = age(&waits.pending);
                board.oldest_unpublished = age(&waits.unpublished);
            }
        }
    }
}

impl Counted {
    fn take(&mut self, entry: Entry, is_there: bool) {
        count(&mut self.standings, entry.standing, is_there);
        if let Some(reason) = entry.compared {
            count(&mut self.compared, reason, is_there);
        }
        if let Some(holder) = entry.holder {
            self.holders.take(holder, is_there);
        }
        let Some(wait) = entry.wait else { return };
        let waits = self.waits.entry(wait.board.clone()).or_default();
        let of_kind = if wait.is_pending {
            &mut waits.pending
        } else {
            &mut waits.unpublished
        };
        count(of_kind, wait.since, is_there);
        if waits.pending.is_empty() && waits.unpublished.is_empty() {
            self.waits.remove(&wait.board);
        }
    }
}

/// Counts one more, or one less.
fn count<K: Ord>(counts: &mut BTreeMap<K, usize>, key: K, is_there: bool) {
    let before = counts.get(&key).copied().unwrap_or(0);
    match if is_there { before + 1 } else { before.saturating_sub(1) } {
        0 => counts.remove(&key),
        number => counts.insert(key, number),
    };
}

impl Entry {
    fn of(submission: &Submission) -> Self {
        let status = submission.status.as_ref();
        let compared = status.and_then(|status| status.condition(conditions::COMPARED));
        let known = |reason: &str| COMPARED.into_iter().find(|known| *known == reason);
        Self {
            standing: standing(submission),
            compared: compared.and_then(|compared| known(&compared.reason)),
            wait: Wait::of(submission),
            holder: Holder::of(submission),
        }
    }
}

impl Wait {
    fn of(submission: &Submission) -> Option<Self> {
        let status = submission.status.as_ref();
        let is_pending = status.is_none_or(|status| status.state_of_conditions() == State::Pending);
        if !is_pending && !status.is_some_and(awaits_publication) {
            return None;
        }
        Some(Self {
            board: board_name(submission.namespace(), &submission.spec.leaderboard_name),
            is_pending,
            since: stands_since(submission)?,
        })
    }
}

/// Since when it waits to run, or is over. A resume makes `Finished` False again, and a Job that is to be replaced `Running`. A new
/// object has no condition yet.
fn stands_since(submission: &Submission) -> Option<Timestamp> {
    let status = submission.status.as_ref();
    let since = |name| {
        let condition = status.and_then(|status| status.condition(name));
        condition.map(|condition| &condition.last_transition_time)
    };
    let changes = [since(conditions::FINISHED), since(conditions::RUNNING)];
    let since = (changes.into_iter().flatten().max()).or(submission.metadata.creation_timestamp.as_ref());
    since.map(|time| time.0)
}

/// Its state, reason and class of failure.
fn standing(submission: &Submission) -> Standing {
    let status = submission.status.as_ref();
    let state = status.map_or(State::Pending, SubmissionStatus::state_of_conditions);
    let failure = status.and_then(|status| status.failure.as_ref());
    let class = failure.filter(|_| state == State::Failed).map(|failure| failure.class);
    let reason = status.and_then(|status| status.reason.as_deref());
    Standing {
        state: state.as_str(),
        reason: match reason.unwrap_or_default() {
            "" => "None",
            name => reasons::of(name).map_or("Other", |reason| reason.name),
        },
        class: class.map_or("", FailureClass::as_str),
    }
}

/// Submissions by state.
fn states(standings: &BTreeMap<Standing, usize>) -> BTreeMap<&'static str, usize> {
    let mut counts: BTreeMap<_, _> = STATES.iter().map(|state| (state.as_str(), 0)).collect();
    for (standing, count) in standings {
        *counts.entry(standing.state).or_default() += count;
    }
    counts
}

/// The Leaderboards that this installation, `us`, drives, each as `namespace/name`.
fn boards(
    leaderboards: &[Arc<Leaderboard>],
    census: &Census,
    us: &str,
    now: Timestamp,
) -> BTreeMap<String, BoardState> {
    let ours = leaderboards
        .iter()
        .filter(|leaderboard| operator::is_ours(leaderboard, us));
    let state = |leaderboard: &Leaderboard| BoardState {
        is_ready: leaderboard
            .condition(conditions::READY)
            .is_some_and(|ready| ready.status == "True"),
        ..BoardState::default()
    };
    let mut boards: BTreeMap<_, _> = ours
        .map(|leaderboard| {
            let name = board_name(leaderboard.namespace(), &leaderboard.name_any());
            (name, state(leaderboard))
        })
        .collect();
    census.show_waits(&mut boards, now);
    boards
}

/// Teams that have had this often in a row what an agent can cause, by the statuses of the Leaderboards.
fn repeating_teams(leaderboards: &[Arc<Leaderboard>]) -> usize {
    let statuses = leaderboards
        .iter()
        .filter_map(|leaderboard| leaderboard.status.as_ref());
    let teams = statuses.flat_map(|status| &status.infrastructure_failures);
    teams.filter(|team| team.number >= REPEATED).count()
}

#[cfg(test)]
#[path = "counts_tests.rs"]
mod tests;
