//! As whom `workspace` and `logcopy` run: a user of this Job alone. Pure.
//!
//! The kernel counts what a user holds (watches, inotify instances, signals that wait) over all containers of a node. An image that is made
//! for the user of our containers could use that up, so no image can know this one before its Job is made.
//!
//! Which user it is matters to nothing else: with every capability dropped root could read no more than any other one, and all that they
//! write to is a volume (0777) or a folder that the kubelet or they themselves made there. Files they restore are 0666 in folders of 0777, so
//! that the agents' users, whatever they are, can go on with them. All Pods of a Job have the same one.

use std::ops::Range;

use serde_json::Value;
use sha2::{Digest, Sha256};

use super::JobInput;

/// Above what people, programs, directories of users and OpenShift's namespaces have, and below 2^31, where Kubernetes ends.
const USERS: Range<u64> = 2_001_000_000..2_147_000_000;
/// A user namespace ends at 2^16, and its users are counted apart from those of all others.
const USERS_OF_NAMESPACE: Range<u64> = 33_000..65_000;

/// The user and group of our own containers.
pub(super) fn of(input: &JobInput<'_>) -> i64 {
    let uid = input.submission.metadata.uid.as_deref().unwrap_or_default();
    let digest = Sha256::digest(format!("{uid}/{}", input.number.suffix()));
    let drawn = digest.iter().take(6).fold(0, |sum, byte| sum << 8 | u64::from(*byte));
    let users = if has_user_namespace(input) {
        USERS_OF_NAMESPACE
    } else {
        USERS
    };
    let user = users.start + drawn % (users.end - users.start);
    i64::try_from(user).unwrap_or(i64::MAX)
}

fn has_user_namespace(input: &JobInput<'_>) -> bool {
    let pod = input.spec().pod_overrides.as_ref();
    pod.and_then(|pod| pod.pointer("/spec/hostUsers")) == Some(&Value::Bool(false))
}
