//! The slots of each Leaderboard, worked out from the caches: they decide which submissions may start.
//!
//! A submission joins the line of its Leaderboard when all but the slot is settled (`Action::JoinLine`), and the answer wakes it. The
//! memory here is small: the line, and the submission of each reserved slot until the cache shows its Job. All else is read anew from the
//! caches (`line`). A reservation ends also with its submission, with a plan that creates no Job, and with a pause or other limits.
//! No call here waits for anything: the next in line does not depend on a bucket, a token or another Leaderboard. The order of the line is
//! `turns`, which is pure.

use std::collections::{HashMap, HashSet};
use std::sync::Mutex;
use std::time::Duration;

use kube::runtime::reflector::ObjectRef;
use tokio::sync::Notify;
use tokio::time::Instant;

use crate::runtime::objects::{Wake, board_of, uid};
use crate::runtime::stores::Stores;
use leaderboard_api::{Leaderboard, Submission, SubmissionStatus};
use leaderboard_base::lock::lock;
use leaderboard_policy::slots::line::Line;
use leaderboard_policy::slots::member::{self, Member};
pub use leaderboard_policy::slots::member::{check_team, mark};
use leaderboard_policy::slots::turns::{InLine, Limits, Turn};

/// Slots are worked out once in this time at most: an event must not cost a look at all of thousands that wait.
const EVERY: Duration = Duration::from_millis(100);

/// The lines of all Leaderboards.
pub struct Slots {
    stores: Stores,
    wake: Wake<Submission>,
    lines: Mutex<HashMap<ObjectRef<Leaderboard>, Line>>,
    changed: Notify,
}

impl Slots {
    /// `wake` is for those whose turn has changed.
    pub fn new(stores: Stores, wake: Wake<Submission>) -> Self {
        Self {
            stores,
            wake,
            lines: Mutex::default(),
            changed: Notify::new(),
        }
    }

    /// Grants slots, once the caches have listed all objects: before that the free slots are not known.
    pub async fn keep(&self) {
        let (submissions, jobs) = (&self.stores.submissions, &self.stores.jobs);
        if tokio::try_join!(submissions.wait_until_ready(), jobs.wait_until_ready()).is_err() {
            // The task of a watch is gone, which ends the process.
            return;
        }
        loop {
            self.changed.notified().await;
            let began = Instant::now();
            self.allocate();
            tokio::time::sleep(EVERY.max(began.elapsed())).await;
        }
    }

    /// Works out the lines that have changed.
    fn allocate(&self) {
        let jobs = self.stores.jobs.state();
        // Ours is the first owner; somebody may have added another.
        let owned = jobs
            .iter()
            .filter_map(|job| Some((&*job.metadata.owner_references.first()?.uid, &*job.metadata.name)));
        let owned: HashSet<(&str, &str)> = owned.collect();
        let mut lines = lock(&self.lines);
        for (board, line) in lines.iter_mut().filter(|(_, line)| line.is_dirty) {
            let Some(leaderboard) = self.stores.leaderboards.get(board) else {
                continue;
            };
            let all = self.stores.submissions_for(board);
            let members = all
                .iter()
                .map(|one| Member::of(one, |job| owned.contains(&(uid(&**one), job))));
            for name in line.allocate(limits(&leaderboard), members) {
                (self.wake)(ObjectRef::new(&name).within(board.namespace.as_deref().unwrap_or_default()));
            }
        }
        lines.retain(|_, line| !line.is_empty());
    }

    /// The place of a submission without a Job. Grants nothing.
    pub fn turn(&self, submission: &Submission, leaderboard: Option<&Leaderboard>) -> Turn {
        let Some(limits) = leaderboard.map(limits) else {
            return Turn::NotInLine;
        };
        // Between two Jobs it keeps its slot.
        let has_slot = submission.status.as_ref().is_some_and(SubmissionStatus::has_slot);
        if limits == Limits::default() || has_slot && (!limits.paused || submission.spec.check) {
            return Turn::Go;
        }
        let lines = lock(&self.lines);
        let line = lines.get(&board_of(submission));
        line.map_or(Turn::NotInLine, |line| {
            line.turn(uid(submission), submission.present_attempt(), limits)
        })
    }

    /// Adds a submission that lacks only a slot to the line. The answer wakes it, and each change of the answer.
    pub fn join(&self, submission: &Submission, place: InLine) {
        self.change(submission, |line| line.join(submission.present_attempt(), place));
    }

    /// The Job is about to be created, or exists.
    pub fn starts(&self, submission: &Submission) {
        self.change(submission, |line| line.starts(uid(submission)));
    }

    /// It was to start, and that failed: a pause or a lower limit may take the slot back again.
    pub fn did_not_start(&self, submission: &Submission) {
        self.change(submission, |line| line.did_not_start(uid(submission)));
    }

    /// It waits for something else, has come to its end or is gone: its place and its reservation are free.
    pub fn leaves(&self, submission: &Submission) {
        self.change(submission, |line| line.leaves(uid(submission)));
    }

    /// The caches show something else of a Leaderboard, of one of its Submissions or of their Jobs.
    pub fn changed(&self, board: &ObjectRef<Leaderboard>) {
        if let Some(line) = lock(&self.lines).get_mut(board) {
            line.is_dirty = true;
            self.changed.notify_one();
        }
    }

    /// The Leaderboard stands otherwise: wakes all that have not ended. Each may have waited for that, and how long it may take has changed.
    pub fn wake(&self, board: &ObjectRef<Leaderboard>) {
        let all = self.stores.submissions_for(board);
        for submission in all.iter().filter(|submission| !member::is_over(submission)) {
            (self.wake)(ObjectRef::from_obj(submission.as_ref()));
        }
    }

    fn change(&self, submission: &Submission, change: impl FnOnce(&mut Line)) {
        let mut lines = lock(&self.lines);
        let board = board_of(submission);
        let line = lines.entry(board.clone()).or_default();
        change(line);
        if line.is_dirty {
            self.changed.notify_one();
        }
        if line.is_empty() {
            lines.remove(&board);
        }
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

#[cfg(test)]
mod tests;
