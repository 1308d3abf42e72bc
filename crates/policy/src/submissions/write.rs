//! Decides if a changed status is worth a write now: API writes are the cost of a submission for its cluster.
//!
//! Pure. Progress moves all the time and may wait; whatever a decision or a person needs goes out at once.

use std::time::Duration;

use super::events;
use super::plan::{Plan, StatusWrite};
use super::status::PlanBuilder;
use super::waits::Wait;
use crate::view::ReportDemand;
use leaderboard_api::conditions::STALLED;
use leaderboard_api::{ReasonName, SharedText, SubmissionStatus, WorkerState};

/// Places in line that are written without waiting for their turn.
const FIRST_PLACES: i32 = 20;

/// Periods that progress waits for, where that is shorter.
const PERIODS: u32 = 3;

/// The plan that a draft has become.
pub(super) fn plan(mut draft: PlanBuilder<'_>, report: Option<ReportDemand>) -> Plan {
    // Without an attempt nothing was decided yet.
    if draft.status.attempt.is_some() {
        draft.status.state = Some(draft.status.state_of_conditions());
        draft.status.reason = draft
            .status
            .reason
            .take()
            .filter(|reason| !draft.status.repeats(reason));
        let old = draft.submission().status.as_ref();
        draft.events.extend(events::of_change(old, &draft.status));
    }
    draft.status.fit();
    Plan {
        report,
        write: status_write(&mut draft),
        status: draft.status,
        actions: draft.actions,
        events: draft.events,
        requeue: draft.requeue,
    }
}

/// API writes are what a submission costs its cluster: what may wait is written with what comes next.
fn status_write(draft: &mut PlanBuilder<'_>) -> StatusWrite {
    let nothing = SubmissionStatus::default();
    let old = draft.submission().status.as_ref().unwrap_or(&nothing);
    match change(old, &draft.status) {
        Change::Nothing => StatusWrite::NotNow,
        Change::Place(position) if position > FIRST_PLACES => StatusWrite::InTurn,
        Change::Progress => {
            let patience = patience(draft.period());
            let left = draft.view.written_ago.and_then(|ago| patience.checked_sub(ago));
            if let Some(left) = left {
                draft.requeue_in(left);
            }
            left.map_or(StatusWrite::Now, |_| StatusWrite::NotNow)
        }
        Change::Place(_) | Change::Real => StatusWrite::Now,
    }
}

/// The difference of two statuses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Change {
    Nothing,
    /// Only its place in line, which moves for many at once; the new one.
    Place(i32),
    /// Only how far it is, and the text for it.
    Progress,
    Real,
}

/// Compares the status that is stored with the one that is wanted.
fn change(old: &SubmissionStatus, new: &SubmissionStatus) -> Change {
    if old == new {
        Change::Nothing
    } else if let Some(position) = place_alone(old, new) {
        Change::Place(position)
    } else if steady(old) == steady(new) {
        Change::Progress
    } else {
        Change::Real
    }
}

/// The new place in line, where nothing else has changed.
fn place_alone(old: &SubmissionStatus, new: &SubmissionStatus) -> Option<i32> {
    let (_, waiting) = old.waiting.as_ref().zip(new.waiting.as_ref())?;
    let moved = SubmissionStatus {
        waiting: new.waiting.clone(),
        ..old.clone()
    };
    (moved == *new).then_some(waiting.position)
}

/// How long progress may wait since the last write, with reports of this period.
fn patience(period: Duration) -> Duration {
    Wait::PROGRESS.silence().min(period * PERIODS)
}

/// A status without what moves while a submission waits, starts or runs.
fn steady(status: &SubmissionStatus) -> SubmissionStatus {
    let mut steady = SubmissionStatus {
        node_name: None,
        progress: None,
        score: None,
        metrics: Vec::new(),
        message: None,
        waiting: None,
        image: None,
        ..status.clone()
    };
    for worker in &mut steady.workers {
        worker.done = 0;
        worker.state = WorkerState::default();
    }
    // A worker that has not crashed carries nothing that would be missed.
    steady
        .workers
        .retain(|worker| worker.crashes > 0 || worker.last.is_some());
    steady.times.scheduled = None;
    for condition in &mut steady.conditions {
        // Why nothing is stalled is no news.
        if condition.type_ == STALLED && !condition.is_true() {
            condition.reason = ReasonName::default();
        }
        condition.message = SharedText::default();
        condition.observed_generation = None;
    }
    steady
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;
    use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;

    use super::*;
    use leaderboard_api::conditions::{self, Truth};
    use leaderboard_api::{Progress, Reason, State, WorkerStatus};

    fn running(done: i32) -> SubmissionStatus {
        SubmissionStatus {
            state: Some(State::Running),
            progress: Some(Progress::new(done, 20, "routes")),
            message: Some(format!("{done}/20 routes done.").into()),
            ..SubmissionStatus::default()
        }
    }

    #[test]
    fn progress_may_wait_and_a_state_may_not() {
        assert_eq!(change(&running(1), &running(1)), Change::Nothing);
        assert_eq!(change(&running(1), &running(2)), Change::Progress);
        let finished = SubmissionStatus {
            state: Some(State::Finished),
            ..running(20)
        };
        assert_eq!(change(&running(19), &finished), Change::Real);
    }

    #[test]
    fn the_way_to_a_node_is_no_news() {
        let preparing = |truth: Truth, reason: Reason, node: Option<&str>| {
            let mut status = SubmissionStatus {
                state: Some(State::Pending),
                node_name: node.map(str::to_owned),
                ..SubmissionStatus::default()
            };
            let now = Time(Timestamp::UNIX_EPOCH);
            status.times.scheduled = node.map(|_| now.clone());
            conditions::set(&mut status.conditions, STALLED, truth, reason, "", None, &now);
            status
        };
        let before = preparing(Truth::False, Reason::Preparing, None);
        let on_node = preparing(Truth::False, Reason::NotStalled, Some("node-a"));
        assert_eq!(change(&before, &on_node), Change::Progress);
        let blocked = preparing(Truth::True, Reason::ImagePull, Some("node-a"));
        assert_eq!(change(&before, &blocked), Change::Real);
        let other = preparing(Truth::True, Reason::ContainerConfig, Some("node-a"));
        assert_eq!(change(&blocked, &other), Change::Real);
    }

    #[test]
    fn a_step_forward_is_a_place_and_the_first_place_is_not() {
        let waiting = |position| SubmissionStatus {
            waiting: Some(Box::new(leaderboard_api::Waiting::new(position, None))),
            ..SubmissionStatus::default()
        };
        assert_eq!(change(&waiting(3), &waiting(2)), Change::Place(2));
        assert_eq!(change(&waiting(3), &waiting(3)), Change::Nothing);
        assert_eq!(change(&SubmissionStatus::default(), &waiting(3)), Change::Progress);
        let started = SubmissionStatus {
            state: Some(State::Running),
            ..SubmissionStatus::default()
        };
        assert_eq!(change(&waiting(1), &started), Change::Real);
    }

    #[test]
    fn a_crash_is_written_at_once() {
        let crashed = WorkerStatus {
            id: 1,
            done: 0,
            total: 5,
            crashes: 1,
            state: WorkerState::Crashed,
            last: None,
            ended_from_outside: 0,
            environment_failed: false,
        };
        let status = SubmissionStatus {
            workers: vec![crashed],
            ..running(1)
        };
        assert_eq!(change(&running(1), &status), Change::Real);
    }

    #[test]
    fn progress_waits_no_longer_than_three_periods() {
        for (period, expected) in [(5, 15), (10, 30), (60, 30)] {
            assert_eq!(patience(Duration::from_secs(period)), Duration::from_secs(expected));
        }
    }
}
