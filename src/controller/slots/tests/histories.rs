//! Whatever happens, and however late the watch shows it: no more run than there are slots, what is kept is what would be worked
//! out anew, and nobody is forgotten.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use proptest::prelude::*;
use serde_json::json;

use super::*;
use jiff::Timestamp;
use leaderboard_api::{Submission, SubmissionStatus, conditions};

/// Something that happens, to the n-th submission where it is one's.
#[derive(Clone, Debug)]
enum Step {
    Added {
        team: u8,
    },
    Removed(usize),
    Deleted(usize),
    Priority(usize, i32),
    Cancelled(usize),
    /// Its reconcile: asks for its turn, and starts it where it is due. `fails`: its status is not written.
    Reconciled {
        n: usize,
        fails: bool,
    },
    /// It waits for something else.
    Refused(usize),
    Scheduled(usize),
    Started(usize),
    Lost(usize),
    Ended(usize),
    Resumed(usize),
    /// The watch shows it as it is.
    Shown(usize),
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
        6 => (0..4_u8).prop_map(|team| Step::Added { team }),
        1 => n().prop_map(Step::Removed),
        1 => n().prop_map(Step::Deleted),
        2 => (n(), -2..3_i32).prop_map(|(n, priority)| Step::Priority(n, priority)),
        1 => n().prop_map(Step::Cancelled),
        10 => (n(), prop::bool::weighted(0.1)).prop_map(|(n, fails)| Step::Reconciled { n, fails }),
        1 => n().prop_map(Step::Refused),
        2 => n().prop_map(Step::Scheduled),
        2 => n().prop_map(Step::Started),
        1 => n().prop_map(Step::Lost),
        3 => n().prop_map(Step::Ended),
        2 => n().prop_map(Step::Resumed),
        8 => n().prop_map(Step::Shown),
        2 => (few(), few(), any::<bool>())
            .prop_map(|(total, per_team, paused)| Step::Limits { total, per_team, paused }),
    ]
}

/// A submission as it is, and as the watch has shown it last.
struct Known {
    real: Submission,
    shown: Option<Submission>,
}

struct World {
    line: Line,
    all: Vec<Known>,
    second: i64,
}

fn time(second: i64) -> Time {
    Time(Timestamp::from_second(second).unwrap())
}

fn limits(total: Option<u8>, per_team: Option<u8>, paused: bool) -> Limits {
    Limits {
        total: total.map(usize::from),
        per_team: per_team.map(usize::from),
        paused,
    }
}

fn submission(number: i64, team: u8) -> Submission {
    let spec = json!({"leaderboardName": "lb", "image": "i", "track": "sensors", "team": {"id": team.to_string()}});
    let mut object = Submission::new(&format!("s{number}"), serde_json::from_value(spec).unwrap());
    object.metadata.uid = Some(format!("u{number}"));
    object.metadata.creation_timestamp = Some(time(number));
    object.status = Some(SubmissionStatus {
        attempt: Some(Attempt(1)),
        ..SubmissionStatus::default()
    });
    object
}

fn uid(object: &Submission) -> &str {
    object.metadata.uid.as_deref().unwrap()
}

fn finish(status: &mut SubmissionStatus, at: &Time) {
    status.times.finished = Some(at.clone());
    let condition = json!({"type": "Finished", "status": "True", "reason": "R", "message": "",
                           "lastTransitionTime": "2026-01-01T00:00:00Z"});
    status.conditions = vec![serde_json::from_value(condition).unwrap()];
}

fn is_finished(object: &Submission) -> bool {
    conditions::is_true(&object.status.as_ref().unwrap().conditions, conditions::FINISHED)
}

fn has_slot(object: &Submission) -> bool {
    let status = object.status.as_ref().unwrap();
    !is_finished(object) && (status.job_name.is_some() || status.retry > 0)
}

fn may_start(object: &Submission) -> bool {
    let is_leaving = object.spec.cancel || object.metadata.deletion_timestamp.is_some();
    !is_leaving && !is_finished(object) && object.status.as_ref().unwrap().job_name.is_none()
}

impl World {
    fn new(limits: Limits) -> Self {
        let mut line = Line::default();
        line.set_limits(Some(limits));
        Self {
            line,
            all: Vec::new(),
            second: 0,
        }
    }

    fn change(&mut self, n: usize, change: impl FnOnce(&mut Submission, &mut SubmissionStatus)) {
        let Some(known) = self.all.get_mut(n) else { return };
        let mut status = known.real.status.take().unwrap();
        change(&mut known.real, &mut status);
        known.real.status = Some(status);
    }

    fn happens(&mut self, step: &Step) {
        self.second += 100;
        let now = time(self.second);
        match *step {
            Step::Added { team } => {
                let real = submission(self.second, team);
                self.all.push(Known { real, shown: None });
            }
            Step::Removed(n) if n < self.all.len() => {
                let known = self.all.remove(n);
                self.line.member(uid(&known.real), None);
            }
            Step::Removed(_) => {}
            Step::Deleted(n) => self.change(n, |object, _| object.metadata.deletion_timestamp = Some(now)),
            Step::Priority(n, priority) => self.change(n, |object, _| object.spec.priority = priority),
            Step::Cancelled(n) => self.change(n, |object, _| object.spec.cancel = true),
            Step::Reconciled { n, fails } => self.reconcile(n, fails),
            Step::Refused(n) => {
                if let Some(known) = self.all.get(n).filter(|known| may_start(&known.real)) {
                    self.line.leaves(uid(&known.real));
                }
            }
            Step::Scheduled(n) => self.change(n, |_, status| {
                status.times.scheduled = status.job_name.is_some().then_some(now);
            }),
            Step::Started(n) => self.change(n, |_, status| {
                if status.times.scheduled.is_some() {
                    status.times.started = Some(now);
                    status.track = Some("sensors".into());
                }
            }),
            Step::Lost(n) => self.change(n, |_, status| {
                if status.times.finished.is_none() && status.job_name.take().is_some() {
                    status.retry += 1;
                }
            }),
            Step::Ended(n) => self.end(n),
            Step::Resumed(n) => self.change(n, |object, status| {
                if status.times.finished.is_some() {
                    object.spec.attempt = object.spec.attempt.next();
                    object.spec.cancel = false;
                    *status = SubmissionStatus {
                        attempt: Some(object.spec.attempt),
                        track: status.track.clone(),
                        ..SubmissionStatus::default()
                    };
                }
            }),
            Step::Shown(n) => self.show(n),
            Step::Limits {
                total,
                per_team,
                paused,
            } => self.line.set_limits(Some(limits(total, per_team, paused))),
        }
        self.line.allocate();
    }

    fn show(&mut self, n: usize) {
        let Some(known) = self.all.get_mut(n) else { return };
        self.line.member(uid(&known.real), Some(Member::of(&known.real)));
        known.shown = Some(known.real.clone());
    }

    fn end(&mut self, n: usize) {
        let now = time(self.second);
        self.change(n, |_, status| finish(status, &now));
        if let Some(known) = self.all.get(n) {
            self.line.leaves(uid(&known.real));
        }
    }

    fn reconcile(&mut self, n: usize, fails: bool) {
        let Some(known) = self.all.get(n) else { return };
        let object = known.real.clone();
        if !may_start(&object) {
            if object.status.as_ref().unwrap().job_name.is_none() {
                self.line.leaves(uid(&object));
            }
            return;
        }
        if self.line.turn(uid(&object), object.spec.attempt) != Turn::Go {
            let place = InLine {
                uid: uid(&object).to_owned(),
                name: object.metadata.name.clone().unwrap(),
                team: object.spec.team.as_ref().unwrap().id.clone().unwrap(),
                track: "sensors".into(),
                priority: object.spec.priority,
                submitted: object.metadata.creation_timestamp.as_ref().unwrap().0,
                is_check: false,
            };
            return self.line.join(object.spec.attempt, place);
        }
        self.line.starts(uid(&object));
        if fails {
            self.line.did_not_start(uid(&object));
        } else {
            self.change(n, |_, status| status.job_name = Some("job".into()));
        }
    }

    /// The turns as they are kept, and as they are worked out from what the watch has shown; by UID.
    fn compare(&mut self) -> Result<(), TestCaseError> {
        let mut fresh = Line::default();
        fresh.set_limits(self.line.limits);
        for shown in self.all.iter().filter_map(|known| known.shown.as_ref()) {
            fresh.member(uid(shown), Some(Member::of(shown)));
        }
        fresh.reserved = self.line.reserved.clone();
        fresh.waiting = self.line.waiting.clone();
        fresh.allocate();
        prop_assert_eq!((fresh.counts, fresh.in_use), (self.line.counts, self.line.in_use));
        for known in &self.all {
            let (uid, attempt) = (uid(&known.real), known.real.spec.attempt);
            prop_assert_eq!(self.line.turn(uid, attempt), fresh.turn(uid, attempt), "{}", uid);
        }
        Ok(())
    }

    fn slots_in_use(&self) -> usize {
        self.all.iter().filter(|known| has_slot(&known.real)).count()
    }
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn what_is_kept_is_what_would_be_worked_out_anew(steps in proptest::collection::vec(step(), 1..80)) {
        let mut world = World::new(limits(Some(1), None, false));
        for step in &steps {
            world.happens(step);
            world.compare()?;
        }
    }

    #[test]
    fn never_more_run_than_there_are_slots(total in 1..4_u8, steps in proptest::collection::vec(step(), 1..120)) {
        let mut world = World::new(limits(Some(total), None, false));
        for step in steps.iter().filter(|step| !matches!(step, Step::Limits { .. })) {
            world.happens(step);
            prop_assert!(world.slots_in_use() <= usize::from(total), "after {:?}", step);
        }
    }

    #[test]
    fn nobody_is_forgotten(steps in proptest::collection::vec(step(), 1..80)) {
        let mut world = World::new(limits(Some(1), None, false));
        for step in &steps {
            world.happens(step);
        }
        world.line.set_limits(Some(limits(Some(1), Some(1), false)));
        // Everybody in turn runs and ends; a cancelled one only ends.
        for _ in 0..3 * world.all.len() {
            for n in 0..world.all.len() {
                world.show(n);
                world.line.allocate();
                world.reconcile(n, false);
                world.line.allocate();
                if !may_start(&world.all[n].real) {
                    world.end(n);
                }
            }
        }
        let left: Vec<_> = world.all.iter().filter(|known| !is_finished(&known.real)).map(|known| uid(&known.real)).collect();
        prop_assert!(left.is_empty(), "{left:?} never ran");
        prop_assert!(world.line.reserved.is_empty() && world.line.waiting.is_empty());
    }
}
