//! The line of one Leaderboard: who waits for a slot, and who was let go and shows no Job yet. Pure: what else counts is handed in.

use std::collections::HashMap;
use std::mem::{discriminant, take};

use super::member::Member;
use super::turns::{InLine, Limits, Past, Turn, turns};
use leaderboard_api::Attempt;

/// A place that has changed by one part in so many is news; in the first places of a line each step is.
const STEPS: i32 = 10;

#[derive(Default)]
pub struct Line {
    /// By UID.
    entries: HashMap<String, Entry>,
    /// Slots were granted last under these.
    limits: Limits,
    /// Something has changed since.
    pub is_dirty: bool,
}

struct Entry {
    attempt: Attempt,
    place: InLine,
    /// None until it was worked out. `Go` is a slot that is reserved for it.
    turn: Option<Turn>,
    /// The place that it was woken for.
    shown: i32,
    /// The reconcile that starts it is under way.
    is_started: bool,
    /// The cache shows it, and nothing that ends its place.
    is_kept: bool,
}

impl Line {
    /// Its turn, as last worked out. Under other limits a reservation counts no more, unless its start is under way.
    pub fn turn(&self, uid: &str, attempt: Attempt, limits: Limits) -> Turn {
        let entry = self.entries.get(uid).filter(|entry| entry.attempt == attempt);
        let counts = |entry: &&Entry| !entry.may_be_taken_back() || self.limits == limits;
        let turn = entry.filter(counts).and_then(|entry| entry.turn.clone());
        turn.unwrap_or(Turn::NotInLine)
    }

    pub fn join(&mut self, attempt: Attempt, place: InLine) {
        let Some(known) = self.entries.get_mut(&place.uid) else {
            let entry = Entry {
                attempt,
                place,
                turn: None,
                shown: 0,
                is_started: false,
                is_kept: false,
            };
            self.entries.insert(entry.place.uid.clone(), entry);
            self.is_dirty = true;
            return;
        };
        if known.attempt != attempt || !known.is_reserved() && known.place != place {
            known.turn = known.turn.take().filter(|turn| *turn != Turn::Go);
            (known.attempt, known.place) = (attempt, place);
            self.is_dirty = true;
        }
    }

    /// The Job is about to be created.
    pub fn starts(&mut self, uid: &str) {
        match self.entries.get_mut(uid) {
            Some(entry) if entry.is_reserved() => entry.is_started = true,
            _ => self.leaves(uid),
        }
    }

    pub fn did_not_start(&mut self, uid: &str) {
        if let Some(entry) = self.entries.get_mut(uid) {
            entry.is_started = false;
            self.is_dirty = true;
        }
    }

    pub fn leaves(&mut self, uid: &str) {
        self.is_dirty |= self.entries.remove(uid).is_some();
    }

    pub fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }

    /// Grants the slots that are free. Returns the names of those whose turn has changed.
    pub fn allocate<'a>(&mut self, limits: Limits, members: impl IntoIterator<Item = Member<'a>>) -> Vec<String> {
        self.is_dirty = false;
        if limits != self.limits {
            self.limits = limits;
            for entry in self.entries.values_mut().filter(|entry| entry.may_be_taken_back()) {
                entry.turn = None;
            }
        }
        let (mut woken, mut past) = (Vec::new(), Past::default());
        for member in members {
            member.note(&mut past);
            self.settle(&member, &mut past, &mut woken);
        }
        self.entries.retain(|_, entry| take(&mut entry.is_kept));
        let waiting = self.entries.values().filter(|entry| !entry.is_reserved());
        for (uid, turn) in turns(waiting.map(|entry| &entry.place), &past, limits) {
            if let Some(entry) = self.entries.get_mut(&uid) {
                if entry.is_news(&turn) {
                    entry.shown = turn.position();
                    woken.push(entry.place.name.clone());
                }
                entry.turn = Some(turn);
            }
        }
        woken
    }

    /// Finds what of a place or a reservation is over by what the cache shows, and notes who occupies a slot.
    fn settle(&mut self, member: &Member<'_>, past: &mut Past, woken: &mut Vec<String>) {
        let mut occupied_by = member.has_slot.then_some(&*member.team);
        if let Some(entry) = self.entries.get_mut(member.uid) {
            // One that has a slot already needs no other; only a pause holds it up.
            let is_let_through = member.has_slot && (!self.limits.paused || entry.place.is_check);
            let is_reserved = entry.is_reserved();
            let is_over = if is_reserved {
                member.has_slot || member.is_over || (member.is_leaving && !entry.is_started)
            } else {
                is_let_through || member.is_leaving
            };
            // The state of an earlier attempt ends nothing.
            entry.is_kept = !is_over || member.attempt < entry.attempt;
            if is_reserved && entry.is_kept {
                occupied_by = Some(&entry.place.team);
            } else if is_let_through && !is_reserved && !entry.is_kept {
                woken.push(entry.place.name.clone());
            }
        }
        past.occupied.extend(occupied_by.map(str::to_owned));
    }
}

impl Entry {
    fn is_reserved(&self) -> bool {
        self.turn == Some(Turn::Go)
    }

    fn may_be_taken_back(&self) -> bool {
        self.is_reserved() && !self.is_started
    }

    /// True if the turn is a reason to wake its submission.
    fn is_news(&self, turn: &Turn) -> bool {
        let Some(known) = &self.turn else { return true };
        let position = turn.position();
        discriminant(known) != discriminant(turn) || (position - self.shown).abs() >= (position / STEPS).max(1)
    }
}
