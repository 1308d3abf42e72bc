//! How an object goes from one token's queue to another's, as when its Leaderboard has a new token: nothing of it begins anew.
//!
//! Owned by `queue`. Pure.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use super::poll::Challenge;
use super::sub::Sub;
use super::{Busy, Now, Queue};
use crate::types::Key;

/// All that leaves a queue with an object.
#[derive(Debug)]
pub struct Leaving {
    subs: Vec<Moved>,
    challenges: BTreeMap<i64, Challenge>,
}

#[derive(Debug)]
struct Moved {
    key: Key,
    sub: Sub,
    /// A write of it has no answer: nothing is written before.
    hold_until: Option<Duration>,
}

impl Leaving {
    /// The submissions that leave.
    pub fn submissions(&self) -> impl Iterator<Item = &Key> {
        self.subs.iter().map(|moved| &moved.key)
    }
}

impl Queue {
    /// Takes a submission out, or a Leaderboard with all submissions of it. EvalAI must have given up by `settled` what is written at this
    /// moment.
    pub fn part_with(&mut self, key: &Key, settled: Duration, now: Now) -> Leaving {
        let leaves = |(own, sub): &(&Key, &Sub)| *own == key || sub.target.leaderboard == *key;
        let keys: Vec<Key> = self.subs.iter().filter(leaves).map(|(own, _)| own.clone()).collect();
        let of_subs = keys
            .iter()
            .filter_map(|key| self.subs.get(key))
            .map(|sub| sub.target.challenge);
        let served = self.served.get(key).map(|target| target.challenge);
        let ids: BTreeSet<i64> = of_subs.chain(served).collect();
        let known = ids
            .into_iter()
            .filter_map(|id| Some((id, self.challenges.get(&id)?.known())));
        let challenges = known.collect();
        let subs = keys.into_iter().filter_map(|key| self.take_out(key, settled, now));
        let subs = subs.collect();
        self.retire(key, now);
        Leaving { subs, challenges }
    }

    fn take_out(&mut self, key: Key, settled: Duration, now: Now) -> Option<Moved> {
        let lane = self.subs.get(&key).and_then(|sub| self.lanes.get(&sub.pk));
        let hold_until = lane.and_then(|lane| match lane.busy {
            Some(Busy::Write) => Some(settled),
            _ => lane.unsure.then_some(lane.hold_until),
        });
        let mut sub = self.remove(&key, now)?;
        if hold_until.is_some() {
            (sub.outdated, sub.wrote_at) = (true, now.at);
        }
        Some(Moved { key, sub, hold_until })
    }

    /// Takes in what has left another queue.
    pub fn take_over(&mut self, leaving: Leaving) {
        for (id, challenge) in leaving.challenges {
            self.challenges.entry(id).or_insert(challenge);
        }
        for Moved { key, sub, hold_until } in leaving.subs {
            if let Some(until) = hold_until {
                let lane = self.lanes.entry(sub.pk).or_default();
                (lane.hold_until, lane.unsure) = (lane.hold_until.max(until), true);
            }
            self.pks.entry(sub.pk).or_default().insert(key.clone());
            self.subs.insert(key, sub);
        }
    }
}
