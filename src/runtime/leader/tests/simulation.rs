//! Three candidates, one Lease, and a network that delays, loses and reorders: at no moment may two of them write.
//!
//! The candidates run `decide` and the rules of the election's writes; a schedule of small steps is drawn at random.

use std::time::Duration;

use proptest::prelude::*;
use proptest::test_runner::{Config, TestRunner};

use crate::runtime::leader::Timing;
use crate::runtime::leader::decide::{Decision, Leading, ObservedLease, decide};
use crate::runtime::leader::record::{Identity, Record};

#[derive(Clone, Debug)]
enum Step {
    /// Time passes for all.
    Pass(Duration),
    /// A candidate reads, writes if it decides so, and hears of it at once.
    Turn(usize),
    /// A candidate reads and, if it decides so, sends a write.
    Act(usize),
    /// The oldest or the newest write of a candidate arrives at the server.
    Arrive(usize, bool),
    /// The candidate hears of it.
    Answer(usize),
    /// The candidate gives up waiting; the write may still arrive.
    GiveUp(usize),
    /// A person clears the holder of the Lease.
    Clear,
    /// A person deletes the Lease. Once, and when all have seen it: who has not can't know that somebody leads.
    Delete,
}

#[derive(Clone, Debug)]
struct Write {
    version: u64,
    record: Record,
    sent: Duration,
    outcome: Option<bool>,
    is_awaited: bool,
}

struct Candidate {
    identity: Identity,
    /// Its clock is ahead by so much.
    ahead: Duration,
    seen: ObservedLease,
    leading: Option<Leading>,
    is_lost: bool,
    writes: Vec<Write>,
}

struct World {
    now: Duration,
    version: u64,
    renewals: i64,
    record: Option<Record>,
    candidates: Vec<Candidate>,
    timing: Timing,
    was_deleted: bool,
}

impl World {
    fn new(timing: Timing) -> Self {
        let candidate = |n: u64| Candidate {
            identity: Identity::random("host"),
            ahead: Duration::from_secs(n * 1_000_000),
            seen: ObservedLease::default(),
            leading: None,
            is_lost: false,
            writes: Vec::new(),
        };
        let candidates = (0..3).map(candidate).collect();
        Self {
            now: Duration::ZERO,
            version: 1,
            renewals: 0,
            record: None,
            candidates,
            timing,
            was_deleted: false,
        }
    }

    fn step(&mut self, step: &Step) {
        match *step {
            Step::Pass(time) => self.now += time,
            Step::Turn(who) => {
                self.act(who);
                self.arrive(who, true);
                self.answer(who);
            }
            Step::Act(who) => self.act(who),
            Step::Arrive(who, newest) => self.arrive(who, newest),
            Step::Answer(who) => self.answer(who),
            Step::GiveUp(who) => {
                for write in &mut self.candidates[who].writes {
                    write.is_awaited = false;
                }
            }
            Step::Clear => {
                if let Some(record) = &mut self.record {
                    record.holder = None;
                    self.version += 1;
                }
            }
            Step::Delete => {
                if !self.was_deleted
                    && self
                        .candidates
                        .iter()
                        .all(|candidate| candidate.seen.last_term.is_some())
                {
                    self.was_deleted = true;
                    self.record = None;
                    self.version += 1;
                }
            }
        }
    }

    fn act(&mut self, who: usize) {
        let (version, record) = (self.version, self.record.clone());
        let candidate = &mut self.candidates[who];
        if candidate.is_lost || candidate.writes.iter().any(|write| write.is_awaited) {
            return;
        }
        let now = self.now + candidate.ahead;
        candidate.seen.note(record, now);
        let term = match decide(
            &candidate.seen,
            &candidate.identity,
            candidate.leading.as_ref(),
            &self.timing,
            now,
        ) {
            Decision::Acquire { term } | Decision::Renew { term } => term,
            Decision::Wait { .. } => return,
            Decision::Lost(_) => {
                candidate.is_lost = true;
                return;
            }
        };
        self.renewals += 1;
        let record = Record {
            holder: Some(candidate.identity.as_str().to_owned()),
            term,
            duration: self.timing.lease,
            renewed: jiff::Timestamp::from_second(self.renewals).ok(),
            is_free: false,
        };
        candidate.writes.push(Write {
            version,
            record,
            sent: now,
            outcome: None,
            is_awaited: true,
        });
    }

    fn arrive(&mut self, who: usize, newest: bool) {
        let mut pending = self.candidates[who]
            .writes
            .iter_mut()
            .filter(|write| write.outcome.is_none());
        let Some(write) = (if newest { pending.next_back() } else { pending.next() }) else {
            return;
        };
        let is_current = write.version == self.version;
        write.outcome = Some(is_current);
        if is_current {
            self.record = Some(write.record.clone());
            self.version += 1;
        }
    }

    fn answer(&mut self, who: usize) {
        let candidate = &mut self.candidates[who];
        let is_answered = |write: &Write| write.is_awaited && write.outcome.is_some();
        let Some(at) = candidate.writes.iter().position(is_answered) else {
            return;
        };
        let write = candidate.writes.remove(at);
        if write.outcome == Some(true) && !candidate.is_lost {
            let now = self.now + candidate.ahead;
            candidate.seen.note(Some(write.record.clone()), now);
            candidate.leading = Some(Leading {
                term: write.record.term,
                renewed_at: write.sent,
            });
        }
    }

    /// Processes whose fence is open.
    fn writers(&self) -> Vec<(usize, i32)> {
        let open = |(who, candidate): (usize, &Candidate)| {
            let leading = candidate.leading.filter(|_| !candidate.is_lost)?;
            let age = (self.now + candidate.ahead).saturating_sub(leading.renewed_at);
            (age < self.timing.renew_deadline).then_some((who, leading.term))
        };
        self.candidates.iter().enumerate().filter_map(open).collect()
    }
}

fn any_step() -> impl Strategy<Value = Step> {
    let who = 0..3usize;
    prop_oneof![
        10 => (0..8000u64).prop_map(|ms| Step::Pass(Duration::from_millis(ms))),
        10 => who.clone().prop_map(Step::Turn),
        4 => who.clone().prop_map(Step::Act),
        4 => (who.clone(), any::<bool>()).prop_map(|(who, newest)| Step::Arrive(who, newest)),
        4 => who.clone().prop_map(Step::Answer),
        2 => who.prop_map(Step::GiveUp),
        1 => Just(Step::Clear),
        1 => Just(Step::Delete),
    ]
}

/// Draws schedules until one of them lets two write, or a leader come after a later one.
fn search(timing: Timing, seed: TestRunner) -> Result<(), String> {
    let mut runner = seed;
    let schedule = proptest::collection::vec(any_step(), 1..150);
    let found = runner.run(&schedule, |steps| {
        let mut world = World::new(timing);
        let mut highest = 0;
        for step in &steps {
            world.step(step);
            let writers = world.writers();
            prop_assert!(writers.len() <= 1, "{writers:?} may write");
            for (_, term) in writers {
                prop_assert!(world.was_deleted || term >= highest, "term {term} after {highest}");
                highest = term;
            }
        }
        Ok(())
    });
    found.map_err(|error| error.to_string())
}

fn config() -> Config {
    Config {
        failure_persistence: None,
        ..Config::with_cases(3000)
    }
}

#[test]
fn at_no_moment_may_two_candidates_write() {
    if let Err(schedule) = search(Timing::default(), TestRunner::new(config())) {
        panic!("{schedule}");
    }
}

#[test]
fn the_simulation_finds_a_lease_that_is_too_short() {
    let too_short = Timing {
        lease: Duration::from_secs(8),
        ..Timing::default()
    };
    let found = search(too_short, TestRunner::new(config())).expect_err("two candidates that may write");
    assert!(found.contains("may write"), "{found}");
}

#[test]
fn the_simulation_does_change_leaders() {
    let mut world = World::new(Timing::default());
    let turn = |world: &mut World, who| world.step(&Step::Turn(who));
    turn(&mut world, 0);
    assert_eq!(world.writers(), [(0, 1)]);
    turn(&mut world, 1);
    world.step(&Step::Pass(Duration::from_secs(15)));
    assert_eq!(world.writers(), []);
    turn(&mut world, 1);
    assert_eq!(world.writers(), [(1, 2)]);
    turn(&mut world, 0);
    assert!(world.candidates[0].is_lost);
}
