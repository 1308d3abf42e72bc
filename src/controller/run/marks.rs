//! What a touch of an object changes: for itself, or for the others in line. Pure; called by the feed of the watches.

use std::collections::HashMap;

use kube::ResourceExt;

use super::key;
use crate::services::ObjectKey;
use leaderboard_api::Submission;

/// What of a Submission's status matters to the others in line and to its Leaderboard's counts.
pub(super) fn standing(submission: &Submission) -> String {
    let status = submission.status.as_ref();
    let state = status.and_then(|s| s.state).map(leaderboard_api::State::as_str);
    format!("{state:?} {}", status.is_some_and(|s| s.job_name.is_some()))
}

/// What was last seen of each object, to tell our own status writes from what others did.
#[derive(Default)]
pub(super) struct Fingerprints(HashMap<String, (String, String)>);

/// What a change concerns.
pub(super) struct Moved {
    pub(super) by_others: bool,
    pub(super) in_line: bool,
}

impl Fingerprints {
    pub(super) fn moved(&mut self, object: &impl ResourceExt, standing: &str) -> Moved {
        let meta = object.meta();
        let mark = format!(
            "{:?} {:?} {:?} {:?}",
            meta.generation, meta.deletion_timestamp, meta.finalizers, meta.annotations
        );
        let old = self
            .0
            .insert(object.uid().unwrap_or_default(), (mark.clone(), standing.to_owned()));
        Moved {
            by_others: old.as_ref().is_none_or(|(known, _)| *known != mark),
            in_line: old.is_none_or(|(_, known)| known != standing),
        }
    }

    pub(super) fn drop(&mut self, object: &impl ResourceExt) -> ObjectKey {
        self.0.remove(&object.uid().unwrap_or_default());
        key(object)
    }
}
