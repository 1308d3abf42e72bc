//! The waiting line of each Leaderboard, worked out again only when something has changed.
//!
//! Holds the slots that were granted and whose Jobs the caches do not show yet, so that two passes at once never start
//! more than `running.total`.

use std::collections::HashSet;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use kube::ResourceExt;

use super::uid_of;
use crate::api::{Leaderboard, Submission, SubmissionStatus, conditions};
use crate::controller::turns::{InLine, Limits, Past, turns};
use crate::controller::view::Turn;

/// Lines by namespace and name of their Leaderboard.
#[derive(Default)]
pub struct Board {
    granted: Mutex<HashSet<String>>,
}

impl Board {
    /// Whether a submission without a Job may start. `Go` takes the slot, if EvalAI's word on it is known (`is_asked`): before,
    /// nothing is started on it, and nobody is to wait for that.
    pub fn turn(
        &self,
        all: &[Arc<Submission>],
        submission: &Submission,
        leaderboard: Option<&Leaderboard>,
        is_asked: bool,
    ) -> Turn {
        let waits = submission.status.as_ref().is_none_or(|s| s.job.is_none()) && !is_over(submission);
        let Some(leaderboard) = leaderboard.filter(|_| waits && is_asked) else {
            return Turn::Go;
        };
        let uid = uid_of(submission);
        let spec = &leaderboard.spec;
        let limits = Limits {
            total: spec.running.total.and_then(|n| usize::try_from(n).ok()),
            per_team: spec.running.per_team.and_then(|n| usize::try_from(n).ok()),
            paused: spec.paused,
        };
        if limits == Limits::default() {
            return Turn::Go;
        }
        let mut granted = self.lock();
        if (granted.contains(&uid) || is_between_tries(submission)) && !limits.paused {
            return Turn::Go;
        }
        let (line, past) = line_of(all, leaderboard, &granted, &uid);
        let turn = turns(line, past, limits)
            .remove(&uid)
            .unwrap_or(Turn::Wait { position: 0, eta: None });
        if turn == Turn::Go {
            granted.insert(uid);
        }
        turn
    }

    /// Gives the slot back of a submission that did not start after all, or has come to its end: a later attempt stands in
    /// line like anyone.
    pub fn settle(&self, uid: &str, status: &SubmissionStatus) {
        let is_over = conditions::is_true(&status.conditions, conditions::FINISHED);
        if is_over || (status.job.is_none() && status.retry == 0) {
            self.release(uid);
        }
    }

    /// Drops what is known of an object that is gone.
    pub fn release(&self, uid: &str) {
        self.lock().remove(uid);
    }

    fn lock(&self) -> MutexGuard<'_, HashSet<String>> {
        self.granted.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Who waits for a slot of a Leaderboard, and what it runs and has run.
fn line_of(
    all: &[Arc<Submission>],
    leaderboard: &Leaderboard,
    granted: &HashSet<String>,
    own: &str,
) -> (Vec<InLine>, Past) {
    let (name, namespace) = (leaderboard.name_any(), leaderboard.namespace());
    let mut line = Vec::new();
    let mut past = Past::default();
    for other in all {
        if other.spec.leaderboard != name || other.metadata.namespace != namespace {
            continue;
        }
        note_past(&mut past, other);
        if is_over(other) {
            continue;
        }
        let uid = uid_of(other.as_ref());
        let has_job = other.status.as_ref().is_some_and(|s| s.job.is_some());
        if uid == own {
            line.push(in_line(uid, other));
        } else if granted.contains(&uid) || has_job || is_between_tries(other) {
            past.occupied.push(team(other).to_owned());
        } else if can_start(other) {
            line.push(in_line(uid, other));
        }
    }
    (line, past)
}

/// When its team was last served, and how long a run took that has ended.
fn note_past(past: &mut Past, submission: &Submission) {
    let Some(status) = &submission.status else { return };
    let times = &status.times;
    let Some(began) = times.scheduled.as_ref().or(times.started.as_ref()).map(|t| t.0) else {
        return;
    };
    let team = team(submission);
    match past.served.get_mut(team) {
        Some(served) => *served = began.max(*served),
        None => _ = past.served.insert(team.to_owned(), began),
    }
    // What never ran says nothing of how long a run takes.
    if let (Some(track), Some(_), Some(ended)) = (&status.track, &times.started, &times.finished) {
        let run = (ended.0, ended.0.duration_since(began).as_secs().max(0));
        match past.runs.get_mut(track) {
            Some(runs) => runs.push(run),
            None => _ = past.runs.insert(track.clone(), vec![run]),
        }
    }
}

/// It lost its Job to the infrastructure and is about to get another: it keeps its slot.
fn is_between_tries(submission: &Submission) -> bool {
    let is_finished = |s: &SubmissionStatus| conditions::is_true(&s.conditions, conditions::FINISHED);
    let status = submission.status.as_ref();
    status.is_some_and(|s| s.retry > 0 && s.job.is_none() && !is_finished(s))
}

fn in_line(uid: String, submission: &Submission) -> InLine {
    let submitted = submission.status.as_ref().and_then(|s| s.times.submitted.as_ref());
    let created = submission.metadata.creation_timestamp.as_ref();
    let known = submission.status.as_ref().and_then(|s| s.track.clone());
    let track = known.or_else(|| submission.spec.track.clone());
    let submitted = submitted.or(created).map(|t| t.0).unwrap_or_default();
    InLine {
        uid,
        team: team(submission).to_owned(),
        track: track.unwrap_or_default(),
        priority: submission.spec.priority,
        submitted,
    }
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
            "tracks": [{"name": "sensors", "codename": "SENSORS"}], "results": "V2",
            "contents": {"image": "c"}, "simulator": {"image": "s"}, "storage": {"bucket": "b"}, "running": running,
        });
        Leaderboard::new("lb", serde_json::from_value(spec).unwrap())
    }

    fn time(second: i64) -> Time {
        Time(jiff::Timestamp::from_second(second).unwrap())
    }

    /// A submission of a team; `status` is what the cache shows of it.
    fn submission(name: &str, team: &str, second: i64, status: Value) -> Submission {
        let spec = json!({"leaderboard": "lb", "image": "i", "track": "sensors", "team": {"id": team}});
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
        json!({"attempt": attempt, "job": "j", "track": "sensors", "conditions": [condition("Finished", "True")],
               "times": {"scheduled": time(0), "started": time(100), "finished": time(1500)}})
    }

    fn turn(board: &Board, all: &[Arc<Submission>], which: usize, running: &Value) -> Turn {
        board.turn(all, &all[which], Some(&leaderboard(running)), true)
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
        let asked = board.turn(&all, &all[0], Some(&leaderboard(&ONE())), false);
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
            crate::api::LeaderboardSpec {
                paused: true,
                ..paused.spec
            },
        );
        let turn = board.turn(&all, &all[0], Some(&paused), true);
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
                json!({"attempt": 1, "job": "j", "times": {"scheduled": time(2000)}}),
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
        other.spec.leaderboard = "another".into();
        let mut all = all;
        all[0] = Arc::new(other);
        assert_eq!(turn(&board, &all, 3, &ONE()), Turn::Wait { position: 1, eta: None });
    }
}
