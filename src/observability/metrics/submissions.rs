//! Submissions: how many stand where, what they used, how they failed. The leader alone counts them.

use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::Registry;

use super::labels::{OfFailure, OfTrack, Reason, Standing, State};
use super::leader::LeaderGauge;
use super::{Metrics, whole, zero};

#[derive(Debug)]
pub(super) struct Submissions {
    states: Family<State, Gauge>,
    reasons: Family<Standing, Gauge>,
    observed: Family<Reason, Gauge>,
    repeating_teams: LeaderGauge,
    failures: Family<OfFailure, Counter>,
    gpu: Family<OfTrack, Counter>,
}

impl Submissions {
    pub(super) fn new(r: &mut Registry) -> Self {
        Self {
            states: zero(r, "submissions", "Submissions by state"),
            reasons: zero(
                r,
                "submissions_by_reason",
                "Submissions by the reason of their state; `class` is that of the failure, or empty",
            ),
            observed: zero(
                r,
                "observed_submissions",
                "Submissions that are only observed, by what their comparison shows",
            ),
            repeating_teams: zero(
                r,
                "teams_with_repeated_infrastructure_failures",
                "Teams with 3 attempts in a row or more that ended because of the infrastructure in ways that an agent can cause",
            ),
            failures: zero(
                r,
                "submission_failures",
                "Attempts that have failed while this process led; `charged` is `true` where EvalAI counts the attempt",
            ),
            gpu: zero(
                r,
                "gpu_seconds",
                "GPUs times seconds of the Jobs that have ended while this process led, by Leaderboard and track",
            ),
        }
    }

    pub(super) fn leave_to_the_leader(&self) {
        self.states.clear();
        self.reasons.clear();
        self.observed.clear();
        self.repeating_teams.clear();
    }
}

/// An attempt that has failed. `class` and `reason` are of closed sets.
#[derive(Clone, Debug)]
pub struct FailedAttempt {
    /// `namespace/name`.
    pub leaderboard: String,
    pub class: &'static str,
    pub reason: &'static str,
    pub is_charged: bool,
}

impl Metrics {
    /// So many Submissions are in a state. States with none are to be set, too.
    pub fn set_submissions(&self, state: &'static str, count: usize) {
        self.submissions
            .states
            .get_or_create(&State { state })
            .set(whole(count));
    }

    /// So many Submissions stand like this; with none the sample goes.
    pub fn set_standing(&self, standing: Standing, count: usize) {
        let reasons = &self.submissions.reasons;
        if count == 0 {
            reasons.remove(&standing);
        } else {
            reasons.get_or_create(&standing).set(whole(count));
        }
    }

    /// So many Submissions that are only observed show this. Reasons with none are to be set, too.
    pub fn set_observed(&self, reason: &'static str, count: usize) {
        let observed = &self.submissions.observed;
        observed.get_or_create(&Reason { reason }).set(whole(count));
    }

    /// So many teams have repeated failures that an agent can cause.
    pub fn set_repeating_teams(&self, count: usize) {
        self.submissions.repeating_teams.set(whole(count));
    }

    /// A Job that has ended had so many GPUs for so long. `leaderboard` has its namespace before it.
    pub fn gpus_used(&self, leaderboard: String, track: String, seconds: u64) {
        let of = OfTrack { leaderboard, track };
        self.submissions.gpu.get_or_create(&of).inc_by(seconds);
    }

    /// The failure of an attempt is stored.
    pub fn attempt_failed(&self, failed: FailedAttempt) {
        let of = OfFailure {
            leaderboard: failed.leaderboard,
            class: failed.class,
            reason: failed.reason,
            charged: if failed.is_charged { "true" } else { "false" },
        };
        self.submissions.failures.get_or_create(&of).inc();
    }
}
