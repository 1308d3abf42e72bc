//! Decides if a run goes on, is wound down, or has ended: a pure function of the findings of a round. [`Judge`] remembers
//! since when each of them holds.
//!
//! Called by `logcopy`. Knows no clock but the one handed in, no file and no S3.

use std::time::Duration;

use crate::{Gathered, WorkerSeen};
use leaderboard_contract::report::RefusedResults;
use leaderboard_contract::run::Stop;

/// How a run ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Ending {
    /// The results are complete.
    Complete,
    /// It was stopped from outside; the results are what there is.
    Stopped(Stop),
    /// A worker has come to its end with results that are refused, which is the participant's fault.
    Invalid(RefusedResults),
    /// A worker has come to its end with results that the host's own evaluator has spoiled.
    Unusable(RefusedResults),
}

impl std::fmt::Display for Ending {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Complete => f.write_str("the results are complete"),
            Self::Stopped(stop) => write!(f, "the run was stopped ({})", stop.as_str()),
            Self::Invalid(refused) | Self::Unusable(refused) => write!(f, "the results can't be used: {refused}"),
        }
    }
}

/// The next step of `logcopy`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Step {
    /// Nothing out of the ordinary.
    GoOn,
    /// Ask all containers to stop, and have another round soon.
    Cancel,
    /// Store the final report.
    Finish(Ending),
}

/// The findings of one round, and for how long each has held.
#[derive(Clone, Debug, PartialEq, Eq, Default)]
pub struct Situation {
    /// No unit of work is missing.
    pub whole: bool,
    /// No unit of work is missing and every evaluator has come to its regular end, for this long.
    pub complete: Option<Duration>,
    /// All workers report that they are done.
    pub all_done: bool,
    /// Some container has begun.
    pub any_started: bool,
    /// A stop is requested.
    pub stop: Option<Stop>,
    /// The end that a worker has brought about, and for how long.
    pub spoiled: Option<(Ending, Duration)>,
    /// `simulation.cancel` is there for this long.
    pub cancelled: Option<Duration>,
    /// The workers' folders have not changed for this long.
    pub quiet: Duration,
}

/// The next step. `cancel` is the run's time for a cancel; at least half of it is left for storing.
pub fn decide(seen: &Situation, pace: &Pace, cancel: Duration) -> Step {
    // An evaluator with a record of each route, but no regular end, repeats the last route if its container comes back.
    let settled = (seen.whole && seen.all_done) || seen.complete.is_some_and(|since| since >= pace.settle);
    if let (true, None) = (settled, seen.stop) {
        return Step::Finish(Ending::Complete);
    }
    let spoiled = seen.spoiled.as_ref().filter(|(_, since)| *since >= pace.quiet);
    let ending = match (seen.stop, spoiled) {
        (Some(stop), _) => Ending::Stopped(stop),
        (None, Some((spoiled, _))) => spoiled.clone(),
        (None, None) => return Step::GoOn,
    };
    if settled || seen.all_done {
        return Step::Finish(ending);
    }
    let Some(cancelled) = seen.cancelled else {
        return Step::Cancel;
    };
    // The other half of the time is for storing.
    let longest = pace.grace.min(cancel.checked_div(2).unwrap_or_default());
    let is_still = cancelled.min(seen.quiet) >= pace.quiet.min(longest);
    if !seen.any_started || is_still || cancelled >= longest {
        Step::Finish(ending)
    } else {
        Step::GoOn
    }
}

/// Remembers since when something is so.
#[derive(Debug, Default)]
pub struct Judge {
    complete: Option<Duration>,
    spoiled: Option<(Ending, Duration)>,
    cancelled: Option<Duration>,
    quiet: Duration,
    activity: Option<u64>,
}

/// The input of [`Judge::see`] besides the results.
#[derive(Clone, Copy, Debug)]
pub struct Outside {
    /// A stop is requested.
    pub stop: Option<Stop>,
    /// `simulation.cancel` is there.
    pub cancelled: bool,
    /// A digest of the workers' folders: another one means that something was written.
    pub activity: u64,
    /// Clock of this process.
    pub now: Duration,
}

impl Judge {
    /// Takes in one round.
    pub fn see(&mut self, gathered: &Gathered, outside: Outside) -> Situation {
        let now = outside.now;
        let whole = gathered.is_complete();
        self.complete = (whole && gathered.has_ended()).then(|| self.complete.unwrap_or(now));
        self.spoiled = spoiled(gathered).map(|ending| {
            let since = self.spoiled.as_ref().map_or(now, |(_, since)| *since);
            (ending, since)
        });
        self.cancelled = outside.cancelled.then(|| self.cancelled.unwrap_or(now));
        if self.activity != Some(outside.activity) {
            self.activity = Some(outside.activity);
            self.quiet = now;
        }
        let since = |then: Duration| now.saturating_sub(then);
        Situation {
            whole,
            complete: self.complete.map(since),
            all_done: gathered.seen.iter().all(|worker| worker.done),
            any_started: gathered.seen.iter().any(WorkerSeen::has_started),
            stop: outside.stop,
            spoiled: self.spoiled.clone().map(|(ending, then)| (ending, since(then))),
            cancelled: self.cancelled.map(since),
            quiet: since(self.quiet),
        }
    }
}

/// A worker that reports it is done without complete results will not get them any more. Its report alone ends nothing well: it can only
/// end its own run badly. Nothing is known of results that this node can't read: if that lasts, the run ends without final results, which
/// is the infrastructure's failure.
fn spoiled(gathered: &Gathered) -> Option<Ending> {
    if gathered.is_complete() {
        return None;
    }
    let workers = gathered.seen.iter().zip(&gathered.unreadable).zip(&gathered.if_ended);
    let short = workers.filter_map(|((seen, unreadable), ending)| {
        let is_known = seen.done && !unreadable;
        ending.as_ref().filter(|_| is_known)
    });
    let all_done = gathered.seen.iter().all(|worker| worker.done);
    let unmerged = gathered.unmerged.iter().filter(|_| all_done);
    // One refusal refuses all.
    let first = short
        .chain(unmerged)
        .min_by_key(|ending| !matches!(ending, Ending::Invalid(_)));
    first.cloned()
}

/// How long the programs wait for what they cannot observe.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pace {
    /// From complete results to the end, when a worker does not report that it is done.
    pub settle: Duration,
    /// Without a change in the workers' folders, they count as stopped.
    pub quiet: Duration,
    /// From a cancel to the last round, when they are never quiet: the runner's grace and a margin.
    pub grace: Duration,
    /// Smallest time between two rounds.
    pub least: Duration,
    /// Longest pause after rounds that failed.
    pub backoff: Duration,
    /// Shortest time that logs get in a round of a running run.
    pub logs: Duration,
    /// Further time for a file that is being sent when the time for logs ends. It delays the next report by no more than this.
    pub in_air: Duration,
    /// How long a network plugin may take until it enforces the policy of a new Pod.
    pub enforced_within: Duration,
}

impl Default for Pace {
    fn default() -> Self {
        Self {
            settle: Duration::from_secs(30),
            quiet: Duration::from_secs(5),
            grace: Duration::from_secs(25),
            least: Duration::from_secs(1),
            backoff: Duration::from_mins(1),
            logs: Duration::from_secs(10),
            in_air: Duration::from_mins(1),
            enforced_within: Duration::from_mins(1),
        }
    }
}

impl Pace {
    /// All times divided: for runs that take seconds.
    #[must_use]
    pub fn faster(self, times: u32) -> Self {
        let part = |whole: Duration| whole.checked_div(times).unwrap_or(whole);
        Self {
            settle: part(self.settle),
            quiet: part(self.quiet),
            grace: part(self.grace),
            least: part(self.least),
            backoff: part(self.backoff),
            // A network gets no faster.
            logs: self.logs,
            in_air: self.in_air,
            enforced_within: part(self.enforced_within),
        }
    }
}

#[cfg(test)]
mod file_tests;
#[cfg(test)]
mod tests;
