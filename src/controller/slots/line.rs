//! One Leaderboard: who has a slot, who waits, and what has run. Knows no lock, no client and no clock.

use std::collections::HashMap;
use std::mem::discriminant;

use super::member::{Kind, Member, Stand};
use crate::controller::slots::turns::{InLine, Limits, Past, RUNS, Turn, turns};
use leaderboard_api::leaderboard::Counts;
use leaderboard_api::{Attempt, State};

#[cfg(test)]
#[path = "tests/histories.rs"]
mod histories;

/// A place that has changed by one part in so many is news; in the first places of a line each step is.
const STEPS: i32 = 10;

#[derive(Default)]
pub(super) struct Line {
    /// None while the watch shows no such Leaderboard.
    limits: Option<Limits>,
    members: HashMap<Box<str>, Box<Member>>,
    /// The UID of the owner of each Job, by the Job's name.
    jobs: HashMap<Box<str>, Box<str>>,
    /// The attempt of everybody in a slot, as the watch shows it.
    running: HashMap<Box<str>, Attempt>,
    reserved: HashMap<String, Reserved>,
    waiting: HashMap<String, Waiting>,
    past: Past,
    /// What has run has to be counted anew.
    is_past_stale: bool,
    counts: Counts,
    in_use: usize,
    /// Something has changed since slots were allocated last.
    pub(super) is_dirty: bool,
}

/// A slot whose Job the watch does not show yet.
#[derive(Clone)]
struct Reserved {
    waiting: Waiting,
    limits: Limits,
    /// The reconcile that starts it is under way.
    is_started: bool,
}

#[derive(Clone)]
struct Waiting {
    attempt: Attempt,
    place: InLine,
    /// None until it was worked out.
    turn: Option<Turn>,
    /// The place that it was woken for.
    shown: i32,
}

impl Line {
    pub(super) fn set_limits(&mut self, limits: Option<Limits>) {
        self.is_dirty |= self.limits != limits;
        self.limits = limits;
    }

    pub(super) fn job(&mut self, owner: &str, name: &str, is_gone: bool) {
        let known = self.jobs.get(name).map(AsRef::as_ref);
        if is_gone && known == Some(owner) {
            self.jobs.remove(name);
        } else if !is_gone && known != Some(owner) {
            // One of an older object of this name is gone.
            self.jobs.insert(name.into(), owner.into());
        }
        self.place(owner);
    }

    /// Takes in a Submission, or none if it is gone. Returns whether the counts have changed.
    pub(super) fn member(&mut self, uid: &str, new: Option<Member>) -> bool {
        let before = (self.counts, self.in_use);
        let old = match new {
            Some(new) => self.shown(uid, new),
            None => self.gone(uid),
        };
        if let Some(old) = &old {
            self.count(old, -1);
        }
        self.place(uid);
        before != (self.counts, self.in_use)
    }

    fn shown(&mut self, uid: &str, new: Member) -> Option<Member> {
        self.count(&new, 1);
        let old = self.members.get(uid);
        let is_same = old.is_some_and(|old| new.ran_as(old));
        if !is_same && old.is_none_or(|old| new.adds_to(old)) {
            note(&mut self.past, &new);
        } else if !is_same {
            self.is_past_stale = true;
        }
        self.is_dirty |= !is_same && new.began.is_some();
        self.is_dirty |= old.is_some_and(|old| old.team != new.team);
        let Some(known) = self.members.get_mut(uid) else {
            self.members.insert(uid.into(), Box::new(new));
            return None;
        };
        Some(std::mem::replace(known.as_mut(), new))
    }

    fn gone(&mut self, uid: &str) -> Option<Member> {
        self.leaves(uid);
        let old = self.members.remove(uid).map(|member| *member);
        let has_run = old.as_ref().is_some_and(|old| old.began.is_some());
        self.is_past_stale |= has_run;
        self.is_dirty |= has_run;
        old
    }

    /// Whether it may start, as it was worked out last.
    pub(super) fn turn(&self, uid: &str, attempt: Attempt) -> Turn {
        let Some(limits) = self.limits else {
            return Turn::NotInLine;
        };
        let holds = |reserved: &Reserved| {
            reserved.waiting.attempt == attempt && (reserved.is_started || reserved.limits == limits)
        };
        let is_held = limits.paused && !self.members.get(uid).is_some_and(|member| member.kind == Kind::Check);
        if self.reserved.get(uid).is_some_and(holds) || (!is_held && self.has_slot(uid, attempt)) {
            return Turn::Go;
        }
        let waiting = self.waiting.get(uid).and_then(|waiting| waiting.turn.clone());
        waiting.unwrap_or(Turn::NotInLine)
    }

    pub(super) fn join(&mut self, attempt: Attempt, place: InLine) {
        // One that is gone has left nothing behind; one that the watch has not shown yet joins when it does.
        let is_known = self.members.contains_key(place.uid.as_str());
        if !is_known
            || self
                .reserved
                .get(&place.uid)
                .is_some_and(|r| r.waiting.attempt == attempt)
        {
            return;
        }
        let known = self.waiting.get_mut(&place.uid);
        if known.as_ref().is_some_and(|w| w.place == place && w.attempt == attempt) {
            return;
        }
        self.is_dirty = true;
        if let Some(known) = known {
            (known.attempt, known.place) = (attempt, place);
            return;
        }
        let waiting = Waiting {
            attempt,
            place,
            turn: None,
            shown: 0,
        };
        self.waiting.insert(waiting.place.uid.clone(), waiting);
    }

    pub(super) fn starts(&mut self, uid: &str) {
        self.is_dirty |= self.waiting.remove(uid).is_some();
        if let Some(reserved) = self.reserved.get_mut(uid) {
            reserved.is_started = true;
        }
    }

    pub(super) fn did_not_start(&mut self, uid: &str) {
        if let Some(reserved) = self.reserved.get_mut(uid) {
            reserved.is_started = false;
            self.is_dirty = true;
        }
    }

    pub(super) fn leaves(&mut self, uid: &str) {
        let had_place = self.waiting.remove(uid).is_some();
        let had_slot = self.reserved.remove(uid).is_some();
        self.is_dirty |= had_place || had_slot;
    }

    /// Names of those that a change of the Leaderboard may let start.
    pub(super) fn pending(&self) -> Vec<String> {
        let pending = self.members.values().filter(|member| member.is_pending);
        pending.map(|member| member.name.clone()).collect()
    }

    /// Names of those that have not ended: how long each step of them may take is in the Leaderboard's spec.
    pub(super) fn live(&self) -> Vec<String> {
        let live = self.members.values().filter(|member| member.stand != Stand::Over);
        live.map(|member| member.name.clone()).collect()
    }

    pub(super) fn census(&self) -> (Counts, usize) {
        (self.counts, self.in_use)
    }

    pub(super) fn is_empty(&self) -> bool {
        self.limits.is_none()
            && self.members.is_empty()
            && self.jobs.is_empty()
            && self.reserved.is_empty()
            && self.waiting.is_empty()
    }

    /// Grants the slots that are free. Returns the names of those whose turn has changed.
    pub(super) fn allocate(&mut self) -> Vec<String> {
        self.is_dirty = false;
        let Some(limits) = self.limits else { return Vec::new() };
        self.take_back(limits);
        let mut woken = self.let_through(limits);
        if self.waiting.is_empty() {
            return woken;
        }
        self.recount_past();
        let running = self.running.keys().filter_map(|uid| Some(&self.members.get(uid)?.team));
        let reserved = self.reserved.values().map(|reserved| &reserved.waiting.place.team);
        self.past.occupied = running.chain(reserved).cloned().collect();
        let line = self.waiting.values().map(|waiting| &waiting.place);
        for (uid, turn) in turns(line, &self.past, limits) {
            let Some(waiting) = self.waiting.get_mut(&uid) else {
                continue;
            };
            if waiting.is_news(&turn) {
                waiting.shown = turn.position();
                woken.push(waiting.place.name.clone());
            }
            let is_granted = turn == Turn::Go;
            waiting.turn = Some(turn);
            if is_granted && let Some(waiting) = self.waiting.remove(&uid) {
                let reserved = Reserved {
                    waiting,
                    limits,
                    is_started: false,
                };
                self.reserved.insert(uid, reserved);
            }
        }
        woken
    }

    /// Under other limits, those that were let go and have not started stand in line again.
    fn take_back(&mut self, limits: Limits) {
        let is_stale = |reserved: &Reserved| !reserved.is_started && reserved.limits != limits;
        for (uid, reserved) in self.reserved.extract_if(|_, reserved| is_stale(reserved)) {
            let turn = None;
            let waiting = Waiting {
                turn,
                ..reserved.waiting
            };
            self.waiting.entry(uid).or_insert(waiting);
        }
    }

    /// Those that have a slot already need no other; only a pause holds them up.
    fn let_through(&mut self, limits: Limits) -> Vec<String> {
        if limits.paused {
            return Vec::new();
        }
        let running = &self.running;
        let holds = |uid: &String, waiting: &Waiting| running.get(uid.as_str()) == Some(&waiting.attempt);
        let through = self.waiting.extract_if(|uid, waiting| holds(uid, waiting));
        through.map(|(_, waiting)| waiting.place.name).collect()
    }

    fn has_slot(&self, uid: &str, attempt: Attempt) -> bool {
        self.running.get(uid) == Some(&attempt)
    }

    /// Works out whether a Submission has a slot, and what of its place and reservation is over.
    fn place(&mut self, uid: &str) {
        let Some(member) = self.members.get(uid) else {
            self.is_dirty |= self.running.remove(uid).is_some();
            return;
        };
        let has_job = || {
            self.jobs
                .get(member.job().as_str())
                .is_some_and(|owner| **owner == *uid)
        };
        let runs = match member.stand {
            Stand::Over => false,
            Stand::HasSlot => true,
            Stand::Idle => has_job(),
        };
        let attempt = member.number.attempt;
        let is_of_it = |of: Attempt| attempt >= of;
        let is_void = |reserved: &Reserved| {
            let is_left = member.is_leaving && !reserved.is_started;
            is_of_it(reserved.waiting.attempt) && (runs || member.stand == Stand::Over || is_left)
        };
        if self.reserved.get(uid).is_some_and(is_void) {
            self.reserved.remove(uid);
            self.is_dirty = true;
        }
        let is_gone = |waiting: &Waiting| is_of_it(waiting.attempt) && member.is_leaving;
        if self.waiting.get(uid).is_some_and(is_gone) {
            self.waiting.remove(uid);
            self.is_dirty = true;
        }
        let has_moved = match self.running.get_mut(uid) {
            Some(known) if runs => std::mem::replace(known, attempt) != attempt,
            None if runs => self.running.insert(uid.into(), attempt).is_none(),
            _ => self.running.remove(uid).is_some(),
        };
        self.is_dirty |= has_moved;
    }

    fn count(&mut self, member: &Member, by: i32) {
        if member.needs_leaderboard {
            self.in_use = self.in_use.saturating_add_signed(if by > 0 { 1 } else { -1 });
        }
        if member.kind == Kind::Check {
            return;
        }
        let counts = &mut self.counts;
        let count = match member.state {
            State::Pending => &mut counts.pending,
            State::Running | State::Resumed => &mut counts.running,
            State::Finished => &mut counts.finished,
            State::Failed => &mut counts.failed,
            State::Cancelled => &mut counts.cancelled,
        };
        *count += by;
    }

    fn recount_past(&mut self) {
        if std::mem::take(&mut self.is_past_stale) {
            self.past = Past::default();
            for member in self.members.values() {
                note(&mut self.past, member);
            }
        }
    }
}

impl Waiting {
    /// Whether its submission has to be woken for a turn.
    fn is_news(&self, turn: &Turn) -> bool {
        let Some(known) = &self.turn else { return true };
        let position = turn.position();
        discriminant(known) != discriminant(turn) || (position - self.shown).abs() >= (position / STEPS).max(1)
    }
}

/// Adds when a team was last served, and how long a run took that has ended.
fn note(past: &mut Past, member: &Member) {
    let Some(began) = member.began else { return };
    match past.served.get_mut(&member.team) {
        Some(served) => *served = began.max(*served),
        None => _ = past.served.insert(member.team.clone(), began),
    }
    if let Some(ended) = member.ended {
        let run = (ended, ended.duration_since(began).as_secs().max(0));
        let runs = past.runs.entry(member.track.clone()).or_default();
        runs.push(run);
        if runs.len() >= 4 * RUNS {
            runs.sort_by_key(|run| std::cmp::Reverse(*run));
            runs.truncate(RUNS);
        }
    }
}
