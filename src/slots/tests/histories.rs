//! In any history, and however late the watch shows it, no more run than there are slots, and every submission gets its turn.

use proptest::prelude::*;

use super::*;

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

struct History {
    world: World,
    all: Vec<Known>,
    second: i64,
}

fn limited(total: Option<u8>, per_team: Option<u8>, paused: bool) -> Leaderboard {
    leaderboard(&json!({"total": total, "perTeam": per_team}), paused)
}

fn finish(status: &mut SubmissionStatus, at: &Time) {
    status.times.finished = Some(at.clone());
    status.conditions = vec![serde_json::from_value(condition("Finished", "True")).unwrap()];
}

fn status(object: &Submission) -> &SubmissionStatus {
    object.status.as_ref().unwrap()
}

fn may_start(object: &Submission) -> bool {
    let is_leaving = object.spec.cancel || object.metadata.deletion_timestamp.is_some();
    !is_leaving && !status(object).has_ended() && status(object).job_name.is_none()
}

impl History {
    fn new(leaderboard: Leaderboard) -> Self {
        Self {
            world: World::new(leaderboard, &[]),
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
                let name = format!("s{}", self.second);
                let real = submission(&name, &team.to_string(), self.second, json!({"attempt": 1}));
                self.all.push(Known { real, shown: None });
            }
            Step::Removed(n) if n < self.all.len() => {
                let known = self.all.remove(n);
                self.world.loses(&known.real);
            }
            Step::Removed(_) => {}
            Step::Deleted(n) => self.change(n, |object, _| object.metadata.deletion_timestamp = Some(now)),
            Step::Priority(n, priority) => self.change(n, |object, _| object.spec.priority = priority),
            Step::Cancelled(n) => self.change(n, |object, _| object.spec.cancel = true),
            Step::Reconciled { n, fails } => self.reconcile(n, fails),
            Step::Refused(n) => {
                if let Some(known) = self.all.get(n).filter(|known| may_start(&known.real)) {
                    self.world.slots.leaves(&known.real);
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
            } => self.world.becomes(limited(total, per_team, paused)),
        }
        self.world.slots.allocate();
    }

    fn show(&mut self, n: usize) {
        let Some(known) = self.all.get_mut(n) else { return };
        self.world.shows(&known.real);
        known.shown = Some(known.real.clone());
    }

    fn end(&mut self, n: usize) {
        let now = time(self.second);
        self.change(n, |_, status| finish(status, &now));
        if let Some(known) = self.all.get(n) {
            self.world.slots.leaves(&known.real);
        }
    }

    /// As a reconcile does it: it knows what it has written itself, and the cache what the watch has shown.
    fn reconcile(&mut self, n: usize, fails: bool) {
        let Some(Known {
            real,
            shown: Some(shown),
        }) = self.all.get(n)
        else {
            return;
        };
        let slots = &self.world.slots;
        if !may_start(real) {
            return match status(real).job_name {
                Some(_) if !status(real).has_ended() => slots.starts(shown),
                _ => slots.leaves(shown),
            };
        }
        if self.world.turn(real) != Turn::Go {
            return self.world.joins(real);
        }
        slots.starts(shown);
        if fails {
            slots.did_not_start(shown);
        } else {
            self.change(n, |_, status| status.job_name = Some("job".into()));
        }
    }

    fn turns(&self) -> Vec<Turn> {
        self.all.iter().map(|known| self.world.turn(&known.real)).collect()
    }

    fn slots_in_use(&self) -> usize {
        self.all.iter().filter(|known| status(&known.real).has_slot()).count()
    }
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn whom_nothing_concerns_stands_as_before(steps in proptest::collection::vec(step(), 1..80)) {
        let mut history = History::new(limited(Some(1), None, false));
        for step in &steps {
            history.happens(step);
            let before = history.turns();
            history.world.woken();
            history.world.slots.changed(&board_of(&submission("any", "x", 1, json!({}))));
            prop_assert_eq!(history.world.woken(), [""; 0]);
            prop_assert_eq!(history.turns(), before);
        }
    }

    #[test]
    fn never_more_run_than_there_are_slots(total in 1..4_u8, steps in proptest::collection::vec(step(), 1..120)) {
        let mut history = History::new(limited(Some(total), None, false));
        for step in steps.iter().filter(|step| !matches!(step, Step::Limits { .. })) {
            history.happens(step);
            prop_assert!(history.slots_in_use() <= usize::from(total), "after {:?}", step);
        }
    }

    #[test]
    fn nobody_is_forgotten(steps in proptest::collection::vec(step(), 1..80)) {
        let mut history = History::new(limited(Some(1), None, false));
        for step in &steps {
            history.happens(step);
        }
        history.world.becomes(limited(Some(1), Some(1), false));
        // Everybody in turn runs and ends; a cancelled one only ends.
        for _ in 0..3 * history.all.len() {
            for n in 0..history.all.len() {
                history.show(n);
                history.world.slots.allocate();
                history.reconcile(n, false);
                history.world.slots.allocate();
                if !may_start(&history.all[n].real) {
                    history.end(n);
                }
            }
        }
        let left = history.all.iter().filter(|known| !status(&known.real).has_ended());
        let left: Vec<_> = left.map(|known| known.real.name_any()).collect();
        prop_assert!(left.is_empty(), "{left:?} never ran");
        prop_assert!(lock(&history.world.slots.lines).is_empty(), "nothing is kept of them");
    }
}
