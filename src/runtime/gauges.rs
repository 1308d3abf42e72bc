//! The leader's samples of all objects: one walk over the caches every 15 s. It wakes each Leaderboard whose status has other counts, or
//! standings of other results.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use kube::ResourceExt;
use kube::runtime::reflector::ObjectRef;

use super::Shared;
use super::queue::{Class, Queue};
use super::reconciles::{LEADERBOARD, SUBMISSION};
use crate::leaderboards::state::LeaderboardState;
use crate::leaderboards::{self, operator};
use crate::metrics::OTHERS;
use crate::metrics::leader::{self, Samples};
use crate::observability::Observability;
use crate::runtime::objects::{board_of, key_of, uid};
use leaderboard_api::{FailureClass, Leaderboard, ReasonName, State, Submission, SubmissionStatus, conditions};
use leaderboard_policy::census::Census;
use leaderboard_policy::submissions::awaits_publication;

/// More often than anybody scrapes.
pub(super) const EVERY: Duration = Duration::from_secs(15);
/// Submissions of a Leaderboard that have a sample of their own.
const MAX_SHOWN: usize = 500;
/// All states, so that one without submissions has 0.
const STATES: [State; 6] = [
    State::Pending,
    State::Running,
    State::Resumed,
    State::Finished,
    State::Failed,
    State::Cancelled,
];

/// Shows what a walk finds, at once and then `every` so often, until the stop.
pub(super) async fn keep(every: Duration, walk: impl Fn() -> Samples, telemetry: Observability) {
    let mut tick = tokio::time::interval(every);
    loop {
        tokio::select! {
            biased;
            () = telemetry.stop.wait() => return,
            _ = tick.tick() => telemetry.metrics.show(walk()),
        }
    }
}

/// One walk.
pub(super) fn walk(shared: &Shared, now: Timestamp) -> Samples {
    let (context, mut samples) = (&shared.context, Samples::default());
    let us = &context.settings.operator;
    let mut boards = context.stores.leaderboards.state();
    boards.retain(|board| operator::is_ours(board, us));
    let submissions = context.stores.submissions.state();
    show_states(&mut samples, &submissions);
    for board in show_boards(&mut samples, &boards, &submissions, &context.leaderboards, now) {
        shared.queues.leaderboards.add(&board, Class::Refresh);
    }
    for board in &boards {
        leaderboards::show_limits(&mut samples, context.for_leaderboards(), board);
    }
    let load = context.external.hub.load();
    samples.set(&leader::EVALAI_BUDGET_USED, [], load.used);
    samples.set(&leader::EVALAI_BUDGET_LIMIT, [], load.limit);
    samples.set(&leader::EVALAI_WAITING, [], load.waiting);
    show_queue(&mut samples, SUBMISSION, &shared.queues.submissions);
    show_queue(&mut samples, LEADERBOARD, &shared.queues.leaderboards);
    samples
}

fn show_queue(samples: &mut Samples, kind: &str, queue: &Queue) {
    for (class, depth) in Class::ALL.into_iter().zip(queue.depth()) {
        samples.set(&leader::RECONCILES_WAITING, [kind, class.as_str()], depth);
    }
}

/// How many Submissions stand where.
fn show_states(samples: &mut Samples, submissions: &[Arc<Submission>]) {
    let mut states = STATES.map(|state| (state.as_str(), 0)).into();
    let mut standings = BTreeMap::new();
    for submission in submissions {
        let standing = standing(submission);
        count(&mut states, standing[0]);
        count(&mut standings, standing);
    }
    for (state, number) in states {
        samples.set(&leader::SUBMISSIONS, [state], number);
    }
    for (standing, number) in standings {
        samples.set(&leader::SUBMISSIONS_BY_REASON, standing, number);
    }
}

fn count<K: Ord>(counts: &mut BTreeMap<K, i64>, key: K) {
    *counts.entry(key).or_default() += 1;
}

/// State, reason and class of failure.
fn standing(submission: &Submission) -> [&'static str; 3] {
    let status = submission.status.as_ref();
    let state = status.map_or(State::Pending, SubmissionStatus::state_of_conditions);
    let failure = status.and_then(|status| status.failure.as_ref());
    let class = failure.filter(|_| state == State::Failed).map(|failure| failure.class);
    let reason = status.and_then(SubmissionStatus::present_reason);
    let reason = reason.as_ref().map_or("None", ReasonName::label);
    [state.as_str(), reason, class.map_or("", FailureClass::as_str)]
}

/// The sums over the Submissions of a Leaderboard.
#[derive(Default)]
struct OfBoard {
    census: Census,
    pending_since: Option<Timestamp>,
    unpublished_since: Option<Timestamp>,
    slots_in_use: i64,
    /// GPU seconds of those that hold GPUs. The earliest first, so that a submission keeps its sample when others come.
    holders: BTreeMap<(Timestamp, String), i64>,
}

/// How each Leaderboard stands, how long its submissions have waited, and what they use. Returns those whose status has other counts, or standings
/// of other results.
fn show_boards(
    samples: &mut Samples,
    leaderboards: &[Arc<Leaderboard>],
    submissions: &[Arc<Submission>],
    state: &LeaderboardState,
    now: Timestamp,
) -> Vec<ObjectRef<Leaderboard>> {
    let known = |leaderboard| (ObjectRef::from_obj(leaderboard), (leaderboard, OfBoard::default()));
    let mut boards: HashMap<_, _> = leaderboards.iter().map(AsRef::as_ref).map(known).collect();
    for submission in submissions {
        if let Some((_, board)) = boards.get_mut(&board_of(submission)) {
            board.add(submission, now);
        }
    }
    let mut stale = Vec::new();
    for (reference, (leaderboard, board)) in boards {
        let name = key_of(leaderboard).to_string();
        let ready = leaderboard.condition(conditions::READY);
        let is_ready = ready.is_some_and(|ready| ready.status == "True");
        samples.set(&leader::READY, [&name], i64::from(is_ready));
        board.show(samples, &name, now);
        let counts = leaderboard.status.as_ref().and_then(|status| status.counts);
        let lacks_results = state.lacks_results(uid(leaderboard), board.census.results);
        if counts != Some(board.census.counts) || lacks_results {
            stale.push(reference);
        }
    }
    stale
}

impl OfBoard {
    fn add(&mut self, submission: &Submission, now: Timestamp) {
        self.census.add(submission);
        self.add_holder(submission, now);
        let status = submission.status.as_ref();
        self.slots_in_use += i64::from(status.is_some_and(SubmissionStatus::has_slot));
        let oldest = if status.is_none_or(|status| status.state_of_conditions() == State::Pending) {
            &mut self.pending_since
        } else if status.is_some_and(awaits_publication) {
            &mut self.unpublished_since
        } else {
            return;
        };
        *oldest = [*oldest, stands_since(submission)].into_iter().flatten().min();
    }

    /// Adds the GPU seconds of a submission that holds GPUs. They end with the loss of its Pod, if that is known: those of the next Pod
    /// count from its node on.
    fn add_holder(&mut self, submission: &Submission, now: Timestamp) {
        let live = submission.status.as_ref().filter(|status| !status.has_ended());
        let Some((status, since)) = live.and_then(|status| Some((status, status.times.scheduled.as_ref()?.0))) else {
            return;
        };
        let running = status
            .condition(conditions::RUNNING)
            .filter(|running| running.status != "True");
        let lost = running
            .map(|running| running.last_transition_time.0)
            .filter(|lost| *lost > since);
        if let Some(mut used) = status.usage.filter(|used| used.gpus > 0) {
            used.add(lost.unwrap_or(now).duration_since(since).as_secs());
            self.holders.insert((since, submission.name_any()), used.gpu_seconds);
        }
    }

    fn show(&self, samples: &mut Samples, name: &str, now: Timestamp) {
        let age = |since: Option<Timestamp>| since.map_or(0, |since| now.duration_since(since).as_secs().max(0));
        samples.set(&leader::SLOTS_IN_USE, [name], self.slots_in_use);
        samples.set(&leader::OLDEST_PENDING, [name], age(self.pending_since));
        samples.set(&leader::OLDEST_UNPUBLISHED, [name], age(self.unpublished_since));
        for ((_, submission), used) in self.holders.iter().take(MAX_SHOWN) {
            samples.set(&leader::GPU_SECONDS, [name, submission], *used);
        }
        let others = self.holders.values().skip(MAX_SHOWN).copied();
        if let Some(used) = others.reduce(i64::saturating_add) {
            samples.set(&leader::GPU_SECONDS, [name, OTHERS], used);
        }
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

#[cfg(test)]
mod tests;
