//! The waiting line of each Leaderboard, worked out once for all who wait, and again only when something has changed.
//!
//! Holds the slots that were granted and whose Jobs the caches do not show yet, so that two passes at once never start
//! more than `concurrency.total`. Called by `observe`; the watch of Submissions tells it what has `moved`.

use std::collections::HashMap;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use jiff::Timestamp;
use kube::ResourceExt;
use tokio::time::Instant;

use super::uid_of;
use crate::controller::turns::{InLine, Limits, Past, turns};
use crate::controller::view::Turn;
use leaderboard_api::{Leaderboard, Submission, SubmissionStatus, conditions};

#[cfg(test)]
#[path = "board_histories.rs"]
mod histories;

/// A standing is worked out anew after this long: of what changes to and fro between two looks nothing is told.
const MAX_AGE: Duration = Duration::from_mins(1);

/// Namespace and name of a Leaderboard.
type Key = (String, String);

/// Lines by namespace and name of their Leaderboard.
#[derive(Default)]
pub struct Board(Mutex<Lines>);

#[derive(Default)]
struct Lines {
    /// Whose slot was granted, by UID, and on which Leaderboard.
    granted: HashMap<String, Key>,
    standings: HashMap<Key, Standing>,
}

/// Everyone in one line, as it was worked out last.
struct Standing {
    limits: Limits,
    since: Instant,
    turns: HashMap<String, Turn>,
}

impl Board {
    /// Whether a submission without a Job may start. `Go` takes the slot, if EvalAI's word on it is known (`is_asked`): before,
    /// nothing is started on it, and nobody is to wait for that. `all` is asked only where the line has changed.
    pub fn turn(
        &self,
        all: impl FnOnce() -> Vec<Arc<Submission>>,
        submission: &Submission,
        leaderboard: Option<&Leaderboard>,
        is_asked: bool,
    ) -> Turn {
        let waits = submission.status.as_ref().is_none_or(|s| s.job_name.is_none()) && !is_over(submission);
        let Some(leaderboard) = leaderboard.filter(|_| waits && is_asked) else {
            return Turn::Go;
        };
        let uid = uid_of(submission);
        let limits = limits(leaderboard);
        if limits == Limits::default() {
            return Turn::Go;
        }
        let mut lines = self.lock();
        if (lines.granted.contains_key(&uid) || is_between_tries(submission)) && !limits.paused {
            return Turn::Go;
        }
        let key = (leaderboard.namespace().unwrap_or_default(), leaderboard.name_any());
        let turn = lines.turn(all, &key, &uid, limits);
        if turn == Turn::Go {
            lines.standings.remove(&key);
            lines.granted.insert(uid, key);
        }
        turn
    }

    /// Something in the line of this Leaderboard is not as it was.
    pub fn moved(&self, namespace: &str, leaderboard: &str) {
        let key = (namespace.to_owned(), leaderboard.to_owned());
        self.lock().standings.remove(&key);
    }

    /// Gives the slot back of a submission that did not start after all, or has come to its end: a later attempt stands in
    /// line like anyone.
    pub fn settle(&self, uid: &str, status: &SubmissionStatus) {
        let is_over = conditions::is_true(&status.conditions, conditions::FINISHED);
        if is_over || (status.job_name.is_none() && status.retry == 0) {
            self.release(uid);
        }
    }

    /// Drops what is known of an object that is gone.
    pub fn release(&self, uid: &str) {
        let mut lines = self.lock();
        if let Some(key) = lines.granted.remove(uid) {
            lines.standings.remove(&key);
        }
    }

    fn lock(&self) -> MutexGuard<'_, Lines> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Lines {
    fn turn(&mut self, all: impl FnOnce() -> Vec<Arc<Submission>>, key: &Key, uid: &str, limits: Limits) -> Turn {
        let now = Instant::now();
        self.standings
            .retain(|_, known| now.duration_since(known.since) < MAX_AGE);
        let known = self.standings.get(key).filter(|known| known.limits == limits);
        if let Some(turn) = known.and_then(|known| known.turns.get(uid)) {
            return turn.clone();
        }
        let is_known = known.is_some();
        let all = all();
        if !is_known {
            let turns = standing(&all, key, &self.granted, None, limits);
            let turn = turns.get(uid).cloned();
            let since = now;
            let standing = Standing { limits, since, turns };
            self.standings.insert(key.clone(), standing);
            if let Some(turn) = turn {
                return turn;
            }
        }
        // Who is not in line, or is not yet, is shown the place that it would have.
        standing(&all, key, &self.granted, Some(uid), limits)
            .remove(uid)
            .unwrap_or(Turn::Wait { position: 0, eta: None })
    }
}

fn limits(leaderboard: &Leaderboard) -> Limits {
    let spec = &leaderboard.spec;
    Limits {
        total: spec.concurrency.total.and_then(|n| usize::try_from(n).ok()),
        per_team: spec.concurrency.per_team.and_then(|n| usize::try_from(n).ok()),
        paused: spec.paused,
    }
}

/// The turn of everyone who waits for a slot of a Leaderboard, and of `own`, who may not be in line.
fn standing(
    all: &[Arc<Submission>],
    (namespace, name): &Key,
    granted: &HashMap<String, Key>,
    own: Option<&str>,
    limits: Limits,
) -> HashMap<String, Turn> {
    let mut line = Vec::new();
    let mut past = Past::default();
    let is_of_it = |s: &&Arc<Submission>| {
        s.spec.leaderboard_name == *name && s.metadata.namespace.as_deref().unwrap_or_default() == namespace
    };
    for place in all.iter().filter(is_of_it).map(|s| Place::of(s)) {
        place.note(&mut past);
        match place.stand {
            Stand::Over => {}
            _ if own == Some(place.uid) => line.push(place.in_line()),
            _ if granted.contains_key(place.uid) => past.occupied.push(place.team.to_owned()),
            Stand::Runs => past.occupied.push(place.team.to_owned()),
            Stand::Waits => line.push(place.in_line()),
            Stand::Aside => {}
        }
    }
    turns(line, past, limits)
}

/// What of a Submission counts in the line of its Leaderboard; all of it, and nothing else.
#[derive(Hash)]
struct Place<'a> {
    uid: &'a str,
    team: &'a str,
    track: &'a str,
    priority: i32,
    submitted: Timestamp,
    stand: Stand,
    /// When its present or last run began.
    began: Option<Timestamp>,
    /// The track and the end of a run that has ended.
    run: Option<(&'a str, Timestamp)>,
}

#[derive(Clone, Copy, Hash)]
enum Stand {
    /// It has a slot.
    Runs,
    /// It waits for nothing but a slot.
    Waits,
    /// It waits for something else.
    Aside,
    Over,
}

impl<'a> Place<'a> {
    fn of(submission: &'a Submission) -> Self {
        let status = submission.status.as_ref();
        let times = status.map(|s| &s.times);
        let submitted = times.and_then(|t| t.submitted.as_ref());
        let created = submission.metadata.creation_timestamp.as_ref();
        let known = status.and_then(|s| s.track.as_deref());
        let began = times.and_then(|t| t.scheduled.as_ref().or(t.started.as_ref()));
        let run = times.and_then(|t| {
            // What never ran says nothing of how long a run takes.
            t.started.as_ref()?;
            Some((known?, t.finished.as_ref()?.0))
        });
        Self {
            uid: submission.metadata.uid.as_deref().unwrap_or_default(),
            team: team(submission),
            track: known.or(submission.spec.track.as_deref()).unwrap_or_default(),
            priority: submission.spec.priority,
            submitted: submitted.or(created).map(|t| t.0).unwrap_or_default(),
            stand: Stand::of(submission),
            began: began.map(|t| t.0),
            run,
        }
    }

    /// When its team was last served, and how long a run took that has ended.
    fn note(&self, past: &mut Past) {
        let Some(began) = self.began else { return };
        match past.served.get_mut(self.team) {
            Some(served) => *served = began.max(*served),
            None => _ = past.served.insert(self.team.to_owned(), began),
        }
        if let Some((track, ended)) = self.run {
            let run = (ended, ended.duration_since(began).as_secs().max(0));
            match past.runs.get_mut(track) {
                Some(runs) => runs.push(run),
                None => _ = past.runs.insert(track.to_owned(), vec![run]),
            }
        }
    }

    fn in_line(&self) -> InLine {
        InLine {
            uid: self.uid.to_owned(),
            team: self.team.to_owned(),
            track: self.track.to_owned(),
            priority: self.priority,
            submitted: self.submitted,
        }
    }
}

impl Stand {
    fn of(submission: &Submission) -> Self {
        let has_job = submission.status.as_ref().is_some_and(|s| s.job_name.is_some());
        if is_over(submission) {
            Self::Over
        } else if has_job || is_between_tries(submission) {
            Self::Runs
        } else if can_start(submission) {
            Self::Waits
        } else {
            Self::Aside
        }
    }
}

/// Tells which changes of Submissions concern a line, by what was last seen of each.
#[derive(Default)]
pub struct Places(HashMap<String, u64>);

impl Places {
    /// Whether the line of its Leaderboard is no longer as it was.
    pub fn moved(&mut self, submission: &Submission, is_gone: bool) -> bool {
        if is_gone {
            // It may have come and gone between two looks, and been in a line all the same.
            self.0.remove(&uid_of(submission));
            return true;
        }
        let mut hasher = DefaultHasher::new();
        Place::of(submission).hash(&mut hasher);
        let mark = hasher.finish();
        self.0.insert(uid_of(submission), mark) != Some(mark)
    }
}

/// It lost its Job to the infrastructure and is about to get another: it keeps its slot.
fn is_between_tries(submission: &Submission) -> bool {
    let is_finished = |s: &SubmissionStatus| conditions::is_true(&s.conditions, conditions::FINISHED);
    let status = submission.status.as_ref();
    status.is_some_and(|s| s.retry > 0 && s.job_name.is_none() && !is_finished(s))
}

fn team(submission: &Submission) -> &str {
    let known = submission
        .status
        .as_ref()
        .and_then(|s| s.team.as_ref())
        .or(submission.spec.team.as_ref());
    let name = known.and_then(|t| t.id.as_deref().or(t.name.as_deref()));
    name.unwrap_or_default()
}

fn is_over(submission: &Submission) -> bool {
    let status = submission.status.as_ref();
    let ended = status.is_some_and(|s| conditions::is_true(&s.conditions, conditions::FINISHED));
    ended
        && status
            .and_then(|s| s.attempt)
            .is_some_and(|attempt| submission.spec.attempt <= attempt)
}

/// Whether another submission waits for nothing but a slot; one of EvalAI's may not be accepted yet.
fn can_start(submission: &Submission) -> bool {
    let conditions = submission.status.as_ref().map_or(&[][..], |s| &s.conditions);
    let accepted = conditions::get(conditions, conditions::ACCEPTED).map(|c| c.status.as_str());
    let is_accepted = match accepted {
        Some("True") => true,
        Some("False") => false,
        _ => submission.spec.evalai.is_none(),
    };
    is_accepted && !submission.spec.cancel && submission.metadata.deletion_timestamp.is_none()
}

#[cfg(test)]
mod tests {
    use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
    use serde_json::{Value, json};

    use super::*;

    fn leaderboard(running: &Value) -> Leaderboard {
        let spec = json!({
            "tracks": [{"name": "sensors", "codename": "SENSORS"}], "leaderboardVersion": "V2",
            "contents": {"image": "c"}, "simulator": {"image": "s"}, "storage": {"bucket": "b"}, "concurrency": running,
        });
        Leaderboard::new("lb", serde_json::from_value(spec).unwrap())
    }

    fn time(second: i64) -> Time {
        Time(jiff::Timestamp::from_second(second).unwrap())
    }

    /// A submission of a team; `status` is what the cache shows of it.
    fn submission(name: &str, team: &str, second: i64, status: Value) -> Submission {
        let spec = json!({"leaderboardName": "lb", "image": "i", "track": "sensors", "team": {"id": team}});
        let mut object = Submission::new(name, serde_json::from_value(spec).unwrap());
        object.metadata.uid = Some(name.into());
        object.metadata.creation_timestamp = Some(time(second));
        object.status = serde_json::from_value(status).unwrap();
        object
    }

    fn of_evalai(mut object: Submission) -> Submission {
        object.spec.evalai = serde_json::from_value(json!({"challenge": 1, "phase": 1, "submission": 1})).unwrap();
        object.spec.track = None;
        object
    }

    fn condition(type_: &str, status: &str) -> Value {
        json!({"type": type_, "status": status, "reason": "R", "message": "", "lastTransitionTime": "2026-01-01T00:00:00Z"})
    }

    fn ended(attempt: i64) -> Value {
        json!({"attempt": attempt, "jobName": "j", "track": "sensors", "conditions": [condition("Finished", "True")],
               "times": {"scheduled": time(0), "started": time(100), "finished": time(1500)}})
    }

    fn turn(board: &Board, all: &[Arc<Submission>], which: usize, running: &Value) -> Turn {
        board.turn(|| all.to_vec(), &all[which], Some(&leaderboard(running)), true)
    }

    fn shared(all: Vec<Submission>) -> Vec<Arc<Submission>> {
        all.into_iter().map(Arc::new).collect()
    }

    const ONE: fn() -> Value = || json!({"total": 1});

    #[test]
    fn a_slot_is_granted_once_and_given_back_at_the_end() {
        let board = Board::default();
        let mut all = shared(vec![
            submission("a", "x", 1, json!({})),
            submission("b", "y", 2, json!({})),
        ]);
        assert_eq!(turn(&board, &all, 0, &ONE()), Turn::Go);
        let second = Turn::Wait { position: 1, eta: None };
        assert_eq!(
            turn(&board, &all, 1, &ONE()),
            second,
            "the cache does not show the Job yet"
        );
        all[0] = Arc::new(submission("a", "x", 1, ended(1)));
        board.settle("a", all[0].status.as_ref().unwrap());
        assert_eq!(turn(&board, &all, 1, &ONE()), Turn::Go);

        // The first one's later attempt is not let past.
        let mut resumed = submission("a", "x", 1, json!({"attempt": 2}));
        resumed.spec.attempt = 2;
        all[0] = Arc::new(resumed);
        assert!(matches!(turn(&board, &all, 0, &ONE()), Turn::Wait { position: 1, .. }));
    }

    #[test]
    fn who_did_not_start_holds_no_slot() {
        let board = Board::default();
        let all = shared(vec![
            submission("a", "x", 1, json!({})),
            submission("b", "y", 2, json!({})),
        ]);
        assert_eq!(turn(&board, &all, 0, &ONE()), Turn::Go);
        let refused = json!({"conditions": [condition("Accepted", "False")]});
        let all = shared(vec![
            submission("a", "x", 1, refused),
            submission("b", "y", 2, json!({})),
        ]);
        board.settle("a", all[0].status.as_ref().unwrap());
        assert_eq!(turn(&board, &all, 1, &ONE()), Turn::Go);
    }

    #[test]
    fn nobody_waits_for_one_that_evalai_is_still_asked_about() {
        let board = Board::default();
        let asking = json!({"conditions": [condition("Accepted", "Unknown")]});
        let all = shared(vec![
            of_evalai(submission("a", "x", 1, asking)),
            submission("b", "y", 2, json!({})),
        ]);
        let asked = board.turn(|| all.clone(), &all[0], Some(&leaderboard(&ONE())), false);
        assert_eq!(asked, Turn::Go, "its pass says that EvalAI is asked");
        assert_eq!(turn(&board, &all, 1, &ONE()), Turn::Go);
        assert!(matches!(turn(&board, &all, 0, &ONE()), Turn::Wait { position: 1, .. }));
    }

    #[test]
    fn between_two_tries_the_slot_is_kept_also_by_another_leader() {
        let replacing = json!({"attempt": 1, "retry": 1, "times": {"started": time(5)}});
        let all = shared(vec![
            submission("a", "x", 9, replacing),
            submission("b", "y", 2, json!({})),
        ]);
        let board = Board::default();
        assert!(matches!(turn(&board, &all, 1, &ONE()), Turn::Wait { position: 1, .. }));
        assert_eq!(turn(&board, &all, 0, &ONE()), Turn::Go);
        let paused = leaderboard(&ONE());
        let paused = Leaderboard::new(
            "lb",
            leaderboard_api::LeaderboardSpec {
                paused: true,
                ..paused.spec
            },
        );
        let turn = board.turn(|| all.clone(), &all[0], Some(&paused), true);
        assert!(
            matches!(turn, Turn::Paused { .. }),
            "a paused Leaderboard makes no Job: {turn:?}"
        );
    }

    #[test]
    fn the_line_knows_who_was_served_and_how_long_runs_take() {
        let board = Board::default();
        let all = shared(vec![
            submission("x-old", "x", 1, ended(1)),
            submission(
                "x-now",
                "x",
                2,
                json!({"attempt": 1, "jobName": "j", "times": {"scheduled": time(2000)}}),
            ),
            submission("x-next", "x", 3, json!({})),
            submission("y-next", "y", 4, json!({})),
        ]);
        let wait = |position, eta: &str| Turn::Wait {
            position,
            eta: Some(eta.into()),
        };
        assert_eq!(turn(&board, &all, 3, &ONE()), wait(1, "20-30 min"));
        assert_eq!(turn(&board, &all, 2, &ONE()), wait(2, "40-60 min"));
        let other = submission("elsewhere", "x", 0, ended(1));
        let mut other = Submission {
            metadata: other.metadata,
            spec: other.spec,
            status: other.status,
        };
        other.spec.leaderboard_name = "another".into();
        let mut all = all;
        all[0] = Arc::new(other);
        board.moved("", "lb");
        assert_eq!(turn(&board, &all, 3, &ONE()), Turn::Wait { position: 1, eta: None });
    }
}
