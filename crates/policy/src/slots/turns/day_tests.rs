//! A day of a Leaderboard, simulated: whether everyone gets their turn.

use std::collections::BTreeMap;

use jiff::Timestamp;

use super::tests::{limits, waiting};
use super::{InLine, Past, Turn, turns};

/// A day of a Leaderboard: teams that push again as soon as they can, each keeping so many in line.
struct Day {
    now: i64,
    slots: usize,
    line: Vec<InLine>,
    running: Vec<(i64, String)>,
    past: Past,
    random: fastrand::Rng,
    number: i64,
    /// Runs and seconds of each team.
    had: BTreeMap<String, (f64, f64)>,
}

impl Day {
    fn new(slots: usize, seed: u64) -> Self {
        Self {
            now: 0,
            slots,
            line: Vec::new(),
            running: Vec::new(),
            past: Past::default(),
            random: fastrand::Rng::with_seed(seed),
            number: 0,
            had: BTreeMap::new(),
        }
    }

    fn push(&mut self, team: &str) {
        self.number += 1;
        self.line.push(waiting(&format!("{:06}", self.number), team, self.now));
    }

    /// Starts all that may start, then goes on to the next end. Returns the team that ended.
    fn step(&mut self) -> String {
        self.past.occupied = self.running.iter().map(|(_, team)| team.clone()).collect();
        let turns = turns(&self.line, &self.past, limits(self.slots));
        let (start, wait): (Vec<_>, Vec<_>) = self.line.drain(..).partition(|each| turns[&each.uid] == Turn::Go);
        self.line = wait;
        for each in start {
            let seconds = self.random.i64(20 * 60..120 * 60);
            let had = self.had.entry(each.team.clone()).or_default();
            *had = (had.0 + 1.0, had.1 + f64::from(i32::try_from(seconds).unwrap()));
            let now = Timestamp::from_second(self.now).unwrap();
            self.past.served.insert(each.team.clone(), now);
            self.running.push((self.now + seconds, each.team));
        }
        self.running.sort();
        let (at, team) = self.running.remove(0);
        self.now = at;
        team
    }
}

/// 1 is fair, 1/n is all to one.
fn jain(shares: &[f64]) -> f64 {
    let n = f64::from(u32::try_from(shares.len()).unwrap());
    let (sum, squares) = shares.iter().fold((0.0, 0.0), |(sum, sq), x| (sum + x, sq + x * x));
    sum * sum / (n * squares)
}

#[test]
fn a_day_is_fair_to_all_who_always_have_work() {
    for (slots, seed) in [(1, 1), (2, 2), (4, 3), (8, 4), (12, 5)] {
        let mut day = Day::new(slots, seed);
        // One keeps a hundred in line, one twenty, the others push again when their last one has ended.
        for _ in 0..100 {
            day.push("flood");
        }
        for _ in 0..20 {
            day.push("many");
        }
        for team in ["a", "b", "c", "d"] {
            for _ in 0..slots.div_ceil(4) {
                day.push(team);
            }
        }
        while day.now < 86_400 {
            let ended = day.step();
            day.push(&ended);
        }
        let runs: Vec<f64> = day.had.values().map(|had| had.0).collect();
        let seconds: Vec<f64> = day.had.values().map(|had| had.1).collect();
        assert_eq!(runs.len(), 6, "{:?}", day.had);
        let (of_runs, of_time) = (jain(&runs), jain(&seconds));
        println!("{slots} slots: Jain index {of_runs:.3} of runs, {of_time:.3} of time; runs {runs:?}");
        assert!(of_runs >= 0.95, "{slots} slots: {of_runs}");
        // With a handful of runs a team, how long each takes is luck.
        let is_many = runs.iter().all(|runs| *runs >= 10.0);
        assert!(of_time >= 0.95 || !is_many, "{slots} slots: {of_time}");
    }
}

#[test]
fn a_flood_of_a_hundred_holds_up_nobodys_first_for_longer_than_one_run() {
    for slots in [1, 2, 4] {
        let mut day = Day::new(slots, 7);
        for _ in 0..100 {
            day.push("flood");
        }
        for _ in 0..10 {
            day.step();
        }
        day.push("late");
        let pushed = day.now;
        while !day.had.contains_key("late") {
            day.step();
        }
        // `step` has gone on to the end after its start.
        let started = day.past.served["late"].as_second();
        assert_eq!(started, pushed, "{slots} slots: the next one that is free is theirs");
    }
}
