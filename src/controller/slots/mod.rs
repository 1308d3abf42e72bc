//! Who may start: one owner of the slots of each Leaderboard.
//!
//! A submission joins the line of its Leaderboard when all but the slot is settled (`Action::JoinLine`), and the answer wakes
//! it. A granted slot is a reservation until the watch shows its Job, or until it turns out that none comes. Fed by the watches
//! of Submissions, Jobs and Leaderboards and by the reconciles. No call here waits for anything: the next in line does not depend
//! on a bucket, a token or another Leaderboard. The order of the line is `turns`, which is pure.

mod line;
mod member;
pub mod turns;

pub use member::check_team;

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use futures::{Stream, StreamExt, stream};
use kube::ResourceExt;
use kube::runtime::reflector::ObjectRef;
use tokio::sync::Notify;
use tokio::time::Instant;

use crate::controller::objects::uid;
use crate::controller::slots::turns::{InLine, Limits, Turn};
use crate::kubernetes::objects::Job;
use crate::lock::lock;
use leaderboard_api::leaderboard::Counts;
use leaderboard_api::{Leaderboard, Submission};
use line::Line;
use member::Member;

/// Namespace and name of a Leaderboard: one that is deleted and made again has the same line.
type Key = (String, String);

/// The lines of all Leaderboards.
#[derive(Default)]
pub struct SlotAllocator {
    lines: Mutex<Lines>,
    /// There may be somebody to wake.
    changed: Notify,
}

#[derive(Default)]
struct Lines {
    /// The caches were taken in whole. Before, nobody knows which slots are free.
    is_synced: bool,
    by_board: HashMap<Key, Line>,
    woken: Vec<ObjectRef<Submission>>,
}

impl SlotAllocator {
    /// Takes in what the caches show when a process begins to lead. Before this no slot is granted.
    pub fn start(&self, leaderboards: &[Arc<Leaderboard>], jobs: &[Arc<Job>], submissions: &[Arc<Submission>]) {
        for object in leaderboards {
            self.leaderboard(object, false);
        }
        for object in jobs {
            self.job(object, false);
        }
        for object in submissions {
            self.submission(object, false);
        }
        lock(&self.lines).is_synced = true;
        self.changed.notify_one();
    }

    /// The watch shows a Leaderboard.
    pub fn leaderboard(&self, object: &Leaderboard, is_gone: bool) {
        self.change(&key_of(object), |line| {
            line.set_limits((!is_gone).then(|| limits(object)));
        });
    }

    /// The watch shows a Job. It has a slot although its Submission's status may not name it.
    pub fn job(&self, object: &Job, is_gone: bool) {
        let meta = &object.metadata;
        let Some(board) = &meta.labels.leaderboard else {
            return;
        };
        let key = (meta.namespace().to_owned(), board.to_string());
        // Ours is the first; somebody may have added another.
        if let Some(owner) = meta.owner_references.first() {
            self.change(&key, |line| line.job(&owner.uid, &meta.name, is_gone));
        }
    }

    /// The watch shows a Submission. Returns whether the counts of its Leaderboard have changed.
    pub fn submission(&self, object: &Submission, is_gone: bool) -> bool {
        let uid = object.uid().unwrap_or_default();
        self.change(&board_of(object), |line| {
            line.member(&uid, (!is_gone).then(|| Member::of(object)))
        })
    }

    /// Whether a submission without a Job may start now. Grants nothing.
    pub fn turn(&self, submission: &Submission, leaderboard: Option<&Leaderboard>) -> Turn {
        let Some(leaderboard) = leaderboard else {
            return Turn::NotInLine;
        };
        if limits(leaderboard) == Limits::default() {
            return Turn::Go;
        }
        let lines = lock(&self.lines);
        let line = lines.by_board.get(&board_of(submission));
        let uid = submission.metadata.uid.as_deref().unwrap_or_default();
        line.map_or(Turn::NotInLine, |line| line.turn(uid, submission.present_attempt()))
    }

    /// A submission waits for nothing but a slot. It is woken by the answer, and by each change of it.
    pub fn join(&self, submission: &Submission, place: InLine) {
        let attempt = submission.present_attempt();
        self.change(&board_of(submission), |line| line.join(attempt, place));
    }

    /// The Job is about to be created, or exists.
    pub fn starts(&self, submission: &Submission) {
        self.change(&board_of(submission), |line| line.starts(uid(submission)));
    }

    /// It was to start, and that failed: a pause or a lower limit may take the slot back again.
    pub fn did_not_start(&self, submission: &Submission) {
        self.change(&board_of(submission), |line| line.did_not_start(uid(submission)));
    }

    /// It waits for something else, or has come to its end: its place and its reservation are free.
    pub fn leaves(&self, submission: &Submission) {
        self.change(&board_of(submission), |line| line.leaves(uid(submission)));
    }

    /// The Leaderboard stands otherwise: wakes those that may have waited for that.
    pub fn wake_pending(&self, board: &ObjectRef<Leaderboard>) {
        self.wake(board, Line::pending);
    }

    /// The Leaderboard's spec has changed: wakes all that have not ended.
    pub fn wake_live(&self, board: &ObjectRef<Leaderboard>) {
        self.wake(board, Line::live);
    }

    fn wake(&self, board: &ObjectRef<Leaderboard>, whom: fn(&Line) -> Vec<String>) {
        let key = (board.namespace.clone().unwrap_or_default(), board.name.clone());
        let mut lines = lock(&self.lines);
        let names: Vec<String> = lines.by_board.get(&key).map(whom).unwrap_or_default();
        lines
            .woken
            .extend(names.iter().map(|name| ObjectRef::new(name).within(&key.0)));
        self.changed.notify_one();
    }

    /// How many Submissions of a Leaderboard there are by state, and how many still need it.
    pub fn census(&self, leaderboard: &Leaderboard) -> (Counts, usize) {
        let lines = lock(&self.lines);
        lines
            .by_board
            .get(&key_of(leaderboard))
            .map(Line::census)
            .unwrap_or_default()
    }

    /// The submissions whose turn has changed, as they change. At most half of the time goes into it, so that a burst of
    /// thousands that join is worked out together and not one by one.
    pub fn woken(self: &Arc<Self>) -> impl Stream<Item = ObjectRef<Submission>> + Send + use<> {
        let woken = stream::unfold((Arc::clone(self), Duration::ZERO), async |(slots, took)| {
            if took > Duration::from_millis(1) {
                tokio::time::sleep(took).await;
            }
            slots.changed.notified().await;
            let began = Instant::now();
            let woken = slots.allocate();
            let took = began.elapsed();
            Some((stream::iter(woken), (slots, took)))
        });
        woken.flatten()
    }

    /// Grants what is free. Returns those that have to know.
    fn allocate(&self) -> Vec<ObjectRef<Submission>> {
        let mut lines = lock(&self.lines);
        let mut woken = std::mem::take(&mut lines.woken);
        if !lines.is_synced {
            return woken;
        }
        for ((namespace, _), line) in lines.by_board.iter_mut().filter(|(_, line)| line.is_dirty) {
            let names = line.allocate();
            woken.extend(names.iter().map(|name| ObjectRef::new(name).within(namespace)));
        }
        woken
    }

    fn change<T>(&self, key: &Key, change: impl FnOnce(&mut Line) -> T) -> T {
        let mut lines = lock(&self.lines);
        let line = lines.by_board.entry(key.clone()).or_default();
        let result = change(line);
        if line.is_dirty {
            self.changed.notify_one();
        }
        if line.is_empty() {
            lines.by_board.remove(key);
        }
        result
    }
}

fn key_of(leaderboard: &Leaderboard) -> Key {
    (leaderboard.namespace().unwrap_or_default(), leaderboard.name_any())
}

fn board_of(submission: &Submission) -> Key {
    (
        submission.namespace().unwrap_or_default(),
        submission.spec.leaderboard_name.clone(),
    )
}

fn limits(leaderboard: &Leaderboard) -> Limits {
    let spec = &leaderboard.spec;
    Limits {
        total: spec.concurrency.total.and_then(|n| usize::try_from(n).ok()),
        per_team: spec.concurrency.per_team.and_then(|n| usize::try_from(n).ok()),
        paused: spec.paused,
    }
}

#[cfg(test)]
mod tests;
