//! Slots as reconciles and watches use them, on caches that the tests fill.

mod histories;

use std::sync::{Arc, Mutex};

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use kube::ResourceExt;
use serde_json::{Value, json};

use super::*;
use crate::fixtures::{self, Cluster};
use crate::kubernetes::Store;
use crate::kubernetes::objects::{Job, Owner};
use leaderboard_api::{Attempt, Eta};

fn leaderboard(running: &Value, paused: bool) -> Leaderboard {
    let spec = json!({
        "tracks": [{"name": "sensors"}],
        "evaluation": {"carla": {
            "version": "V2", "contents": {"image": "c"}, "simulator": {"image": "s"},
        }}, "storage": {"s3": {"bucket": "b"}}, "concurrency": running, "paused": paused,
    });
    let mut object = Leaderboard::new("lb", serde_json::from_value(spec).unwrap());
    object.metadata.namespace = Some("ns".into());
    object
}

fn one() -> Leaderboard {
    leaderboard(&json!({"total": 1}), false)
}

fn time(second: i64) -> Time {
    Time(jiff::Timestamp::from_second(second).unwrap())
}

/// A submission of a team; `status` is what the watch shows of it.
fn submission(name: &str, team: &str, second: i64, status: Value) -> Submission {
    let spec = json!({"leaderboardName": "lb", "image": "i", "track": "sensors", "team": {"id": team}});
    let mut object = Submission::new(name, serde_json::from_value(spec).unwrap());
    object.metadata.namespace = Some("ns".into());
    object.metadata.uid = Some(name.into());
    object.metadata.creation_timestamp = Some(time(second));
    object.status = serde_json::from_value(status).unwrap();
    object
}

fn condition(type_: &str, status: &str) -> Value {
    json!({"type": type_, "status": status, "reason": "R", "message": "", "lastTransitionTime": "2026-01-01T00:00:00Z"})
}

fn ended(attempt: i64) -> Value {
    json!({"attempt": attempt, "jobName": "j", "track": "sensors", "conditions": [condition("Finished", "True")],
           "times": {"scheduled": time(0), "started": time(100), "finished": time(1500)}})
}

/// The slots of a Leaderboard, and what its reconciles and watches do with them.
struct World {
    slots: Arc<Slots>,
    leaderboard: Leaderboard,
    woken: Woken,
}

/// The names of those that were woken.
type Woken = Arc<Mutex<Vec<String>>>;

fn wake() -> (Wake<Submission>, Woken) {
    let woken = Woken::default();
    let names = Arc::clone(&woken);
    let wake = move |object: ObjectRef<Submission>| lock(&names).push(object.name);
    (Box::new(wake), woken)
}

impl World {
    fn new(leaderboard: Leaderboard, all: &[&Submission]) -> Self {
        let cluster = Cluster {
            leaderboards: vec![leaderboard.clone()],
            submissions: all.iter().map(|&object| object.clone()).collect(),
            ..Cluster::default()
        };
        let (wake, woken) = wake();
        Self {
            slots: Arc::new(Slots::new(fixtures::stores(cluster), wake)),
            leaderboard,
            woken,
        }
    }

    /// The watch shows another state of a submission.
    fn shows(&self, submission: &Submission) {
        self.slots.stores.submissions.put(submission.clone());
        self.slots.changed(&board_of(submission));
    }

    /// The watch shows a submission no more.
    fn loses(&self, submission: &Submission) {
        self.slots.stores.submissions.remove(submission);
        self.slots.leaves(submission);
    }

    fn becomes(&mut self, leaderboard: Leaderboard) {
        self.slots.stores.leaderboards.put(leaderboard.clone());
        self.slots.changed(&ObjectRef::from_obj(&leaderboard));
        self.leaderboard = leaderboard;
    }

    fn turn(&self, submission: &Submission) -> Turn {
        self.slots.turn(submission, Some(&self.leaderboard))
    }

    /// All but the slot is settled.
    fn joins(&self, submission: &Submission) {
        let created = submission.metadata.creation_timestamp.as_ref().unwrap();
        let place = InLine {
            uid: uid(submission).to_owned(),
            name: submission.name_any(),
            team: submission.spec.team.as_ref().unwrap().id.clone().unwrap(),
            track: "sensors".into(),
            priority: submission.spec.priority,
            submitted: created.0,
            is_check: submission.spec.check,
        };
        self.slots.join(submission, place);
    }

    /// Joins the line, and the turn that follows.
    fn asks(&self, submission: &Submission) -> Turn {
        self.joins(submission);
        self.woken();
        self.turn(submission)
    }

    /// Names of the submissions that the next round wakes, sorted.
    fn woken(&self) -> Vec<String> {
        self.slots.allocate();
        let mut names = std::mem::take(&mut *lock(&self.woken));
        names.sort();
        names
    }
}

fn wait(position: i32) -> Turn {
    Turn::Wait { position, eta: None }
}

#[test]
fn a_slot_is_granted_once_and_given_back_at_the_end() {
    let (a, b) = (submission("a", "x", 1, json!({})), submission("b", "y", 2, json!({})));
    let world = World::new(one(), &[&a, &b]);
    assert_eq!(world.asks(&a), Turn::Go);
    assert_eq!(world.asks(&b), wait(1));
    world.slots.starts(&a);
    assert_eq!(world.asks(&b), wait(1), "the watch does not show the Job yet");
    world.shows(&submission("a", "x", 1, json!({"attempt": 1, "jobName": "a-1"})));
    assert_eq!(world.asks(&b), wait(1));
    world.shows(&submission("a", "x", 1, ended(1)));
    assert_eq!(world.woken(), ["b"]);
    assert_eq!(world.turn(&b), Turn::Go);

    // The first one's later attempt is not let past.
    let mut resumed = submission("a", "x", 1, ended(1));
    resumed.spec.attempt = Attempt(2);
    world.shows(&resumed);
    assert!(matches!(world.asks(&resumed), Turn::Wait { position: 1, .. }));
}

#[test]
fn who_did_not_start_holds_no_slot() {
    let (a, b) = (submission("a", "x", 1, json!({})), submission("b", "y", 2, json!({})));
    let world = World::new(one(), &[&a, &b]);
    assert_eq!((world.asks(&a), world.asks(&b)), (Turn::Go, wait(1)));
    // Its reconcile found that the Leaderboard is no longer ready.
    world.slots.leaves(&a);
    assert_eq!(world.woken(), ["b"]);
    assert_eq!((world.turn(&a), world.turn(&b)), (Turn::NotInLine, Turn::Go));
}

#[test]
fn who_is_cancelled_or_deleted_holds_no_slot_and_no_place() {
    for cancel in [true, false] {
        let all: Vec<_> = (1..=3).map(|n| submission(&n.to_string(), "x", n, json!({}))).collect();
        let world = World::new(one(), &[&all[0], &all[1], &all[2]]);
        let turns: Vec<_> = all.iter().map(|object| world.asks(object)).collect();
        assert_eq!(turns, [Turn::Go, wait(1), wait(2)]);
        for object in &all[..2] {
            let mut gone = object.clone();
            gone.spec.cancel = cancel;
            gone.metadata.deletion_timestamp = (!cancel).then(|| time(9));
            world.shows(&gone);
        }
        assert_eq!(world.woken(), ["3"]);
        assert_eq!(world.turn(&all[2]), Turn::Go);
    }
}

#[test]
fn one_that_is_gone_before_it_joins_holds_nothing() {
    let (a, b) = (submission("a", "x", 1, json!({})), submission("b", "y", 2, json!({})));
    let world = World::new(one(), &[&a, &b]);
    // Its last reconcile was under way.
    world.loses(&a);
    assert_eq!(world.asks(&a), Turn::NotInLine);
    assert_eq!(world.asks(&b), Turn::Go);
    world.loses(&b);
    assert!(lock(&world.slots.lines).is_empty(), "nothing is kept of what is gone");
}

#[test]
fn nobody_waits_for_one_that_evalai_is_still_asked_about() {
    let asking = json!({"conditions": [condition("Accepted", "Unknown")]});
    let (a, b) = (submission("a", "x", 1, asking), submission("b", "y", 2, json!({})));
    let world = World::new(one(), &[&a, &b]);
    assert_eq!(world.turn(&a), Turn::NotInLine, "it has not joined");
    assert_eq!(world.asks(&b), Turn::Go);
    assert_eq!(world.asks(&a), wait(1));
}

#[test]
fn between_two_tries_the_slot_is_kept_also_by_another_leader() {
    let replacing = json!({"attempt": 1, "retry": 1, "times": {"started": time(5)}});
    let (a, b) = (submission("a", "x", 9, replacing), submission("b", "y", 2, json!({})));
    let mut world = World::new(one(), &[&a, &b]);
    assert_eq!(world.asks(&b), wait(1));
    assert_eq!(world.turn(&a), Turn::Go);
    world.becomes(leaderboard(&json!({"total": 1}), true));
    let turn = world.asks(&a);
    assert!(
        matches!(turn, Turn::Paused { .. }),
        "a paused Leaderboard makes no Job: {turn:?}"
    );
    world.woken();
    world.becomes(one());
    assert!(world.woken().contains(&"a".to_owned()));
    assert_eq!((world.turn(&a), world.turn(&b)), (Turn::Go, wait(1)));
}

#[test]
fn a_job_in_the_cache_has_a_slot_although_no_status_names_it() {
    let (a, b) = (submission("a", "x", 1, json!({})), submission("b", "y", 2, json!({})));
    let mut world = World::new(one(), &[&a, &b]);
    let board = ObjectRef::from_obj(&world.leaderboard);
    let mut job = Job::default();
    job.metadata.name = "a-1".into();
    job.metadata.namespace = Some("ns".into());
    job.metadata.owner_references = [Owner { uid: "a".into() }].into();
    world.slots.stores.jobs.put(job.clone());
    assert_eq!(world.asks(&b), wait(1));
    world.woken();
    world.slots.stores.jobs.remove(&job);
    world.slots.changed(&board);
    assert_eq!(world.woken(), ["b"]);
    // One of an earlier attempt that has ended has none.
    let mut resumed = submission("c", "x", 3, ended(1));
    resumed.spec.attempt = Attempt(2);
    job.metadata.name = "c-1".into();
    job.metadata.owner_references[0].uid = "c".into();
    world.slots.stores.jobs.put(job);
    world.shows(&resumed);
    world.becomes(leaderboard(&json!({"total": 2}), false));
    assert_eq!(world.asks(&resumed), Turn::Go);
}

#[test]
fn an_attempt_that_is_asked_for_early_takes_no_second_slot() {
    let early = |status: Value| {
        let mut object = submission("a", "x", 1, status);
        object.spec.attempt = Attempt(2);
        object
    };
    let (a, b) = (early(json!({"attempt": 1})), submission("b", "y", 2, json!({})));
    let world = World::new(leaderboard(&json!({"total": 2}), false), &[&a, &b]);
    assert_eq!(world.asks(&a), Turn::Go);
    world.slots.starts(&a);
    world.shows(&early(json!({"attempt": 1, "jobName": "a-1"})));
    assert_eq!(world.asks(&b), Turn::Go);
}

#[tokio::test(start_paused = true)]
async fn no_slot_is_granted_before_both_caches_have_listed() {
    let a = submission("a", "x", 1, json!({}));
    for first in 0..2 {
        let mut stores = fixtures::stores(Cluster::default());
        let (submissions, submissions_list) = Store::unlisted();
        let (jobs, jobs_list) = Store::unlisted();
        (stores.submissions, stores.jobs) = (submissions, jobs);
        stores.leaderboards.put(one());
        stores.submissions.put(a.clone());
        let (wake, woken) = wake();
        let world = World {
            slots: Arc::new(Slots::new(stores, wake)),
            leaderboard: one(),
            woken,
        };
        let slots = Arc::clone(&world.slots);
        tokio::spawn(async move { slots.keep().await });
        world.joins(&a);
        let lists = [submissions_list, jobs_list];
        lists[first].send_replace(true);
        tokio::time::sleep(EVERY * 10).await;
        assert_eq!((lock(&world.woken).len(), world.turn(&a)), (0, Turn::NotInLine));
        // The rest of the lists shows who has the slot.
        world.shows(&submission("b", "y", 2, json!({"jobName": "b-1"})));
        lists[1 - first].send_replace(true);
        tokio::time::sleep(EVERY).await;
        assert_eq!((lock(&world.woken).len(), world.turn(&a)), (1, wait(1)));
    }
}

#[test]
fn without_limits_a_slot_costs_no_hop() {
    let a = submission("a", "x", 1, json!({}));
    let mut world = World::new(leaderboard(&json!({}), false), &[&a]);
    assert_eq!(world.turn(&a), Turn::Go);
    world.becomes(leaderboard(&json!({}), true));
    assert_eq!(world.turn(&a), Turn::NotInLine);
    assert_eq!(world.asks(&a), Turn::Paused { position: 1 });
}

#[test]
fn a_pause_or_a_lower_limit_takes_back_what_was_not_used() {
    let two = || leaderboard(&json!({"total": 2}), false);
    let (a, b) = (submission("a", "x", 1, json!({})), submission("b", "y", 2, json!({})));
    let mut world = World::new(two(), &[&a, &b]);
    assert_eq!((world.asks(&a), world.asks(&b)), (Turn::Go, Turn::Go));
    // The Job is being created when the pause comes.
    world.slots.starts(&a);
    world.becomes(leaderboard(&json!({"total": 2}), true));
    assert_eq!((world.turn(&a), world.turn(&b)), (Turn::Go, Turn::NotInLine));
    assert_eq!(world.woken(), ["b"]);
    assert_eq!(world.turn(&b), Turn::Paused { position: 1 });
    world.becomes(one());
    assert_eq!(world.woken(), ["b"]);
    assert_eq!(world.turn(&b), wait(1));
    world.becomes(two());
    assert_eq!(world.woken(), ["b"]);
    assert_eq!(world.turn(&b), Turn::Go);
    // One that could not be created is taken back as well.
    world.slots.did_not_start(&a);
    world.becomes(leaderboard(&json!({"total": 2}), true));
    assert_eq!(world.woken(), ["a", "b"]);
    assert!(matches!(world.turn(&a), Turn::Paused { .. }));
}

#[test]
fn the_line_remembers_who_was_served_and_how_long_runs_take() {
    let running = json!({"attempt": 1, "jobName": "j", "times": {"scheduled": time(2000)}});
    let all = [
        submission("x-old", "x", 1, ended(1)),
        submission("x-now", "x", 2, running),
        submission("x-next", "x", 3, json!({})),
        submission("y-next", "y", 4, json!({})),
    ];
    let world = World::new(one(), &[&all[0], &all[1], &all[2], &all[3]]);
    let expected = |position, [low, high]: [i64; 2]| Turn::Wait {
        position,
        eta: Some(Eta::between(low * 60, high * 60)),
    };
    world.joins(&all[2]);
    world.joins(&all[3]);
    assert_eq!(world.woken(), ["x-next", "y-next"]);
    assert_eq!(world.turn(&all[3]), expected(1, [20, 30]));
    assert_eq!(world.turn(&all[2]), expected(2, [40, 60]));
    // With the one that has ended goes what was known of runs.
    world.loses(&all[0]);
    world.slots.changed(&board_of(&all[0]));
    world.slots.allocate();
    assert_eq!(world.turn(&all[3]), wait(1));
}

#[test]
fn only_those_whose_turn_has_changed_are_woken() {
    let all: Vec<_> = (0..300)
        .map(|n| submission(&format!("{n:03}"), "x", n, json!({})))
        .collect();
    let world = World::new(one(), &all.iter().collect::<Vec<_>>());
    for object in &all {
        world.joins(object);
    }
    assert_eq!(world.woken().len(), 300, "each has to know its place");
    let turn = |n: usize| world.turn(&all[n]);
    assert_eq!((turn(0), turn(299)), (Turn::Go, wait(299)));
    for object in &all {
        world.joins(object);
    }
    assert_eq!(world.woken(), [""; 0], "nothing is new");
    world.slots.starts(&all[0]);
    world.shows(&submission(
        "000",
        "x",
        0,
        json!({"jobName": "j", "progress": {"done": 1, "total": 4, "unit": "routes", "text": "1/4"}}),
    ));
    assert_eq!(world.woken(), [""; 0], "nobody moves by it");
    world.shows(&submission("000", "x", 0, ended(1)));
    let woken = world.woken();
    assert_eq!(
        (turn(1), turn(2), turn(299)),
        (
            Turn::Go,
            Turn::Wait {
                position: 1,
                eta: Some(Eta::between(20 * 60, 30 * 60))
            },
            turn(299)
        )
    );
    let first: Vec<String> = (1..=20).map(|n| format!("{n:03}")).collect();
    assert_eq!(woken, first, "a step is news in the first places only");
    // Each learns of its place before it is there.
    let mut last = all[0].clone();
    let mut woken = Vec::new();
    for object in &all[1..250] {
        world.slots.leaves(object);
        woken.extend(world.woken().into_iter().filter(|name| name == "299"));
        last = object.clone();
    }
    assert_eq!(last.name_any(), "249");
    assert!((10..60).contains(&woken.len()), "{}", woken.len());
    assert_eq!(turn(299).position(), 49);
}

#[tokio::test(start_paused = true)]
async fn a_leaderboard_is_worked_out_once_in_a_tenth_of_a_second() {
    let all: Vec<_> = (0..50)
        .map(|n| submission(&format!("{n:02}"), "x", n, json!({})))
        .collect();
    let world = World::new(one(), &all.iter().collect::<Vec<_>>());
    let slots = Arc::clone(&world.slots);
    tokio::spawn(async move { slots.keep().await });
    let mut rounds = Vec::new();
    for object in &all {
        world.joins(object);
        tokio::time::sleep(EVERY / 10).await;
        let woken = std::mem::take(&mut *lock(&world.woken));
        rounds.extend((!woken.is_empty()).then_some(woken));
    }
    assert_eq!(rounds[0], ["00"], "the first one waits for nobody");
    assert!((4..=6).contains(&rounds.len()), "{rounds:?}");
    let mut names: Vec<_> = rounds.into_iter().flatten().collect();
    names.sort();
    assert!(
        names.len() >= 40 && names.is_sorted_by(|a, b| a < b),
        "each is woken once: {names:?}"
    );
}

#[test]
fn a_change_of_the_leaderboard_wakes_all_that_have_not_ended() {
    let all = [
        submission("a", "x", 1, json!({"reason": "LeaderboardNotReady"})),
        submission("b", "x", 2, json!({"jobName": "b-1"})),
        submission("c", "x", 3, ended(1)),
    ];
    let world = World::new(leaderboard(&json!({}), false), &[&all[0], &all[1], &all[2]]);
    world.slots.wake(&ObjectRef::from_obj(&world.leaderboard));
    assert_eq!(world.woken(), ["a", "b"]);
    world.slots.wake(&ObjectRef::new("other").within("ns"));
    assert_eq!(world.woken(), [""; 0]);
}

#[test]
fn a_finished_one_waits_for_nothing_although_another_attempt_was_asked_for_while_it_ran() {
    let mut end = condition("Finished", "True");
    end["reason"] = json!("Finished");
    let mut a = submission("a", "x", 1, json!({"attempt": 1, "conditions": [end]}));
    a.spec.attempt = Attempt(2);
    let world = World::new(one(), &[&a]);
    world.slots.wake(&ObjectRef::from_obj(&world.leaderboard));
    assert_eq!(world.woken(), [""; 0]);
}
