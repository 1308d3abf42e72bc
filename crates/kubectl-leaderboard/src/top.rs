//! `top`: who uses the slots of each Leaderboard and who waits, by team. Pure.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

use kube::ResourceExt;
use leaderboard_api::{Leaderboard, State, Submission};
use serde::Serialize;
use serde_json::{Value, json};

use super::facts;
use super::table::table;
use super::text::Frame;

/// The submissions of one team in one Leaderboard.
#[derive(Serialize, Debug, Default)]
#[serde(rename_all = "camelCase")]
struct Use {
    namespace: String,
    leaderboard: String,
    team: String,
    /// Submissions with a slot, also while their Pod starts.
    running: usize,
    waiting: usize,
    first_in_line: Option<i32>,
    finished: usize,
    failed: usize,
    cancelled: usize,
    crashes: i64,
}

fn uses(submissions: &[Submission]) -> Vec<Use> {
    let mut uses: BTreeMap<(String, String, String), Use> = BTreeMap::new();
    for one in submissions {
        let (namespace, leaderboard) = (one.namespace().unwrap_or_default(), one.spec.leaderboard_name.clone());
        let team = if one.spec.check {
            "(check)".to_owned()
        } else {
            one.team_name().unwrap_or_else(|| "(none)".to_owned())
        };
        let key = (namespace.clone(), leaderboard.clone(), team.clone());
        let each = uses.entry(key).or_insert_with(|| Use {
            namespace,
            leaderboard,
            team,
            ..Use::default()
        });
        let status = facts::status(one);
        match status.known_state() {
            Some(State::Running | State::Resumed) => each.running += 1,
            Some(State::Pending) if status.has_slot() => each.running += 1,
            None | Some(State::Pending) => each.waiting += 1,
            Some(State::Finished) => each.finished += 1,
            Some(State::Failed) => each.failed += 1,
            Some(State::Cancelled) => each.cancelled += 1,
        }
        let place = status.waiting.as_ref().map(|waiting| waiting.position);
        each.first_in_line = [each.first_in_line, place].into_iter().flatten().min();
        let crashes = status.workers.iter().map(|worker| i64::from(worker.crashes));
        each.crashes += crashes.sum::<i64>();
    }
    let mut all: Vec<Use> = uses.into_values().collect();
    let load = |each: &Use| Reverse((each.running, each.waiting));
    all.sort_by_cached_key(|each| (each.namespace.clone(), each.leaderboard.clone(), load(each)));
    all
}

/// The slots of a Leaderboard: `2/4`, or `2` where nothing limits them.
fn slots(board: Option<&Leaderboard>, running: usize) -> String {
    let total = board.and_then(|board| board.spec.concurrency.total);
    let total = total.map(|total| format!("/{total}")).unwrap_or_default();
    let is_paused = board.is_some_and(|board| board.spec.paused);
    let paused = if is_paused { ", paused" } else { "" };
    format!("{running}{total}{paused}")
}

/// The table, and above it the slots of each Leaderboard.
pub fn lines(submissions: &[Submission], leaderboards: &[Leaderboard], frame: Frame) -> Vec<String> {
    let uses = uses(submissions);
    let mut boards: BTreeMap<(String, String), (Option<&Leaderboard>, usize, usize)> = BTreeMap::new();
    for board in leaderboards {
        let key = (board.namespace().unwrap_or_default(), board.name_any());
        boards.insert(key, (Some(board), 0, 0));
    }
    for each in &uses {
        let key = (each.namespace.clone(), each.leaderboard.clone());
        let (_, running, waiting) = boards.entry(key).or_default();
        *running += each.running;
        *waiting += each.waiting;
    }
    let row = |((namespace, name), (board, running, waiting)): (&(String, String), &(_, usize, usize))| {
        let slots = slots(*board, *running);
        vec![namespace.clone(), name.clone(), slots, waiting.to_string()]
    };
    let rows: Vec<Vec<String>> = boards.iter().map(row).collect();
    let mut lines = table(&["NAMESPACE", "LEADERBOARD", "SLOTS", "WAITING"], &rows, frame.width);
    lines.push(String::new());
    // Leaderboards of several namespaces may have one name.
    let namespaces: BTreeSet<&String> = boards.keys().map(|(namespace, _)| namespace).collect();
    lines.extend(of_teams(&uses, namespaces.len() > 1, frame));
    lines
}

fn of_teams(uses: &[Use], is_qualified: bool, frame: Frame) -> Vec<String> {
    let head = [
        "NAMESPACE",
        "LEADERBOARD",
        "TEAM",
        "RUNNING",
        "WAITING",
        "FINISHED",
        "FAILED",
        "CANCELLED",
        "CRASHES",
    ];
    let left_out = usize::from(!is_qualified);
    let rows: Vec<Vec<String>> = uses.iter().map(|each| row(each).split_off(left_out)).collect();
    table(&head[left_out..], &rows, frame.width)
}

fn row(each: &Use) -> Vec<String> {
    let waiting = match each.first_in_line {
        Some(place) => format!("{} (#{place})", each.waiting),
        None => each.waiting.to_string(),
    };
    vec![
        each.namespace.clone(),
        each.leaderboard.clone(),
        each.team.clone(),
        each.running.to_string(),
        waiting,
        each.finished.to_string(),
        each.failed.to_string(),
        each.cancelled.to_string(),
        each.crashes.to_string(),
    ]
}

/// The table as JSON.
pub fn value(submissions: &[Submission]) -> Value {
    json!(uses(submissions))
}
