//! What of a Submission, as the watch shows it, counts for the others of its Leaderboard: all of it, and nothing else. Pure.

use jiff::Timestamp;

use leaderboard_api::{JobNumber, State, Submission, SubmissionStatus, conditions, names, reasons};

pub(super) struct Member {
    pub(super) name: String,
    pub(super) team: String,
    pub(super) track: String,
    /// The Job that runs or is to run next.
    pub(super) number: JobNumber,
    pub(super) stand: Stand,
    /// It starts nothing any more.
    pub(super) is_leaving: bool,
    /// A change of its Leaderboard may let it start.
    pub(super) is_pending: bool,
    /// When its present or last run began.
    pub(super) began: Option<Timestamp>,
    /// When a run ended that has begun.
    pub(super) ended: Option<Timestamp>,
    pub(super) state: State,
    /// It is live, or its end is not yet published and recorded.
    pub(super) needs_leaderboard: bool,
    pub(super) kind: Kind,
}

#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    OfTeam,
    /// It is in no count and no estimate.
    Check,
}

/// The team as which a check stands in line: its own, so that no limit of a team holds it up.
pub fn check_team(name: &str) -> String {
    format!("check/{name}")
}

/// What its status shows of it.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Stand {
    /// It has no slot, and may want one.
    Idle,
    HasSlot,
    /// It has come to its end, and no other attempt is requested.
    Over,
}

impl Member {
    pub(super) fn of(submission: &Submission) -> Self {
        let spec = &submission.spec;
        let none = SubmissionStatus::default();
        let status = submission.status.as_ref().unwrap_or(&none);
        let name = submission.metadata.name.clone().unwrap_or_default();
        let is_finished = status.has_ended();
        let known = submission.present_attempt();
        let is_over = is_finished && !status.is_followed_by(spec.attempt);
        let number = if is_finished && !is_over {
            JobNumber::first(spec.attempt)
        } else {
            JobNumber {
                attempt: known,
                retry: status.retry,
            }
        };
        let times = &status.times;
        let began = times.scheduled.as_ref().or(times.started.as_ref());
        // What never ran shows nothing of how long a run takes.
        let ended = times.started.as_ref().and(times.finished.as_ref());
        let is_deleting = submission.metadata.deletion_timestamp.is_some();
        let own = spec.check.then(|| check_team(&name));
        Self {
            team: own.unwrap_or_else(|| submission.team().unwrap_or_default().to_owned()),
            track: status.track.clone().or(spec.track.clone()).unwrap_or_default(),
            number,
            name,
            stand: match status {
                _ if is_over => Stand::Over,
                // Between two tries it keeps its slot: it lost its Job to the infrastructure and is about to get another.
                status if !is_finished && status.has_run() => Stand::HasSlot,
                _ => Stand::Idle,
            },
            is_leaving: is_over || spec.cancel || is_deleting,
            is_pending: !is_over && waits_for_leaderboard(status),
            began: began.filter(|_| !spec.check).map(|time| time.0),
            ended: ended.filter(|_| !spec.check).map(|time| time.0),
            state: status.state_of_conditions(),
            needs_leaderboard: needs_leaderboard(status),
            kind: if spec.check { Kind::Check } else { Kind::OfTeam },
        }
    }

    /// Name of the Job that runs or is to run next.
    pub(super) fn job(&self) -> String {
        names::job(&self.name, self.number)
    }

    /// Whether what is known of past runs stays right by adding what is new here.
    pub(super) fn adds_to(&self, old: &Self) -> bool {
        let same_run = |new: Option<Timestamp>, old: Option<Timestamp>| old.is_none() || old == new;
        old.began.is_none()
            || (self.team == old.team
                && self.track == old.track
                && same_run(self.began, old.began)
                && same_run(self.ended, old.ended))
    }

    pub(super) fn ran_as(&self, old: &Self) -> bool {
        (&self.team, &self.track, self.began, self.ended) == (&old.team, &old.track, old.began, old.ended)
    }
}

fn needs_leaderboard(status: &SubmissionStatus) -> bool {
    let waits = |type_: &str| status.condition(type_).is_some() && !status.is_delivered(type_);
    !status.has_ended() || waits(conditions::PUBLISHED) || waits(conditions::RECORDED)
}

/// Whether a change of its Leaderboard may let it start: it has no Job, or the one that it asked for may not be made.
fn waits_for_leaderboard(status: &SubmissionStatus) -> bool {
    let held = [reasons::NOT_ISOLATED];
    status.job_name.is_none() || status.reason.as_deref().is_some_and(|reason| held.contains(&reason))
}
