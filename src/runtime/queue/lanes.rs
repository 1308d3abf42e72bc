//! Objects that are ready to be reconciled, and which of them is next. Pure.
//!
//! The most urgent class is next, and in it what has waited longest. A lower class ages: once its oldest has waited for
//! `PATIENCE`, each fourth reconcile is its own, however much comes above it.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::Duration;

use tokio::time::Instant;

use super::Key;

/// How urgent a reconcile is, the most urgent first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Class {
    /// A stop, an end, or an answer that an end waits for.
    Urgent,
    /// It has no Job yet. Begins only with a permit to create one.
    New,
    /// It runs, or has nothing new.
    Refresh,
}

impl Class {
    pub const ALL: [Self; 3] = [Self::Urgent, Self::New, Self::Refresh];

    /// One word for metrics.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Urgent => "urgent",
            Self::New => "new",
            Self::Refresh => "refresh",
        }
    }
}

/// A moment, and a number that no other place has.
pub(super) type DueKey = (Instant, u64);
type Lane = BTreeMap<DueKey, Key>;

/// Time that a lower class waits before it ages: half of the usual `syncPeriodSeconds`.
const PATIENCE: Duration = Duration::from_secs(5);
/// Number of others that go first while an aged lower class waits.
const OTHERS_FIRST: u32 = 3;

/// All that is ready.
#[derive(Debug, Default)]
pub(super) struct Lanes {
    /// By class and namespace: one namespace may have no permit left.
    lanes: [HashMap<Arc<str>, Lane>; 3],
    /// How many others went first since each class has aged.
    passed_over: [u32; 3],
}

impl Lanes {
    pub(super) fn insert(&mut self, class: Class, place: DueKey, key: Key) {
        let lane = self.lanes[class as usize].entry(Arc::clone(&key.namespace));
        lane.or_default().insert(place, key);
    }

    pub(super) fn remove(&mut self, class: Class, place: DueKey, key: &Key) {
        let lanes = &mut self.lanes[class as usize];
        if let Some(lane) = lanes.get_mut(&key.namespace) {
            lane.remove(&place);
            if lane.is_empty() {
                lanes.remove(&key.namespace);
            }
        }
    }

    /// How many wait in each class.
    pub(super) fn depth(&self) -> [usize; 3] {
        self.lanes.each_ref().map(|lanes| lanes.values().map(Lane::len).sum())
    }

    /// Takes out what is next. `may_begin`: which classes may begin now; `has_permit`: the namespaces that may create a Job.
    pub(super) fn take(
        &mut self,
        now: Instant,
        may_begin: impl Fn(Class) -> bool,
        has_permit: impl Fn(&str) -> bool,
    ) -> Option<(Class, DueKey, Key)> {
        let heads = Class::ALL.map(|class| self.head(class, &has_permit).filter(|_| may_begin(class)));
        let first = heads.iter().position(Option::is_some)?;
        let is_aged =
            |head: &Option<(DueKey, Key)>| head.as_ref().is_some_and(|((since, _), _)| *since + PATIENCE <= now);
        for (class, head) in heads.iter().enumerate() {
            let waits = class > first && is_aged(head);
            self.passed_over[class] = if waits { self.passed_over[class] + 1 } else { 0 };
        }
        let due = (0..heads.len())
            .rev()
            .filter(|class| self.passed_over[*class] > OTHERS_FIRST);
        let next = due.max_by_key(|class| self.passed_over[*class]).unwrap_or(first);
        self.passed_over[next] = 0;
        let class = Class::ALL[next];
        let (place, key) = heads.into_iter().nth(next).flatten()?;
        self.remove(class, place, &key);
        Some((class, place, key))
    }

    fn head(&self, class: Class, has_permit: impl Fn(&str) -> bool) -> Option<(DueKey, Key)> {
        let lanes = self.lanes[class as usize].iter();
        let open = lanes.filter(|(namespace, _)| class != Class::New || has_permit(namespace));
        let heads = open.filter_map(|(_, lane)| lane.first_key_value());
        let (place, key) = heads.min_by_key(|(place, _)| **place)?;
        Some((*place, key.clone()))
    }
}
