//! A standing that is kept says what a fresh one would, whatever has happened; and it is worked out rarely.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use proptest::prelude::*;
use serde_json::{Value, json};

use super::*;

/// Something that happens, to the n-th submission where it is one's.
#[derive(Clone, Debug)]
enum Step {
    Added {
        team: u8,
        of_evalai: bool,
    },
    Removed(usize),
    Deleted(usize),
    Accepted(usize, bool),
    Priority(usize, i32),
    Track(usize),
    Cancelled(usize),
    /// Its pass asks for its turn, and starts it where it is due.
    Asks(usize),
    Scheduled(usize),
    Started(usize),
    Lost(usize),
    Ended(usize),
    Resumed(usize),
    /// Something that changes nothing for anybody.
    Progressed(usize),
    Limits {
        total: Option<u8>,
        per_team: Option<u8>,
        paused: bool,
    },
}

fn step() -> impl Strategy<Value = Step> {
    let n = || 0..12_usize;
    let few = || proptest::option::of(0..4_u8);
    prop_oneof![
        6 => (0..4_u8, any::<bool>()).prop_map(|(team, of_evalai)| Step::Added { team, of_evalai }),
        1 => n().prop_map(Step::Removed),
        1 => n().prop_map(Step::Deleted),
        3 => (n(), any::<bool>()).prop_map(|(n, good)| Step::Accepted(n, good)),
        2 => (n(), -2..3_i32).prop_map(|(n, priority)| Step::Priority(n, priority)),
        1 => n().prop_map(Step::Track),
        1 => n().prop_map(Step::Cancelled),
        8 => n().prop_map(Step::Asks),
        2 => n().prop_map(Step::Scheduled),
        2 => n().prop_map(Step::Started),
        1 => n().prop_map(Step::Lost),
        3 => n().prop_map(Step::Ended),
        2 => n().prop_map(Step::Resumed),
        2 => n().prop_map(Step::Progressed),
        2 => (few(), few(), any::<bool>())
            .prop_map(|(total, per_team, paused)| Step::Limits { total, per_team, paused }),
    ]
}

struct World {
    board: Board,
    places: Places,
    leaderboard: Leaderboard,
    all: Vec<Arc<Submission>>,
    second: i64,
}

fn leaderboard(total: Option<u8>, per_team: Option<u8>, paused: bool) -> Leaderboard {
    let mut running = json!({});
    for (key, value) in [("total", total), ("perTeam", per_team)] {
        if let Some(value) = value {
            running[key] = json!(value);
        }
    }
    let spec = json!({
        "tracks": [{"name": "sensors", "codename": "SENSORS"}], "leaderboardVersion": "V2",
        "contents": {"image": "c"}, "simulator": {"image": "s"}, "storage": {"bucket": "b"},
        "concurrency": running, "paused": paused,
    });
    let mut object = Leaderboard::new("lb", serde_json::from_value(spec).unwrap());
    object.metadata.namespace = Some("ns".into());
    object
}

fn submission(number: i64, team: u8, of_evalai: bool) -> Submission {
    let mut spec = json!({"leaderboardName": "lb", "image": "i", "track": "sensors", "team": {"id": team.to_string()}});
    if of_evalai {
        spec["evalai"] = json!({"challenge": 1, "phase": 1, "submission": number});
    }
    let mut object = Submission::new(&format!("s{number}"), serde_json::from_value(spec).unwrap());
    object.metadata.uid = Some(format!("u{number}"));
    object.metadata.namespace = Some("ns".into());
    object.metadata.creation_timestamp = Some(time(number));
    object.status = Some(SubmissionStatus::default());
    object
}

fn time(second: i64) -> Time {
    Time(Timestamp::from_second(second).unwrap())
}

fn set(status: &mut SubmissionStatus, type_: &str, truth: &str) {
    status.conditions.retain(|c| c.type_ != type_);
    let condition: Value = json!({"type": type_, "status": truth, "reason": "R", "message": "",
                                  "lastTransitionTime": "2026-01-01T00:00:00Z"});
    status.conditions.push(serde_json::from_value(condition).unwrap());
}

impl World {
    fn new() -> Self {
        Self {
            board: Board::default(),
            places: Places::default(),
            leaderboard: leaderboard(Some(1), None, false),
            all: Vec::new(),
            second: 0,
        }
    }

    /// The caches show another state of a submission, and the watch has told it.
    fn change(&mut self, n: usize, change: impl FnOnce(&mut Submission, &mut SubmissionStatus)) {
        let Some(known) = self.all.get_mut(n) else { return };
        let mut object = known.as_ref().clone();
        let mut status = object.status.take().unwrap_or_default();
        change(&mut object, &mut status);
        self.board.settle(&uid_of(&object), &status);
        object.status = Some(status);
        *known = Arc::new(object.clone());
        self.tell(&object, false);
    }

    fn tell(&mut self, object: &Submission, is_gone: bool) {
        if self.places.moved(object, is_gone) {
            self.board.moved("ns", "lb");
        }
    }

    fn happens(&mut self, step: &Step) {
        self.second += 100;
        let now = time(self.second);
        match *step {
            Step::Added { team, of_evalai } => {
                let object = submission(self.second, team, of_evalai);
                self.all.push(Arc::new(object.clone()));
                self.tell(&object, false);
            }
            Step::Removed(n) if n < self.all.len() => {
                let object = self.all.remove(n);
                self.tell(&object, true);
                self.board.release(&uid_of(object.as_ref()));
            }
            Step::Deleted(n) => self.change(n, |object, _| object.metadata.deletion_timestamp = Some(now)),
            Step::Accepted(n, good) => self.change(n, |_, status| {
                set(status, conditions::ACCEPTED, if good { "True" } else { "False" });
                status.times.submitted = Some(now);
            }),
            Step::Priority(n, priority) => self.change(n, |object, _| object.spec.priority = priority),
            Step::Track(n) => self.change(n, |_, status| status.track = Some("map".into())),
            Step::Cancelled(n) => self.change(n, |object, _| object.spec.cancel = true),
            Step::Asks(n) => self.asks(n),
            Step::Scheduled(n) => self.change(n, |_, status| {
                if status.job_name.is_some() {
                    status.times.scheduled = Some(now);
                }
            }),
            Step::Started(n) => self.change(n, |_, status| {
                if status.times.scheduled.is_some() {
                    status.times.started = Some(now);
                    status.track = Some("sensors".into());
                }
            }),
            Step::Lost(n) => self.change(n, |_, status| {
                if status.job_name.take().is_some() {
                    status.retry += 1;
                }
            }),
            Step::Ended(n) => self.change(n, |_, status| {
                status.times.finished = Some(now);
                status.attempt = status.attempt.or(Some(1));
                set(status, conditions::FINISHED, "True");
            }),
            Step::Resumed(n) => self.change(n, |object, status| {
                object.spec.attempt += 1;
                *status = SubmissionStatus {
                    attempt: Some(object.spec.attempt),
                    team: status.team.clone(),
                    track: status.track.clone(),
                    ..SubmissionStatus::default()
                };
            }),
            Step::Progressed(n) => self.change(n, |_, status| status.score = Some(format!("~{}", now.0.as_second()))),
            Step::Limits {
                total,
                per_team,
                paused,
            } => self.leaderboard = leaderboard(total, per_team, paused),
            Step::Removed(_) => {}
        }
    }

    fn asks(&mut self, n: usize) {
        let Some(object) = self.all.get(n).cloned() else { return };
        let turn = self
            .board
            .turn(|| self.all.clone(), &object, Some(&self.leaderboard), true);
        // Half of them write their Job's name later than the next one asks.
        if turn == Turn::Go && self.second % 200 == 0 {
            self.change(n, |_, status| status.job_name = Some("job".into()));
        }
    }

    /// The turns as the board says them, and as they are without anything kept; by UID.
    fn compare(&self) -> Result<(), TestCaseError> {
        let key = ("ns".to_owned(), "lb".to_owned());
        let limits = limits(&self.leaderboard);
        let mut lines = self.board.lock();
        for object in &self.all {
            let uid = uid_of(object.as_ref());
            let fresh = standing(&self.all, &key, &lines.granted, Some(&uid), limits).remove(&uid);
            let fresh = fresh.unwrap_or(Turn::Wait { position: 0, eta: None });
            prop_assert_eq!(lines.turn(|| self.all.clone(), &key, &uid, limits), fresh, "{}", uid);
        }
        Ok(())
    }
}

proptest! {
    #[test]
    fn what_is_kept_is_what_would_be_worked_out_anew(steps in proptest::collection::vec(step(), 1..80)) {
        let mut world = World::new();
        for step in &steps {
            world.happens(step);
            world.compare()?;
        }
    }
}

#[tokio::test(start_paused = true)]
async fn the_line_is_worked_out_once_for_all_who_wait() {
    let mut world = World::new();
    for _ in 0..300 {
        world.happens(&Step::Added {
            team: 1,
            of_evalai: false,
        });
    }
    world.happens(&Step::Asks(0));
    let looks = |world: &World| {
        let looks = std::cell::Cell::new(0);
        for object in &world.all[1..] {
            let all = || {
                looks.set(looks.get() + 1);
                world.all.clone()
            };
            let turn = world.board.turn(all, object, Some(&world.leaderboard), true);
            assert!(matches!(turn, Turn::Wait { position: 1.., .. }), "{turn:?}");
        }
        looks.get()
    };
    assert_eq!(looks(&world), 1);
    assert_eq!(looks(&world), 0);
    world.happens(&Step::Progressed(5));
    assert_eq!(looks(&world), 0, "nobody moves by it");
    world.happens(&Step::Priority(7, 1));
    assert_eq!(looks(&world), 1);
    world.leaderboard = leaderboard(Some(1), Some(1), false);
    assert_eq!(looks(&world), 1, "other limits");
    tokio::time::advance(MAX_AGE).await;
    assert_eq!(looks(&world), 1, "a minute later");
    assert_eq!(looks(&world), 0);
}
