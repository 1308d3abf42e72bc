//! Whose turn it is: which waiting submissions start now, and the place of the others.
//!
//! Pure; called by `observe` through `Board`. Fair between teams: each pick goes to the team that has the least running
//! and picked so far, so that a team with a hundred submissions does not hold up another's first. Within a team the
//! higher priority goes first, then the older.

use std::collections::{BTreeMap, HashMap};

use jiff::Timestamp;

use super::view::Turn;

/// A submission that waits for a slot.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct InLine {
    pub uid: String,
    pub team: String,
    pub priority: i32,
    pub submitted: Timestamp,
}

/// How many may run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Limits {
    pub total: Option<usize>,
    pub per_team: Option<usize>,
    pub paused: bool,
}

/// The turn of everyone in line. `occupied` holds the team of each submission that has a slot.
pub fn turns(mut line: Vec<InLine>, occupied: &[String], limits: Limits) -> HashMap<String, Turn> {
    line.sort_by(|a, b| {
        b.priority
            .cmp(&a.priority)
            .then(a.submitted.cmp(&b.submitted))
            .then(a.uid.cmp(&b.uid))
    });
    let mut load: HashMap<&str, usize> = HashMap::new();
    for team in occupied {
        *load.entry(team).or_default() += 1;
    }
    let mut teams: BTreeMap<String, std::collections::VecDeque<InLine>> = BTreeMap::new();
    for waiting in line {
        teams.entry(waiting.team.clone()).or_default().push_back(waiting);
    }
    // A set ordered by (load, first in line) would save the scan; the number of teams in line is small.
    let mut load: HashMap<String, usize> = load.into_iter().map(|(team, n)| (team.to_owned(), n)).collect();
    let mut free = limits
        .total
        .map_or(usize::MAX, |total| total.saturating_sub(occupied.len()));
    let mut result = HashMap::new();
    let mut position = 0;
    while let Some(team) = next_team(&teams, &load) {
        let Some(pick) = teams.get_mut(&team).and_then(std::collections::VecDeque::pop_front) else {
            break;
        };
        if teams.get(&team).is_some_and(std::collections::VecDeque::is_empty) {
            teams.remove(&team);
        }
        let running = load.entry(team).or_default();
        let full = limits.per_team.is_some_and(|limit| *running >= limit);
        *running += 1;
        let turn = if !limits.paused && !full && free > 0 {
            free -= 1;
            Turn::Go
        } else {
            position += 1;
            if limits.paused {
                Turn::Paused { position }
            } else {
                Turn::Wait { position, eta: None }
            }
        };
        result.insert(pick.uid, turn);
    }
    result
}

fn next_team(
    teams: &BTreeMap<String, std::collections::VecDeque<InLine>>,
    load: &HashMap<String, usize>,
) -> Option<String> {
    teams
        .iter()
        .filter_map(|(team, line)| {
            let first = line.front()?;
            Some((load.get(team).copied().unwrap_or(0), first.submitted, team))
        })
        .min()
        .map(|(_, _, team)| team.clone())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn waiting(uid: &str, team: &str, second: i64) -> InLine {
        let submitted = Timestamp::from_second(second).unwrap();
        InLine {
            uid: uid.into(),
            team: team.into(),
            priority: 0,
            submitted,
        }
    }

    fn limits(total: usize) -> Limits {
        Limits {
            total: Some(total),
            ..Limits::default()
        }
    }

    fn wait(position: i32) -> Turn {
        Turn::Wait { position, eta: None }
    }

    #[test]
    fn without_limits_everyone_goes() {
        let all = turns(vec![waiting("a", "x", 1), waiting("b", "x", 2)], &[], Limits::default());
        assert!(all.values().all(|t| *t == Turn::Go));
        assert_eq!(all.len(), 2);
    }

    #[test]
    fn a_flood_of_one_team_does_not_hold_up_anothers_first() {
        let mut line: Vec<_> = (0..100).map(|n| waiting(&format!("x{n:03}"), "x", n)).collect();
        line.push(waiting("y", "y", 1000));
        let all = turns(line, &["x".into()], limits(2));
        assert_eq!(all["y"], Turn::Go);
        assert_eq!(all["x000"], wait(1));
        assert_eq!(all["x099"], wait(100));
    }

    #[test]
    fn priority_orders_within_a_team_only() {
        let mut urgent = waiting("late", "x", 9);
        urgent.priority = 5;
        let all = turns(
            vec![waiting("early", "x", 1), urgent, waiting("other", "y", 2)],
            &[],
            limits(2),
        );
        assert_eq!(all["late"], Turn::Go);
        assert_eq!(all["other"], Turn::Go);
        assert_eq!(all["early"], wait(1));
    }

    #[test]
    fn a_team_at_its_limit_waits_though_slots_are_free() {
        let limits = Limits {
            total: Some(5),
            per_team: Some(1),
            paused: false,
        };
        let all = turns(vec![waiting("a", "x", 1), waiting("b", "y", 2)], &["x".into()], limits);
        assert_eq!(all["a"], wait(1));
        assert_eq!(all["b"], Turn::Go);
    }

    #[test]
    fn a_paused_leaderboard_starts_nobody_but_keeps_the_places() {
        let limits = Limits {
            paused: true,
            ..Limits::default()
        };
        let all = turns(vec![waiting("a", "x", 1), waiting("b", "y", 2)], &[], limits);
        assert_eq!(all["a"], Turn::Paused { position: 1 });
        assert_eq!(all["b"], Turn::Paused { position: 2 });
    }

    #[test]
    fn a_full_leaderboard_starts_nobody() {
        let all = turns(vec![waiting("a", "x", 1)], &["y".into(), "z".into()], limits(2));
        assert_eq!(all["a"], wait(1));
    }
}
