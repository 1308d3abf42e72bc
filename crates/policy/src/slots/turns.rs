//! The order of waiting submissions: which of them start now, the place of the others, and the estimate of their wait.
//!
//! Pure; called by `slots`. Fair between teams: each pick goes to the team that has the least running
//! and picked so far, and among these to the one whose last run began longest ago. So a team with a hundred submissions
//! does not hold up another's first, even where only one runs at a time. Within a team the higher priority goes first,
//! then the older; those of one second stand in the order of their names. A check of the Leaderboard goes before all teams, and
//! starts while the Leaderboard is paused; it takes a slot as any other.

use std::collections::{BTreeSet, HashMap, VecDeque};

use jiff::Timestamp;
use leaderboard_api::Eta;

#[cfg(test)]
mod day_tests;

/// Runs of a track that its waiting times are estimated from.
pub const RUNS: usize = 20;

/// A submission's permission to start, or its place in line.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Turn {
    /// It waits for no slot yet, as far as is known.
    #[default]
    NotInLine,
    Go,
    Wait {
        position: i32,
        eta: Option<Eta>,
    },
    Paused {
        position: i32,
    },
}

impl Turn {
    /// Its place in line; 0 for one that has none.
    pub fn position(&self) -> i32 {
        match self {
            Self::Wait { position, .. } | Self::Paused { position } => *position,
            Self::NotInLine | Self::Go => 0,
        }
    }
}

/// A submission that waits for a slot.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct InLine {
    pub uid: String,
    pub name: String,
    pub team: String,
    pub track: String,
    pub priority: i32,
    pub submitted: Timestamp,
    /// A check of the Leaderboard, which stands in line as a team of its own.
    pub is_check: bool,
}

/// How many may run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Limits {
    pub total: Option<usize>,
    pub per_team: Option<usize>,
    pub paused: bool,
}

/// The present and past runs of a Leaderboard.
#[derive(Clone, Debug, Default)]
pub struct Past {
    /// The team of each submission that has a slot.
    pub occupied: Vec<String>,
    /// When the last run of a team began.
    pub served: HashMap<String, Timestamp>,
    /// When runs of a track ended, and the seconds that they took.
    pub runs: HashMap<String, Vec<(Timestamp, i64)>>,
}

/// Order of teams, the least first: no check, running and picked, the number of the last pick, the last start.
type Rank<'a> = (bool, usize, usize, Option<Timestamp>, Timestamp, &'a str);

/// The teams in line.
struct Teams<'a> {
    /// The next one first.
    ranked: BTreeSet<Rank<'a>>,
    waiting: HashMap<&'a str, VecDeque<&'a InLine>>,
    load: HashMap<&'a str, usize>,
    picked: HashMap<&'a str, usize>,
    picks: usize,
    served: &'a HashMap<String, Timestamp>,
}

/// The turn of everyone in line.
pub fn turns<'a>(line: impl IntoIterator<Item = &'a InLine>, past: &'a Past, limits: Limits) -> HashMap<String, Turn> {
    let mut free = limits
        .total
        .map_or(usize::MAX, |total| total.saturating_sub(past.occupied.len()));
    let quartiles: HashMap<&str, Quartiles> = past
        .runs
        .iter()
        .filter_map(|(track, runs)| Some((track.as_str(), Quartiles::of(runs.clone())?)))
        .collect();
    let mut teams = Teams::new(line, past);
    let mut result = HashMap::new();
    let mut position = 0;
    while let Some((pick, running)) = teams.pick() {
        let full = limits.per_team.is_some_and(|limit| running >= limit);
        let is_held = limits.paused && !pick.is_check;
        let turn = if !is_held && !full && free > 0 {
            free -= 1;
            Turn::Go
        } else {
            position += 1;
            if is_held {
                Turn::Paused { position }
            } else {
                let slots = limits.total.and_then(|n| i64::try_from(n).ok());
                let known = quartiles.get(pick.track.as_str());
                let eta = known.zip(slots).map(|(known, slots)| known.band(position, slots));
                Turn::Wait { position, eta }
            }
        };
        result.insert(pick.uid.clone(), turn);
    }
    result
}

impl<'a> Teams<'a> {
    fn new(line: impl IntoIterator<Item = &'a InLine>, past: &'a Past) -> Self {
        let mut line: Vec<&InLine> = line.into_iter().collect();
        line.sort_by(|a, b| {
            b.priority
                .cmp(&a.priority)
                .then(a.submitted.cmp(&b.submitted))
                .then_with(|| a.name.cmp(&b.name))
        });
        let mut load: HashMap<&str, usize> = HashMap::new();
        for team in &past.occupied {
            *load.entry(team).or_default() += 1;
        }
        let mut waiting: HashMap<&str, VecDeque<&InLine>> = HashMap::new();
        for each in line {
            waiting.entry(&each.team).or_default().push_back(each);
        }
        let mut teams = Self {
            ranked: BTreeSet::new(),
            waiting,
            load,
            picked: HashMap::new(),
            picks: 0,
            served: &past.served,
        };
        teams.ranked = teams.waiting.keys().filter_map(|team| teams.rank(team)).collect();
        teams
    }

    /// The next one, and how many of its team run or were picked before it.
    fn pick(&mut self) -> Option<(&'a InLine, usize)> {
        let (.., team) = self.ranked.pop_first()?;
        let pick = self.waiting.get_mut(team)?.pop_front()?;
        self.picks += 1;
        self.picked.insert(team, self.picks);
        let load = self.load.entry(team).or_default();
        let running = *load;
        *load += 1;
        // A pick changes the rank of no other team.
        self.ranked.extend(self.rank(team));
        Some((pick, running))
    }

    /// None if no submission of the team is in line.
    fn rank(&self, team: &'a str) -> Option<Rank<'a>> {
        let load = self.load.get(team).copied().unwrap_or(0);
        let picked = self.picked.get(team).copied().unwrap_or(0);
        let first = self.waiting.get(team)?.front()?;
        Some((
            !first.is_check,
            load,
            picked,
            self.served.get(team).copied(),
            first.submitted,
            team,
        ))
    }
}

/// How long runs of a track take.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Quartiles {
    lower: i64,
    median: i64,
    upper: i64,
}

impl Quartiles {
    /// The quartiles of the runs that ended last, in seconds. None without runs.
    fn of(mut runs: Vec<(Timestamp, i64)>) -> Option<Self> {
        runs.sort_by_key(|run| std::cmp::Reverse(*run));
        runs.truncate(RUNS);
        let mut seconds: Vec<i64> = runs.into_iter().map(|(_, seconds)| seconds).collect();
        seconds.sort_unstable();
        let at = |quarter: usize| {
            seconds
                .get((seconds.len().checked_sub(1)? * quarter).div_ceil(4))
                .copied()
        };
        Some(Self {
            lower: at(1)?,
            median: at(2)?,
            upper: at(3)?,
        })
    }

    /// The wait of a place in line: the median times position over slots, a fifth to either side, or more where runs differ.
    fn band(self, position: i32, slots: i64) -> Eta {
        let wait = |seconds: i64| seconds.saturating_mul(position.into()) / slots.max(1);
        let low = wait(self.lower).min(wait(self.median) * 4 / 5);
        let high = wait(self.upper).max(wait(self.median).saturating_mul(6) / 5);
        Eta::between(low, high)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    pub(super) fn waiting(uid: &str, team: &str, second: i64) -> InLine {
        let submitted = Timestamp::from_second(second).unwrap();
        InLine {
            uid: uid.into(),
            name: uid.into(),
            team: team.into(),
            track: "sensors".into(),
            priority: 0,
            submitted,
            is_check: false,
        }
    }

    fn check(uid: &str, second: i64) -> InLine {
        InLine {
            is_check: true,
            ..waiting(uid, &format!("check/{uid}"), second)
        }
    }

    pub(super) fn limits(total: usize) -> Limits {
        Limits {
            total: Some(total),
            ..Limits::default()
        }
    }

    fn occupied(teams: &[&str]) -> Past {
        Past {
            occupied: teams.iter().map(|team| (*team).to_owned()).collect(),
            ..Past::default()
        }
    }

    fn wait(position: i32) -> Turn {
        Turn::Wait { position, eta: None }
    }

    #[test]
    fn without_limits_everyone_goes() {
        let all = turns(
            &[waiting("a", "x", 1), waiting("b", "x", 2)],
            &occupied(&[]),
            Limits::default(),
        );
        assert!(all.values().all(|t| *t == Turn::Go));
        assert_eq!(all.len(), 2);
    }

    #[test]
    fn a_flood_of_one_team_does_not_hold_up_anothers_first() {
        let mut line: Vec<_> = (0..100).map(|n| waiting(&format!("x{n:03}"), "x", n)).collect();
        line.push(waiting("y", "y", 1000));
        let all = turns(&line, &occupied(&["x"]), limits(2));
        assert_eq!(all["y"], Turn::Go);
        assert_eq!(all["x000"], wait(1));
        assert_eq!(all["x099"], wait(100));
    }

    #[test]
    fn priority_orders_within_a_team_only() {
        let mut urgent = waiting("late", "x", 9);
        urgent.priority = 5;
        let all = turns(
            &[waiting("early", "x", 1), urgent, waiting("other", "y", 2)],
            &occupied(&[]),
            limits(2),
        );
        assert_eq!(all["late"], Turn::Go);
        assert_eq!(all["other"], Turn::Go);
        assert_eq!(all["early"], wait(1));
    }

    #[test]
    fn a_check_goes_first_and_takes_a_slot_as_any_other() {
        let mut line: Vec<_> = (0..200)
            .map(|n| waiting(&format!("x{n:03}"), &format!("t{n}"), n))
            .collect();
        line[7].priority = 1000;
        line.push(check("check-lb-1", 5000));
        line.push(check("check-lb-2", 6000));
        let all = turns(&line, &occupied(&["y"]), limits(1));
        assert_eq!((&all["check-lb-1"], &all["check-lb-2"]), (&wait(1), &wait(2)));
        assert_eq!(all["x000"], wait(3));
        let limits = Limits {
            total: Some(2),
            per_team: Some(1),
            paused: false,
        };
        let all = turns(&line, &occupied(&["y"]), limits);
        assert_eq!((&all["check-lb-1"], &all["check-lb-2"]), (&Turn::Go, &wait(1)));
    }

    #[test]
    fn a_check_starts_while_the_leaderboard_is_paused() {
        let limits = Limits {
            total: Some(1),
            per_team: None,
            paused: true,
        };
        let line = [waiting("a", "x", 1), check("check-lb-1", 9)];
        let all = turns(&line, &occupied(&[]), limits);
        assert_eq!(
            (&all["check-lb-1"], &all["a"]),
            (&Turn::Go, &Turn::Paused { position: 1 })
        );
        let all = turns(&line, &occupied(&["y"]), limits);
        assert_eq!(
            (&all["check-lb-1"], &all["a"]),
            (&wait(1), &Turn::Paused { position: 2 })
        );
    }

    #[test]
    fn those_of_one_second_stand_in_the_order_of_their_names() {
        let named = |name: &str, uid| InLine {
            name: name.into(),
            ..waiting(uid, "x", 1)
        };
        let all = turns(
            &[named("second", "b"), named("third", "a")],
            &occupied(&["x"]),
            limits(1),
        );
        assert_eq!((&all["b"], &all["a"]), (&wait(1), &wait(2)));
    }

    #[test]
    fn a_team_at_its_limit_waits_though_slots_are_free() {
        let limits = Limits {
            total: Some(5),
            per_team: Some(1),
            paused: false,
        };
        let all = turns(&[waiting("a", "x", 1), waiting("b", "y", 2)], &occupied(&["x"]), limits);
        assert_eq!(all["a"], wait(1));
        assert_eq!(all["b"], Turn::Go);
    }

    #[test]
    fn a_paused_leaderboard_starts_nobody_but_keeps_the_places() {
        let limits = Limits {
            paused: true,
            ..Limits::default()
        };
        let all = turns(&[waiting("a", "x", 1), waiting("b", "y", 2)], &occupied(&[]), limits);
        assert_eq!(all["a"], Turn::Paused { position: 1 });
        assert_eq!(all["b"], Turn::Paused { position: 2 });
    }

    #[test]
    fn a_full_leaderboard_starts_nobody() {
        let all = turns(&[waiting("a", "x", 1)], &occupied(&["y", "z"]), limits(2));
        assert_eq!(all["a"], wait(1));
    }

    #[test]
    fn one_slot_goes_round_the_teams() {
        let mut line: Vec<_> = (0..100).map(|n| waiting(&format!("x{n:03}"), "x", n)).collect();
        line.push(waiting("y", "y", 1000));
        let mut past = occupied(&[]);
        past.served.insert("x".into(), Timestamp::from_second(2000).unwrap());
        let all = turns(&line, &past, limits(1));
        assert_eq!((&all["y"], &all["x000"]), (&Turn::Go, &wait(1)));
        // While y runs, and when it has ended and pushed again.
        past.occupied = vec!["y".into()];
        past.served.insert("y".into(), Timestamp::from_second(3000).unwrap());
        line.pop();
        line.push(waiting("y2", "y", 4000));
        let all = turns(&line, &past, limits(1));
        assert_eq!((&all["x000"], &all["y2"], &all["x001"]), (&wait(1), &wait(2), &wait(3)));
        past.occupied.clear();
        assert_eq!(turns(&line, &past, limits(1))["x000"], Turn::Go);
    }

    #[test]
    fn a_wait_is_the_median_run_times_the_place_over_the_slots() {
        let runs = |track: &str, seconds: &[i64]| {
            let ended = (0i64..).map(|n| Timestamp::from_second(n).unwrap());
            (track.to_owned(), ended.zip(seconds.iter().copied()).collect::<Vec<_>>())
        };
        let eta = |seconds: &[i64], place: i64, slots: usize| {
            let line: Vec<_> = (1..=place).map(|n| waiting(&n.to_string(), "x", n)).collect();
            let mut past = occupied(&["y"].repeat(slots));
            past.runs = [runs("sensors", seconds), runs("map", &[1])].into();
            match turns(&line, &past, limits(slots)).remove(&place.to_string()) {
                Some(Turn::Wait { eta, .. }) => eta.map(|eta| eta.to_string()),
                other => panic!("{other:?}"),
            }
        };
        assert_eq!(eta(&[], 1, 1), None, "nothing is known of the track");
        assert_eq!(eta(&[1500], 1, 1).as_deref(), Some("20-30 min"));
        assert_eq!(eta(&[1500], 2, 4).as_deref(), Some("10-15 min"));
        assert_eq!(eta(&[300], 1, 1).as_deref(), Some("4-6 min"));
        assert_eq!(eta(&[1], 1, 4).as_deref(), Some("0-1 min"));
        assert_eq!(eta(&[36_000], 1, 1).as_deref(), Some("8-12 h"));
        assert_eq!(eta(&[36_000], 10, 1).as_deref(), Some("3-5 d"));
        assert_eq!(
            eta(&[600, 1500, 1500, 1500, 3000], 1, 1).as_deref(),
            Some("20-30 min"),
            "one outlier to either side changes nothing"
        );
        assert_eq!(
            eta(&[600, 600, 1500, 3000, 3000], 1, 1).as_deref(),
            Some("10-50 min"),
            "runs that differ make it wide"
        );
        let mut old = vec![90_000; 50];
        old.extend([1500; RUNS]);
        assert_eq!(
            eta(&old, 1, 1).as_deref(),
            Some("20-30 min"),
            "only the last runs count"
        );
    }

    #[test]
    fn without_a_total_nobody_guesses() {
        let limits = Limits {
            per_team: Some(1),
            ..Limits::default()
        };
        let mut past = occupied(&["x"]);
        past.runs = [("sensors".to_owned(), vec![(Timestamp::UNIX_EPOCH, 60)])].into();
        assert_eq!(turns(&[waiting("a", "x", 1)], &past, limits)["a"], wait(1));
    }
}
