//! The phases that end with each status of a life, with their lengths and the spans made of them.

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use serde_json::json;

use super::builders::*;
use crate::phases::{self, Ended};
use crate::submissions::{Plan, decide};
use leaderboard_api::State::{Finished, Pending, Running};
use leaderboard_api::{Attempt, names};

/// The phases that end with the next reconcile, each with the seconds at which it began and ended.
type Lengths = Vec<(&'static str, i64, i64)>;

fn pass(world: &mut World) -> (Plan, Lengths) {
    let plan = decide(&world.view);
    let found = phases::ended(&world.view, &plan.status);
    assert_eq!(plan.status, world.pass().status);
    (plan, found.iter().map(lengths).collect())
}

fn lengths(one: &Ended) -> (&'static str, i64, i64) {
    let second = |at: Timestamp| at.as_second() - at_begin();
    (one.phase.as_str(), second(one.start), second(one.end))
}

fn at_begin() -> i64 {
    at(0).as_second()
}

/// A submission whose object is made at second 0, of a message that was sent 7 s before.
fn sent() -> World {
    let mut world = World::evalai();
    world.submission().metadata.creation_timestamp = Some(Time(at(0)));
    let record = json!({"message": "m-1", "sent": at(-7).as_millisecond(), "attempt": 1});
    let annotations = [(names::ANNOTATION_INGESTED.to_owned(), record.to_string())];
    world.submission().metadata.annotations = Some(annotations.into());
    world
}

#[test]
fn a_whole_life_has_each_phase_once_and_none_overlaps_the_next() {
    let mut world = sent();
    world.go_to(3);
    let mut all = pass(&mut world).1;
    world.see_job();
    world.view.pod = Some(pod(5));
    world.go_to(6);
    all.extend(pass(&mut world).1);
    world.see_agents();
    world.go_to(12);
    let (plan, found) = pass(&mut world);
    assert_eq!(plan.status.state, Some(Running));
    all.extend(found);
    world.go_to(500);
    all.extend(pass(&mut world).1);
    world.complete();
    world.report(final_report());
    world.go_to(510);
    let (plan, found) = pass(&mut world);
    assert_eq!(plan.status.state, Some(Finished));
    all.extend(found);
    world.go_to(520);
    world.recorded();
    world.published();
    world.go_to(521);
    all.extend(pass(&mut world).1);
    world.go_to(600);
    all.extend(pass(&mut world).1);
    let expected = [
        ("intake", -7, 0),
        ("accept", 0, 3),
        ("wait", 3, 3),
        ("schedule", 3, 5),
        ("start", 5, 10),
        ("run", 10, 500),
        ("attempt", 0, 510),
        ("archive", 500, 510),
        ("record", 500, 521),
        ("publish", 500, 520),
    ];
    assert_eq!(all, expected);
}

#[test]
fn each_job_of_an_attempt_has_its_own_run_and_the_pause_is_no_wait() {
    let mut world = World::local().running();
    world.go_to(100);
    world.complete();
    let (plan, found) = pass(&mut world);
    assert_eq!((plan.status.state, plan.status.retry), (Some(Pending), 1));
    assert_eq!(found, [("run", 10, 100)]);
    world.job_gone();
    let again = plan.status.next_retry_time.unwrap().0.as_second() - at_begin();
    world.go_to(again + 4);
    assert_eq!(pass(&mut world).1, [("wait", again, again + 4)]);
    world.see_job();
    world.view.pod = Some(pod(again + 5));
    world.see_agents();
    world.pod().agent_started = Some(at(again + 20));
    world.go_to(again + 21);
    let begun = [("schedule", again + 4, again + 5), ("start", again + 5, again + 20)];
    assert_eq!(pass(&mut world).1, begun);
}

#[test]
fn a_run_that_ended_while_nobody_looked_has_its_phases_too() {
    let mut world = World::local().with_pod();
    pass(&mut world);
    world.see_agents();
    world.go_to(900);
    world.complete();
    world.report(final_report());
    let (plan, found) = pass(&mut world);
    assert_eq!(plan.status.state, Some(Finished));
    let names: Vec<_> = found.iter().map(|(name, _, _)| *name).collect();
    assert_eq!(names, ["schedule", "start", "run", "attempt", "archive"]);
    assert_eq!(found[2], ("run", 10, 900));
}

#[test]
fn a_clock_that_is_ahead_makes_no_negative_length() {
    let mut world = sent();
    let late = json!({"message": "m-1", "sent": at(9).as_millisecond(), "attempt": 1});
    let annotations = [(names::ANNOTATION_INGESTED.to_owned(), late.to_string())];
    world.submission().metadata.annotations = Some(annotations.into());
    assert_eq!(pass(&mut world).1[0], ("intake", 0, 0));
}

#[test]
fn a_restart_ends_the_run_and_the_attempt_that_it_follows() {
    let mut world = World::local().running();
    world.submission().spec.attempt = Attempt(2);
    world.go_to(100);
    assert_eq!(pass(&mut world).1, []);
    world.go_to(120);
    world.complete();
    assert_eq!(pass(&mut world).1, [("run", 10, 120), ("attempt", 0, 120)]);
    world.job_gone();
    world.go_to(121);
    assert_eq!(pass(&mut world).1, [("accept", 120, 121), ("wait", 121, 121)]);
}
