//! Submissions: how many stand where, what they used, how they failed. The leader alone counts them.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Mutex, PoisonError};

use leaderboard_api::text::{LONGEST_NAME, one_line};
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::Registry;

use super::labels::{OfFailure, OfSubmission, OfTeam, OfTrack, Reason, Standing, State};
use super::leader::LeaderGauge;
use super::{Metrics, whole, zero};

/// Teams of a Leaderboard that have a sample of their own: a series for each of thousands would burden Prometheus.
const MAX_TEAMS: usize = 50;
/// The team of all others, and the submission of all others.
pub const OTHERS: &str = "other";

#[derive(Debug)]
pub(super) struct Submissions {
    states: Family<State, Gauge>,
    reasons: Family<Standing, Gauge>,
    observed: Family<Reason, Gauge>,
    repeating_teams: LeaderGauge,
    failures: Family<OfFailure, Counter>,
    gpu: Family<OfTrack, Counter>,
    team_gpu: Family<OfTeam, Counter>,
    live_gpu: Family<OfSubmission, Gauge>,
    /// Those with a sample of their own, by Leaderboard.
    teams: Mutex<BTreeMap<String, BTreeSet<String>>>,
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
            team_gpu: zero(
                r,
                "team_gpu_seconds",
                "GPUs times seconds as in `leaderboard_gpu_seconds_total`, by Leaderboard and team, as `status.gpuUse` names it: the first 50 teams of a Leaderboard, all others as `other`",
            ),
            live_gpu: zero(
                r,
                "submission_gpu_seconds",
                "GPUs times seconds that a submission has used so far, over all its Jobs, while it holds GPUs; of a Leaderboard the first 500, all others together as `other`",
            ),
            teams: Mutex::default(),
        }
    }

    /// How a team is called in a label.
    fn label_of(&self, leaderboard: &str, team: &str) -> String {
        let team = one_line(team, LONGEST_NAME);
        let mut teams = self.teams.lock().unwrap_or_else(PoisonError::into_inner);
        let known = teams.entry(leaderboard.to_owned()).or_default();
        if known.contains(&team) || known.len() < MAX_TEAMS {
            known.insert(team.clone());
            team
        } else {
            OTHERS.to_owned()
        }
    }

    pub(super) fn leave_to_the_leader(&self) {
        self.states.clear();
        self.reasons.clear();
        self.observed.clear();
        self.repeating_teams.clear();
        self.live_gpu.clear();
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

    /// A Job that has ended had so many GPUs for so long. `leaderboard` has its namespace before it; a local submission may have no team.
    pub fn gpus_used(&self, leaderboard: String, track: String, team: Option<&str>, seconds: u64) {
        if let Some(team) = team {
            let team = self.submissions.label_of(&leaderboard, team);
            let of = OfTeam {
                leaderboard: leaderboard.clone(),
                team,
            };
            self.submissions.team_gpu.get_or_create(&of).inc_by(seconds);
        }
        let of = OfTrack { leaderboard, track };
        self.submissions.gpu.get_or_create(&of).inc_by(seconds);
    }

    /// So much has a submission used that holds GPUs at present.
    pub fn set_live_gpu_use(&self, of: &OfSubmission, seconds: i64) {
        self.submissions.live_gpu.get_or_create(of).set(seconds);
    }

    /// It holds none any more: a series for each submission of a season would burden Prometheus.
    pub fn forget_live_gpu_use(&self, of: &OfSubmission) {
        self.submissions.live_gpu.remove(of);
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
