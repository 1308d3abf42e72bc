//! Decision of a candidate about a Lease: a pure function of what it saw, when it saw it, and who it is.
//!
//! Called by the election before every write. Knows no client; times are those of the candidate's own boot clock. An expiry counts from
//! the time when the candidate itself saw the record change, so clocks never have to agree.

use std::time::Duration;

use super::Timing;
use super::record::{FIRST_TERM, Identity, Record};

/// Lease as a candidate has seen it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ObservedLease {
    /// None: there is no Lease.
    pub record: Option<Record>,
    /// Highest term ever seen; outlives the deletion of the Lease.
    pub last_term: Option<i32>,
    /// The last term that was handed over; outlives our own writes whose answer was lost.
    pub released: Option<i32>,
    /// When the record was first seen as it is.
    pub changed_at: Duration,
}

impl ObservedLease {
    /// Notes what a look has shown.
    pub fn note(&mut self, record: Option<Record>, now: Duration) {
        if let Some(record) = &record {
            self.last_term = self.last_term.max(Some(record.term));
            self.released = self.released.max(record.is_free.then_some(record.term));
        }
        if self.record != record {
            self.record = record;
            self.changed_at = now;
        }
    }

    /// True if nothing that was sent to EvalAI before this term can still be under way.
    pub fn is_quiet_before(&self, term: i32) -> bool {
        term == FIRST_TERM || self.released == Some(term - 1)
    }

    fn next_term(&self) -> i32 {
        self.last_term.map_or(FIRST_TERM, |term| term.saturating_add(1))
    }
}

/// A process that leads.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Leading {
    pub term: i32,
    /// When the last renewal that succeeded was sent.
    pub renewed_at: Duration,
}

/// Next step of a candidate.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Decision {
    /// Write the Lease as the holder, in this term.
    Acquire { term: i32 },
    /// Write the Lease again, in the same term.
    Renew { term: i32 },
    /// Look again, and take it at this time if nothing has changed by then.
    Wait { until: Duration },
    /// Lead no more.
    Lost(Loss),
}

/// Why a leader leads no more.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Loss {
    #[error("the Lease could not be renewed for {} s", .0.as_secs())]
    Overdue(Duration),
    #[error("{0} holds the Lease")]
    TakenBy(String),
    #[error("somebody has cleared the holder of the Lease")]
    Cleared,
}

/// True if a leader has not renewed for too long, whatever the Lease shows.
pub fn is_overdue(leading: &Leading, timing: &Timing, now: Duration) -> Option<Loss> {
    let silent = now.saturating_sub(leading.renewed_at);
    (silent >= timing.renew_deadline).then_some(Loss::Overdue(silent))
}

/// See the module's text. `leading`: set from the first write that succeeded on.
pub fn decide(
    seen: &ObservedLease,
    me: &Identity,
    leading: Option<&Leading>,
    timing: &Timing,
    now: Duration,
) -> Decision {
    match leading {
        Some(leading) => lead(seen, me, leading, timing, now),
        None => stand(seen, me, timing, now),
    }
}

fn lead(seen: &ObservedLease, me: &Identity, leading: &Leading, timing: &Timing, now: Duration) -> Decision {
    if let Some(loss) = is_overdue(leading, timing, now) {
        return Decision::Lost(loss);
    }
    let renew = Decision::Renew { term: leading.term };
    let Some(record) = &seen.record else {
        // Deleted by a person: written again before a standby, which waits a whole term of the Lease, takes it.
        return renew;
    };
    match record.holder.as_deref() {
        Some(holder) if holder == me.as_str() && record.term == leading.term => renew,
        Some(holder) => Decision::Lost(Loss::TakenBy(holder.to_owned())),
        None => Decision::Lost(Loss::Cleared),
    }
}

fn stand(seen: &ObservedLease, me: &Identity, timing: &Timing, now: Duration) -> Decision {
    let acquire = Decision::Acquire { term: seen.next_term() };
    let patience = match &seen.record {
        None if seen.last_term.is_none() => return acquire,
        None => timing.lease,
        Some(record) => match record.holder.as_deref() {
            None if record.is_free => return acquire,
            // Our own write, whose answer was lost.
            Some(holder) if holder == me.as_str() => return Decision::Acquire { term: record.term },
            Some(holder) if me.succeeds(holder) => return acquire,
            _ => record.duration.max(timing.lease),
        },
    };
    let until = seen.changed_at.saturating_add(patience);
    if now >= until {
        acquire
    } else {
        Decision::Wait { until }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const TIMING: Timing = Timing {
        lease: Duration::from_secs(15),
        renew_deadline: Duration::from_secs(10),
        retry: Duration::from_secs(2),
        call: Duration::from_secs(5),
        evalai_quiet: Duration::from_secs(75),
    };

    fn secs(seconds: u64) -> Duration {
        Duration::from_secs(seconds)
    }

    fn record(holder: Option<&str>, term: i32) -> Record {
        Record {
            holder: holder.map(str::to_owned),
            term,
            duration: secs(15),
            renewed: None,
            is_free: false,
        }
    }

    fn seen(record: Option<Record>, last_term: Option<i32>) -> ObservedLease {
        ObservedLease {
            record,
            last_term,
            released: None,
            changed_at: secs(100),
        }
    }

    #[test]
    fn a_standby_by_what_it_sees() {
        let me = Identity::of_pod("pod", "uid");
        let before = Identity::of_pod("pod", "uid");
        let (acquire, wait) = (|term| Decision::Acquire { term }, Decision::Wait { until: secs(115) });
        let foreign = || Some(record(Some("other"), 3));
        let free = |term| {
            Some(Record {
                is_free: true,
                ..record(None, term)
            })
        };
        for (what, record, last_term, now, expected) in [
            ("no Lease was ever seen", None, None, 100, acquire(1)),
            ("a Lease has vanished", None, Some(3), 101, wait.clone()),
            ("a Lease has vanished long ago", None, Some(3), 115, acquire(4)),
            ("a Lease made by hand", free(0), Some(0), 100, acquire(1)),
            ("released", free(3), Some(3), 100, acquire(4)),
            ("cleared by hand", Some(record(None, 3)), Some(3), 101, wait.clone()),
            ("held and fresh", foreign(), Some(3), 114, wait),
            ("held and expired", foreign(), Some(3), 115, acquire(4)),
            (
                "our write, its answer lost",
                Some(record(Some(me.as_str()), 3)),
                Some(3),
                100,
                acquire(3),
            ),
            (
                "held by the process before us",
                Some(record(Some(before.as_str()), 3)),
                Some(3),
                100,
                acquire(4),
            ),
        ] {
            assert_eq!(
                decide(&seen(record, last_term), &me, None, &TIMING, secs(now)),
                expected,
                "{what}"
            );
        }
    }

    #[test]
    fn a_holder_with_more_patience_is_given_it() {
        let me = Identity::of_pod("pod", "uid");
        let longer = Record {
            duration: secs(60),
            ..record(Some("other"), 3)
        };
        let decision = decide(&seen(Some(longer), Some(3)), &me, None, &TIMING, secs(120));
        assert_eq!(decision, Decision::Wait { until: secs(160) });
    }

    #[test]
    fn a_leader_by_what_it_sees() {
        let me = Identity::of_pod("pod", "uid");
        let leading = Leading {
            term: 3,
            renewed_at: secs(100),
        };
        let mine = |term| Some(record(Some(me.as_str()), term));
        let renew = Decision::Renew { term: 3 };
        let taken = |holder: &str| Decision::Lost(Loss::TakenBy(holder.to_owned()));
        for (what, record, now, expected) in [
            ("ours", mine(3), 109, renew.clone()),
            ("ours, too late", mine(3), 110, Decision::Lost(Loss::Overdue(secs(10)))),
            ("deleted by hand", None, 102, renew),
            ("taken", Some(record(Some("other"), 4)), 102, taken("other")),
            ("ours in another term", mine(4), 102, taken(me.as_str())),
            (
                "cleared by hand",
                Some(record(None, 3)),
                102,
                Decision::Lost(Loss::Cleared),
            ),
        ] {
            assert_eq!(
                decide(&seen(record, Some(3)), &me, Some(&leading), &TIMING, secs(now)),
                expected,
                "{what}"
            );
        }
    }

    #[test]
    fn only_a_change_of_the_record_counts_as_one() {
        let mut seen = ObservedLease::default();
        seen.note(Some(record(Some("other"), 3)), secs(5));
        seen.note(Some(record(Some("other"), 3)), secs(9));
        assert_eq!((seen.changed_at, seen.last_term), (secs(5), Some(3)));
        seen.note(None, secs(12));
        assert_eq!((seen.changed_at, seen.last_term), (secs(12), Some(3)));
    }

    #[test]
    fn only_the_term_after_a_released_one_is_quiet_at_once() {
        let mut seen = ObservedLease::default();
        assert!(seen.is_quiet_before(1) && !seen.is_quiet_before(2));
        let free = Record {
            is_free: true,
            ..record(None, 3)
        };
        seen.note(Some(free), secs(5));
        assert!(seen.is_quiet_before(4));
        // Our own write, or another one's.
        seen.note(Some(record(Some("other"), 4)), secs(6));
        assert!(seen.is_quiet_before(4) && !seen.is_quiet_before(5));
        seen.note(Some(record(None, 4)), secs(7));
        assert!(!seen.is_quiet_before(5), "a person has cleared it");
    }

    fn any_record() -> impl Strategy<Value = Option<Record>> {
        let holder = prop_oneof![Just(None), Just(Some("other".to_owned())), Just(Some("me".to_owned()))];
        let one = (holder, 0..5i32, 0..40u64, any::<bool>());
        proptest::option::of(one.prop_map(|(holder, term, duration, was_released)| Record {
            is_free: holder.is_none() && was_released,
            holder,
            term,
            duration: secs(duration),
            renewed: None,
        }))
    }

    proptest! {
        /// In any history a candidate takes a held Lease only after its holder was silent long enough. It never leads past the deadline,
        /// and a new term is higher than any that was seen.
        #[test]
        fn it_never_takes_too_early_nor_leads_too_long(
            record in any_record(), changed in 0..100u64, later in 0..60u64, renewed in proptest::option::of(0..60u64),
        ) {
            let me = Identity::random("host");
            let record = record.map(|r| Record {
                holder: r.holder.map(|h| if h == "me" { me.as_str().to_owned() } else { h }),
                ..r
            });
            let mut seen = ObservedLease::default();
            seen.note(record.clone(), secs(changed));
            let now = secs(changed + later);
            let leading = renewed.map(|ago| Leading { term: 2, renewed_at: now.saturating_sub(secs(ago)) });
            let foreign = record.as_ref().filter(|r| r.holder.as_deref() == Some("other"));
            let is_free = record.as_ref().is_none_or(|record| record.is_free);
            match decide(&seen, &me, leading.as_ref(), &TIMING, now) {
                Decision::Acquire { term } => {
                    prop_assert!(leading.is_none());
                    prop_assert!(foreign.is_none_or(|r| secs(later) >= r.duration.max(TIMING.lease)));
                    let is_mine = record.as_ref().is_some_and(|r| r.holder.as_deref() == Some(me.as_str()));
                    prop_assert!(record.as_ref().is_none_or(|r| term > r.term || (is_mine && term == r.term)));
                }
                Decision::Renew { term } => {
                    let leading = leading.expect("only a leader renews");
                    prop_assert!(term == leading.term && foreign.is_none());
                    prop_assert!(now.saturating_sub(leading.renewed_at) < TIMING.renew_deadline);
                }
                Decision::Wait { until } => {
                    prop_assert!(leading.is_none() && !is_free);
                    prop_assert!(until > now && until >= secs(changed) + TIMING.lease);
                }
                Decision::Lost(_) => prop_assert!(leading.is_some()),
            }
        }
    }
}
