//! Random lives of a queue, held against a list that is searched anew for each question.

use std::collections::BTreeMap;
use std::time::Duration;

use fastrand::Rng;
use tokio::time::Instant;

use super::state::{After, Limits, State};
use super::{Class, Key};

const LIVES: u64 = 300;
const STEPS: usize = 400;
const LIMITS: Limits = Limits {
    reconciles: 6,
    creates: 3,
    creates_per_namespace: 2,
};

/// An object in the model.
#[derive(Clone, Debug, Default)]
struct Known {
    /// An event that no reconcile has begun for.
    event: Option<Class>,
    /// When it has to be reconciled at the latest without one.
    time: Option<Instant>,
    /// The class that its present reconcile began with.
    runs: Option<Class>,
    /// It was deleted since that began.
    is_gone: bool,
    least: Option<Class>,
}

struct Life {
    random: Rng,
    state: State,
    model: BTreeMap<(String, String), Known>,
    now: Instant,
}

fn key((namespace, name): &(String, String)) -> Key {
    Key {
        namespace: namespace.as_str().into(),
        name: name.as_str().into(),
    }
}

impl Life {
    fn new(seed: u64) -> Self {
        Self {
            random: Rng::with_seed(seed),
            state: State::new(LIMITS),
            model: BTreeMap::new(),
            now: Instant::now(),
        }
    }

    fn any(&mut self) -> (String, String) {
        (self.random.u8(0..3).to_string(), self.random.u8(0..5).to_string())
    }

    fn running(&mut self) -> Option<(String, String)> {
        let running: Vec<_> = self
            .model
            .iter()
            .filter(|(_, k)| k.runs.is_some())
            .map(|(id, _)| id.clone())
            .collect();
        self.random.choice(running)
    }

    fn class(&mut self) -> Class {
        Class::ALL[self.random.usize(0..3)]
    }

    fn step(&mut self) {
        match self.random.u8(0..10) {
            0..4 => self.add(),
            4 => self.forget(),
            5 => self.now += Duration::from_millis(self.random.u64(0..4000)),
            6 | 7 => self.begin(),
            _ => self.finish(),
        }
    }

    fn add(&mut self) {
        let (id, class) = (self.any(), self.class());
        self.state.add(key(&id), class, self.now);
        let known = self.model.entry(id).or_default();
        let class = known.least.map_or(class, |least| least.min(class));
        known.event = Some(known.event.map_or(class, |old| old.min(class)));
    }

    fn forget(&mut self) {
        let id = self.any();
        self.state.forget(&key(&id));
        match self.model.get_mut(&id) {
            Some(known) if known.runs.is_some() => (known.event, known.is_gone) = (None, true),
            _ => {
                self.model.remove(&id);
            }
        }
    }

    /// Objects that may begin now.
    fn candidates(&self) -> Vec<((String, String), Class)> {
        let running = self.model.values().filter(|known| known.runs.is_some());
        let others = running
            .clone()
            .filter(|known| known.runs != Some(Class::Urgent))
            .count();
        let is_full = running.count() >= LIMITS.reconciles;
        let ready = self.model.iter().filter(|(_, known)| known.runs.is_none());
        let ready = ready.filter_map(|(id, known)| {
            let due = known.time.filter(|time| *time <= self.now).and(known.least);
            let class = known.event.into_iter().chain(due).min()?;
            Some((id.clone(), class))
        });
        let free = |class| !is_full && (class == Class::Urgent || others < 5);
        let may_create = |namespace: &str| {
            let creating = self.model.iter().filter(|(_, known)| known.runs == Some(Class::New));
            let here = creating.clone().filter(|((of, _), _)| of == namespace).count();
            creating.count() < LIMITS.creates && here < LIMITS.creates_per_namespace
        };
        let ready = ready.filter(|((namespace, _), class)| *class != Class::New || may_create(namespace));
        ready.filter(|(_, class)| free(*class)).collect()
    }

    fn begin(&mut self) {
        let candidates = self.candidates();
        let begun = self.state.begin(self.now);
        let Some(begun) = begun else {
            return assert!(candidates.is_empty(), "nothing begins of {candidates:?}");
        };
        let id = (begun.key.namespace.to_string(), begun.key.name.to_string());
        let found = candidates.iter().find(|(candidate, _)| *candidate == id);
        assert_eq!(
            found.map(|(_, class)| *class),
            Some(begun.class),
            "{id:?} of {candidates:?}"
        );
        let known = self.model.get_mut(&id).unwrap();
        (known.event, known.time, known.runs) = (None, None, Some(begun.class));
    }

    fn finish(&mut self) {
        let Some(id) = self.running() else { return };
        let known = self.model[&id].clone();
        let creates = self.random.bool();
        let may_continue = self.state.may_continue(&key(&id), creates);
        let after = if may_continue {
            let wait = Duration::from_millis(self.random.u64(0..3) * 2000);
            After::In(wait, self.class())
        } else {
            assert!(
                creates && known.runs != Some(Class::New),
                "only one without a permit is refused"
            );
            After::WithPermit
        };
        self.state.finish(&key(&id), after, self.now);
        self.take_end(&id, after);
    }

    fn take_end(&mut self, id: &(String, String), after: After) {
        let now = self.now;
        let known = self.model.get_mut(id).unwrap();
        if known.event.is_none() && (known.is_gone || after == After::Gone) {
            self.model.remove(id);
            return;
        }
        (known.runs, known.is_gone) = (None, false);
        match after {
            After::In(wait, least) => {
                known.least = Some(least);
                known.event = known.event.map(|class| class.min(least));
                known.time = known.event.is_none().then_some(now + wait);
            }
            After::WithPermit => {
                let again = known
                    .event
                    .map(|class| class.min(known.least.unwrap_or(Class::Refresh)));
                known.event = Some(again.map_or(Class::New, |again| again.min(Class::New)));
            }
            After::Gone => {}
        }
    }

    /// Without further events everything is reconciled that has to be, each object once.
    fn end(&mut self) {
        while let Some(id) = self.running() {
            self.state.finish(&key(&id), After::Gone, self.now);
            self.take_end(&id, After::Gone);
        }
        self.now += Duration::from_mins(1);
        let mut left: Vec<Key> = self.model.keys().map(key).collect();
        while let Some(begun) = self.state.begin(self.now) {
            self.state.finish(&begun.key, After::Gone, self.now);
            let place = left.iter().position(|key| *key == begun.key);
            left.swap_remove(place.unwrap_or_else(|| panic!("{begun:?} was not expected")));
        }
        assert!(left.is_empty(), "lost: {left:?}");
        assert_eq!((self.state.depth(), self.state.next_time()), ([0; 3], None));
    }
}

#[test]
fn no_event_is_lost_and_nobody_runs_twice_at_once_in_any_order() {
    for seed in 0..LIVES {
        let mut life = Life::new(seed);
        for _ in 0..STEPS {
            life.step();
        }
        life.end();
    }
}
