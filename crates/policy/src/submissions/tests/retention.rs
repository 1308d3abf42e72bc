//! When what has ended is deleted.

use std::sync::Arc;
use std::time::Duration;

use super::builders::*;
use super::foreign;
use crate::leaderboards::standings::{self, Results};
use crate::submissions::{Action, Plan};
use crate::view::EvalaiEnd;
use leaderboard_api::State::{Failed, Finished};
use leaderboard_api::conditions::{FINISHED, PUBLISHED, RECORDED};
use leaderboard_api::{Attempt, Reason, TrackStatus};

/// How long a host keeps a finished submission, in seconds.
const KEPT: i64 = 3600;

/// A run that has just ended well, kept for [`KEPT`].
fn ended_well() -> World {
    let mut world = World::evalai().running();
    world.leaderboard().retention.finished_seconds = Some(KEPT);
    world.submission().metadata.resource_version = Some("7".into());
    world.complete();
    world.report(final_report());
    world.pass_to(Finished, Reason::Finished);
    let end = world.view.now;
    world.job().end = Some(crate::view::JobEnd::Complete { at: Some(end) });
    world
}

/// Such a run, whose end every system has.
fn known_to_all() -> World {
    let mut world = ended_well();
    world.published();
    world.pass();
    world.recorded();
    world.pass();
    world.is_in_the_standings();
    world
}

impl World {
    /// The Leaderboard's status holds its result.
    fn is_in_the_standings(&mut self) {
        let submission = self.submission().clone();
        let leaderboard = Arc::make_mut(self.view.leaderboard.as_mut().unwrap());
        let track = leaderboard.spec.tracks[0].clone();
        let ranking = standings::ranked(leaderboard, &track, &None).ranking;
        let results = Results {
            submissions: vec![Arc::new(submission)],
            ..Results::default()
        };
        let rows = standings::of_track(leaderboard, &track, &ranking, Some(&results));
        assert_eq!(rows.len(), 1);
        let tracks = vec![TrackStatus {
            name: track.name,
            ranking: Some(ranking),
            standings: rows,
            ..TrackStatus::default()
        }];
        leaderboard.status.get_or_insert_default().tracks = tracks;
    }
}

#[test]
fn a_result_that_leads_waits_for_the_standings_to_hold_it() {
    let mut world = known_to_all();
    world.wait(KEPT);
    let leaderboard = Arc::make_mut(world.view.leaderboard.as_mut().unwrap());
    leaderboard.status.as_mut().unwrap().tracks[0].standings.clear();
    let plan = world.pass();
    assert!(!deletes(&plan));
    assert!(
        plan.requeue.is_some_and(|wait| wait <= Duration::from_secs(30)),
        "{:?}",
        plan.requeue
    );
    world.is_in_the_standings();
    assert!(deletes(&world.pass()));
}

fn deletes(plan: &Plan) -> bool {
    has(plan, |action| matches!(action, Action::DeleteSubmission { .. }))
}

#[test]
fn it_is_deleted_when_its_time_is_over_and_not_before() {
    let mut world = known_to_all();
    world.wait(KEPT - 1);
    let plan = world.pass();
    assert!(!deletes(&plan));
    assert_eq!(
        plan.requeue,
        Some(Duration::from_millis(1050)),
        "it comes back at that time"
    );
    world.wait(1);
    let deletion = Action::DeleteSubmission {
        uid: UID.into(),
        resource_version: "7".into(),
    };
    assert!(world.pass().actions.contains(&deletion));
    // The first try may have met a change.
    world.wait(30);
    assert!(world.pass().actions.contains(&deletion));
}

#[test]
fn what_is_far_from_its_end_is_decided_on_again_within_the_hour() {
    let mut world = ended_well();
    world.leaderboard().retention.finished_seconds = Some(30 * 86_400);
    world.published();
    world.pass();
    world.recorded();
    assert_eq!(world.pass().requeue, Some(Duration::from_hours(1)));
}

/// A change of such a run, and its name.
type Keeps = (&'static str, fn(&mut World));

#[test]
fn nothing_else_is_ever_deleted() {
    let cases: [Keeps; 7] = [
        ("retention is off", |w| {
            w.leaderboard().retention.finished_seconds = None;
        }),
        ("its Leaderboard is gone", |w| w.view.leaderboard = None),
        ("a person deletes it", World::delete),
        ("its Job has not ended", |w| w.job().end = None),
        ("EvalAI does not have its end", |w| w.forget(PUBLISHED)),
        ("the table does not have its end", |w| w.forget(RECORDED)),
        ("another attempt is requested", |w| {
            let conditions = &mut w.submission().status.as_mut().unwrap().conditions;
            let end = conditions.iter_mut().find(|c| c.type_ == FINISHED).unwrap();
            end.reason = Reason::Cancelled.into();
            w.submission().spec.attempt = Attempt(2);
        }),
    ];
    let mut last = known_to_all();
    last.wait(KEPT);
    assert!(deletes(&last.pass()), "the world that the cases change");
    for (why, change) in cases {
        let mut world = last.clone();
        change(&mut world);
        let plan = crate::submissions::decide(&world.view);
        assert!(!deletes(&plan), "{why}: {:?}", plan.actions);
    }
}

#[test]
fn a_finished_one_goes_although_another_attempt_was_asked_for_while_it_ran() {
    let mut world = known_to_all();
    world.submission().spec.attempt = Attempt(2);
    world.wait(KEPT);
    assert!(deletes(&world.pass()));
}

#[test]
fn an_end_that_evalai_refuses_is_kept() {
    let mut world = ended_well();
    let message = "No.".to_owned();
    world.in_evalai().end = Some(EvalaiEnd::Refused { message });
    world.recorded();
    world.pass();
    world.wait(10 * KEPT);
    assert!(!deletes(&world.pass()));
}

#[test]
fn a_running_one_is_never_deleted() {
    let mut world = World::local().running();
    world.leaderboard().retention.finished_seconds = Some(1);
    world.wait(KEPT);
    assert!(!deletes(&world.pass()));
}

#[test]
fn a_failed_one_goes_with_its_end_published_and_its_log_kept() {
    let mut world = World::evalai().running();
    world.leaderboard().retention.finished_seconds = Some(KEPT);
    world.submission().metadata.resource_version = Some("7".into());
    world.see(ended("agent-1", 3, "exited", 1, 100));
    world.pass();
    world.complete();
    world.pass_to(Failed, Reason::AgentCrashed);
    world.wait(KEPT);
    assert!(!deletes(&world.pass()), "EvalAI has no end yet");
    world.published();
    world.pass();
    world.recorded();
    world.pass();
    assert!(deletes(&world.pass()));
}

#[test]
fn a_resume_of_a_deleted_one_counts_on_in_the_table() {
    for (standing, attempt, jobs, earlier) in [
        (crate::view::Standing::Resumed, 1, Some(3), 3),
        (crate::view::Standing::Resumed, 4, Some(3), 0),
        (crate::view::Standing::Resumed, 1, None, 0),
        (crate::view::Standing::Wanted, 1, Some(3), 0),
    ] {
        let mut world = World::evalai();
        world.submission().spec.attempt = Attempt(attempt);
        world.view.row = foreign::free(attempt);
        let info = world.in_evalai().info.as_mut().unwrap();
        (info.standing, info.last_attempt) = (standing, jobs.map(Attempt));
        world.pass();
        let plan = world.pass().status.plan.unwrap();
        assert_eq!(
            plan.earlier_attempts, earlier,
            "{standing:?}, attempt {attempt}, {jobs:?}"
        );
    }
}
