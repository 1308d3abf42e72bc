//! The parts that a process still lacks for its work, by name.
//!
//! Set by the parts, read by the health server. Standbys are ready: leading is no check. A process that has not registered all of its
//! checks is not ready. So a probe in its first moments does not read the empty list as "nothing is missing".

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use leaderboard_base::lock::lock;

/// Name of the check that stands for those which are not registered yet.
const START: &str = "process";

/// Named checks. Clones are the same registry.
#[derive(Clone, Debug)]
pub struct Readiness(Arc<Mutex<BTreeMap<String, Result<(), String>>>>);

impl Default for Readiness {
    fn default() -> Self {
        let starting = (
            START.to_owned(),
            Err("starting; not all checks are registered".to_owned()),
        );
        Self(Arc::new(Mutex::new(BTreeMap::from([starting]))))
    }
}

impl Readiness {
    /// Sets a named check: fine, or a sentence about what is missing. A check that was never set is
    /// not asked for, so each part sets its own to an error before it begins.
    pub fn set(&self, name: &str, state: Result<(), String>) {
        let mut checks = lock(&self.0);
        let before = checks.insert(name.to_owned(), state.clone());
        drop(checks);
        match (before, state) {
            (Some(Err(_)), Ok(())) => tracing::info!(check = name, "ready"),
            (Some(Ok(())), Err(missing)) => tracing::warn!(check = name, missing, "no longer ready"),
            _ => {}
        }
    }

    /// Every part of the process has set its checks once: from now on they alone count.
    pub fn registered(&self) {
        lock(&self.0).remove(START);
    }

    /// The missing parts in the order of names, one `name: sentence` each. Empty: ready.
    pub fn missing(&self) -> Vec<String> {
        let checks = lock(&self.0);
        let failed = checks
            .iter()
            .filter_map(|(name, state)| Some((name, state.as_ref().err()?)));
        failed.map(|(name, missing)| format!("{name}: {missing}")).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_without_its_checks_is_starting() {
        let readiness = Readiness::default();
        assert_eq!(
            readiness.missing(),
            ["process: starting; not all checks are registered"]
        );
        readiness.set("permissions", Ok(()));
        assert_eq!(
            readiness.missing(),
            ["process: starting; not all checks are registered"],
            "others may follow"
        );
        readiness.registered();
        assert!(readiness.missing().is_empty());
    }

    #[test]
    fn it_names_what_is_missing_and_only_that() {
        let readiness = Readiness::default();
        readiness.registered();
        assert!(readiness.missing().is_empty());
        readiness.set("submissions synced", Err("the list has not come yet".into()));
        readiness.set("permissions", Ok(()));
        let clone = readiness.clone();
        clone.set("custom resources", Err("submissions are not served".into()));
        let both = [
            "custom resources: submissions are not served",
            "submissions synced: the list has not come yet",
        ];
        assert_eq!(readiness.missing(), both);
        readiness.set("submissions synced", Ok(()));
        readiness.set("custom resources", Ok(()));
        assert!(readiness.missing().is_empty());
    }
}
