//! Candidates, and a Lease as the election reads and writes it.
//!
//! Called by the election. Pure but for the random part of an identity.

use std::time::Duration;

use jiff::Timestamp;
use k8s_openapi::api::coordination::v1::{Lease, LeaseSpec};
use k8s_openapi::apimachinery::pkg::apis::meta::v1::{MicroTime, ObjectMeta};

use super::Settings;
use leaderboard_api::names::{LABEL_MANAGED_BY, OPERATOR};

/// Term of the first leader there ever was.
pub const FIRST_TERM: i32 = 1;

/// A process, by a name that no other process has: after a restart it is another one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Identity {
    text: String,
    /// Start of the names of all processes that run, one after another, in this container. Empty: not known.
    container: String,
}

impl Identity {
    /// Identity of the only process of a container that leads; the kubelet starts the next only when this one has ended.
    pub fn of_pod(name: &str, uid: &str) -> Self {
        let container = format!("{name}_{uid}_");
        Self {
            text: format!("{container}{}", random()),
            container,
        }
    }

    /// Identity of a process outside a Pod.
    pub fn random(host: &str) -> Self {
        Self {
            text: format!("{host}_{}", random()),
            container: String::new(),
        }
    }

    /// As it stands in a Lease.
    pub fn as_str(&self) -> &str {
        &self.text
    }

    /// True for a process before this one in the same container, which has therefore ended.
    pub fn succeeds(&self, holder: &str) -> bool {
        !self.container.is_empty() && holder != self.text && holder.starts_with(&self.container)
    }
}

fn random() -> String {
    format!("{:016x}", fastrand::u64(..))
}

/// Content of a Lease.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Record {
    pub holder: Option<String>,
    pub term: i32,
    /// How long its holder may be silent.
    pub duration: Duration,
    /// The holder's own time: only compared with itself, to see that something has changed.
    pub renewed: Option<Timestamp>,
    /// True if the Lease was handed over, or never had a holder, so that no process can think of itself as the holder. A Lease that a
    /// person clears still shows since when its holder has held it, and is not free.
    pub is_free: bool,
}

impl Record {
    /// Reads a Lease. An absent or senseless field counts as that of a Lease without a holder.
    pub fn read(lease: &Lease) -> Self {
        let spec = lease.spec.clone().unwrap_or_default();
        let holder = spec.holder_identity.filter(|holder| !holder.is_empty());
        let term = spec.lease_transitions.unwrap_or(0).max(0);
        Self {
            // A holder without a count was not ours, but it was one.
            term: if holder.is_some() { term.max(FIRST_TERM) } else { term },
            is_free: holder.is_none() && spec.acquire_time.is_none(),
            holder,
            duration: Duration::from_secs(
                spec.lease_duration_seconds
                    .and_then(|s| u64::try_from(s).ok())
                    .unwrap_or(0),
            ),
            renewed: spec.renew_time.map(|time| time.0),
        }
    }
}

/// The Lease that shows that this process leads in `term`, made from the one that was read, if any.
pub(super) fn held(read: Option<&Lease>, settings: &Settings, term: i32, now: Timestamp) -> Lease {
    let mut lease = read.cloned().unwrap_or_else(|| new(settings));
    let before = lease.spec.take().unwrap_or_default();
    let is_same = before.holder_identity.as_deref() == Some(settings.identity.as_str());
    let acquired = before.acquire_time.clone().filter(|_| is_same).or(Some(MicroTime(now)));
    lease.spec = Some(LeaseSpec {
        holder_identity: Some(settings.identity.as_str().to_owned()),
        lease_duration_seconds: Some(
            i32::try_from(settings.timing.lease.as_secs())
                .unwrap_or(i32::MAX)
                .max(1),
        ),
        lease_transitions: Some(term),
        acquire_time: acquired,
        renew_time: Some(MicroTime(now)),
        ..before
    });
    lease
}

/// The Lease without a leader, which shows that the last one has left nothing under way.
pub(super) fn released(mut lease: Lease, now: Timestamp) -> Lease {
    let spec = lease.spec.get_or_insert_default();
    (spec.holder_identity, spec.acquire_time) = (None, None);
    spec.renew_time = Some(MicroTime(now));
    lease
}

fn new(settings: &Settings) -> Lease {
    let metadata = ObjectMeta {
        name: Some(settings.name.clone()),
        namespace: Some(settings.namespace.clone()),
        labels: Some([(LABEL_MANAGED_BY.to_owned(), OPERATOR.to_owned())].into()),
        ..ObjectMeta::default()
    };
    Lease { metadata, spec: None }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn lease(value: serde_json::Value) -> Lease {
        serde_json::from_value(value).unwrap()
    }

    #[test]
    fn what_is_absent_or_senseless_reads_as_never_held() {
        let never = Record {
            holder: None,
            term: 0,
            duration: Duration::ZERO,
            renewed: None,
            is_free: true,
        };
        for value in [
            json!({"metadata": {}}),
            json!({"metadata": {}, "spec": {"holderIdentity": "", "leaseTransitions": -4, "leaseDurationSeconds": -1}}),
        ] {
            assert_eq!(Record::read(&lease(value)), never);
        }
        let foreign = Record::read(&lease(json!({"metadata": {}, "spec": {"holderIdentity": "x"}})));
        assert_eq!((foreign.term, foreign.is_free), (FIRST_TERM, false));
    }

    #[test]
    fn a_held_lease_reads_back_and_keeps_what_others_wrote() {
        let settings = Settings::new("ns", "operator", Identity::of_pod("pod", "uid"));
        let now = Timestamp::from_second(1_800_000_000).unwrap();
        let first = held(None, &settings, 1, now);
        assert_eq!(first.metadata.name.as_deref(), Some("operator"));
        let later = Timestamp::from_second(1_800_000_002).unwrap();
        let mut read = first.clone();
        read.metadata.annotations = Some([("someone".to_owned(), "else".to_owned())].into());
        let second = held(Some(&read), &settings, 1, later);
        let spec = second.spec.clone().unwrap();
        assert_eq!((spec.acquire_time.unwrap().0, spec.renew_time.unwrap().0), (now, later));
        assert_eq!(second.metadata.annotations, read.metadata.annotations);
        let record = Record::read(&second);
        assert_eq!(
            (record.holder.as_deref(), record.term),
            (Some(settings.identity.as_str()), 1)
        );
        assert_eq!(record.duration, settings.timing.lease);
        let other = Settings::new("ns", "operator", Identity::random("host"));
        let taken = held(Some(&second), &other, 2, later).spec.unwrap();
        assert_eq!(taken.acquire_time.unwrap().0, later, "another holder acquires anew");
    }

    #[test]
    fn a_released_lease_is_free_and_one_that_a_person_clears_is_not() {
        let settings = Settings::new("ns", "operator", Identity::random("host"));
        let now = Timestamp::from_second(1_800_000_000).unwrap();
        let lease = held(None, &settings, 4, now);
        let record = Record::read(&released(lease.clone(), now));
        assert_eq!((record.holder, record.term, record.is_free), (None, 4, true));
        let mut cleared = lease;
        cleared.spec.as_mut().unwrap().holder_identity = None;
        assert!(!Record::read(&cleared).is_free, "a person's edit is no handing over");
    }

    #[test]
    fn only_an_earlier_process_of_the_same_container_is_succeeded() {
        let (before, after) = (Identity::of_pod("pod", "uid"), Identity::of_pod("pod", "uid"));
        assert_ne!(before, after);
        assert!(after.succeeds(before.as_str()) && !after.succeeds(after.as_str()));
        assert!(!after.succeeds(Identity::of_pod("pod", "uid2").as_str()));
        let (one, two) = (Identity::random("host"), Identity::random("host"));
        assert!(
            !two.succeeds(one.as_str()),
            "two processes of a machine may live at once"
        );
    }
}
