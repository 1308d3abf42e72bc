//! Times of reconciles: each object has one reconcile at a time, and none of its events is lost. Pure: the time is handed in.
//!
//! An object is ready, waits for a time, or runs. An event makes it ready at once; while it runs, any number of events makes one
//! more reconcile after it. The pause that a reconcile asks for counts from its end, unless something has happened meanwhile.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::Duration;

use tokio::time::Instant;

use super::Key;
use super::lanes::{Class, DueKey, Lanes};

/// How much may run at once.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Reconciles at once. The ones that are not urgent leave a quarter free.
    pub reconciles: usize,
    /// Reconciles that create a Job, which an admission webhook may hold up.
    pub creates: usize,
    pub creates_per_namespace: usize,
}

/// Step after a reconcile.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum After {
    /// The next one without any other cause, and how urgent it and all others are until then at the least.
    In(Duration, Class),
    /// It has to create a Job and has no permit: it begins anew with one.
    WithPermit,
    /// There is no such object.
    Gone,
}

/// A reconcile that begins.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Begun {
    pub key: Key,
    pub class: Class,
    /// How long it was ready.
    pub waited: Duration,
}

/// All objects of one kind.
#[derive(Debug)]
pub struct State {
    limits: Limits,
    objects: HashMap<Key, Object>,
    lanes: Lanes,
    timers: BTreeMap<DueKey, Key>,
    permits: Permits,
    running: usize,
    /// Running reconciles that are not urgent.
    running_others: usize,
    last_number: u64,
}

#[derive(Debug)]
struct Object {
    stage: Stage,
    /// How urgent each of its events is at the least.
    class: Class,
}

#[derive(Debug)]
enum Stage {
    Ready(Class, DueKey),
    Waits(DueKey),
    Runs(Run),
}

#[derive(Debug)]
struct Run {
    /// Since when it was ready.
    since: Instant,
    is_urgent: bool,
    has_permit: bool,
    /// Something has happened since it began.
    again: Option<(Class, Instant)>,
    /// It was deleted since it began.
    is_gone: bool,
}

impl State {
    pub fn new(limits: Limits) -> Self {
        Self {
            limits,
            objects: HashMap::new(),
            lanes: Lanes::default(),
            timers: BTreeMap::new(),
            permits: Permits::default(),
            running: 0,
            running_others: 0,
            last_number: 0,
        }
    }

    /// Something has happened to an object.
    pub fn add(&mut self, key: Key, class: Class, now: Instant) {
        let number = self.number();
        let Some(object) = self.objects.get_mut(&key) else {
            return self.enter(key, Class::Refresh, class, now);
        };
        let class = class.min(object.class);
        match &mut object.stage {
            Stage::Ready(old, place) if class < *old => {
                self.lanes.remove(*old, *place, &key);
                self.lanes.insert(class, *place, key);
                *old = class;
            }
            Stage::Ready(..) => {}
            Stage::Waits(place) => {
                self.timers.remove(place);
                let place = (now, number);
                object.stage = Stage::Ready(class, place);
                self.lanes.insert(class, place, key);
            }
            Stage::Runs(run) => {
                let (old, since) = run.again.unwrap_or((class, now));
                run.again = Some((old.min(class), since));
            }
        }
    }

    /// An object was deleted. A reconcile of it that runs comes to its end.
    pub fn forget(&mut self, key: &Key) {
        let Some(object) = self.objects.get_mut(key) else {
            return;
        };
        match &mut object.stage {
            Stage::Runs(run) => {
                (run.again, run.is_gone) = (None, true);
                return;
            }
            Stage::Ready(class, place) => self.lanes.remove(*class, *place, key),
            Stage::Waits(place) => {
                self.timers.remove(place);
            }
        }
        self.objects.remove(key);
    }

    /// Begins the next reconcile, if one may begin now.
    pub fn begin(&mut self, now: Instant) -> Option<Begun> {
        self.take_due(now);
        let Limits { reconciles, .. } = self.limits;
        let others_may = self.running_others < reconciles - reconciles / 4;
        if self.running >= reconciles {
            return None;
        }
        let may_begin = |class| class == Class::Urgent || others_may;
        let (permits, limits) = (&self.permits, self.limits);
        let (class, (since, _), key) = self
            .lanes
            .take(now, may_begin, |namespace| permits.is_free(limits, namespace))?;
        let has_permit = class == Class::New;
        if has_permit {
            self.permits.take(&key.namespace);
        }
        let is_urgent = class == Class::Urgent;
        self.running += 1;
        self.running_others += usize::from(!is_urgent);
        if let Some(object) = self.objects.get_mut(&key) {
            object.stage = Stage::Runs(Run {
                since,
                is_urgent,
                has_permit,
                again: None,
                is_gone: false,
            });
        }
        let waited = now.saturating_duration_since(since);
        Some(Begun { key, class, waited })
    }

    /// Exchanges the permit of a reconcile once its plan is known. A plan that creates a Job takes one: false if none is free, and the
    /// reconcile ends with `After::WithPermit`. Any other plan returns it.
    pub fn may_continue(&mut self, key: &Key, creates_job: bool) -> bool {
        let Some(Stage::Runs(run)) = self.objects.get_mut(key).map(|object| &mut object.stage) else {
            return !creates_job;
        };
        match (run.has_permit, creates_job) {
            (true, false) => self.permits.give_back(&key.namespace),
            (false, true) if !self.permits.is_free(self.limits, &key.namespace) => return false,
            (false, true) => self.permits.take(&key.namespace),
            _ => {}
        }
        run.has_permit = creates_job;
        true
    }

    /// A reconcile has ended.
    pub fn finish(&mut self, key: &Key, after: After, now: Instant) {
        let Some(object) = self.objects.remove(key) else { return };
        let Stage::Runs(run) = object.stage else {
            self.objects.insert(key.clone(), object);
            return;
        };
        self.running -= 1;
        self.running_others -= usize::from(!run.is_urgent);
        if run.has_permit {
            self.permits.give_back(&key.namespace);
        }
        let key = key.clone();
        let least = match after {
            After::In(_, least) => least,
            After::WithPermit | After::Gone => object.class,
        };
        match (run.again, after) {
            (Some((class, _)), After::WithPermit) => self.enter(key, least, class.min(Class::New), run.since),
            (Some((class, since)), _) => self.enter(key, least, class, since),
            (None, _) if run.is_gone => {}
            (None, After::Gone) => {}
            // It is urgent again when something happens; until then it waits like any that has to create a Job.
            (None, After::WithPermit) => self.ready(key, least, Class::New, run.since),
            (None, After::In(wait, _)) if wait.is_zero() => self.enter(key, least, least, now),
            (None, After::In(wait, _)) => self.wait(key, least, now + wait),
        }
    }

    /// When the next time comes that an object waits for.
    pub fn next_time(&self) -> Option<Instant> {
        self.timers.first_key_value().map(|((at, _), _)| *at)
    }

    /// How many are ready in each class.
    pub fn depth(&self) -> [usize; 3] {
        self.lanes.depth()
    }

    fn take_due(&mut self, now: Instant) {
        while let Some(first) = self.timers.first_entry().filter(|first| first.key().0 <= now) {
            let (place, key) = first.remove_entry();
            if let Some(object) = self.objects.get_mut(&key) {
                object.stage = Stage::Ready(object.class, place);
                self.lanes.insert(object.class, place, key);
            }
        }
    }

    /// Ready, and at least as urgent as its events are.
    fn enter(&mut self, key: Key, least: Class, class: Class, since: Instant) {
        self.ready(key, least, class.min(least), since);
    }

    fn ready(&mut self, key: Key, least: Class, class: Class, since: Instant) {
        let place = (since, self.number());
        self.lanes.insert(class, place, key.clone());
        let stage = Stage::Ready(class, place);
        self.objects.insert(key, Object { stage, class: least });
    }

    fn wait(&mut self, key: Key, least: Class, until: Instant) {
        let place = (until, self.number());
        self.timers.insert(place, key.clone());
        let stage = Stage::Waits(place);
        self.objects.insert(key, Object { stage, class: least });
    }

    fn number(&mut self) -> u64 {
        self.last_number += 1;
        self.last_number
    }
}

/// Permits to create a Job now: so many in all, and so many in each namespace.
#[derive(Debug, Default)]
struct Permits {
    taken: usize,
    by_namespace: HashMap<Arc<str>, usize>,
}

impl Permits {
    fn is_free(&self, limits: Limits, namespace: &str) -> bool {
        let here = self.by_namespace.get(namespace).copied().unwrap_or(0);
        self.taken < limits.creates && here < limits.creates_per_namespace
    }

    fn take(&mut self, namespace: &Arc<str>) {
        self.taken += 1;
        *self.by_namespace.entry(Arc::clone(namespace)).or_default() += 1;
    }

    fn give_back(&mut self, namespace: &Arc<str>) {
        self.taken -= 1;
        if let Some(here) = self.by_namespace.get_mut(namespace) {
            *here -= 1;
            if *here == 0 {
                self.by_namespace.remove(namespace);
            }
        }
    }
}

#[cfg(test)]
mod tests;
