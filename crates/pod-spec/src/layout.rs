//! The inside of a Pod as the Job and the rules for an overlay agree on it: volumes and paths. Pure.

use leaderboard_contract::run::{IDENTITY, LOGS, NAME_FILES, PODINFO, TOOLS};
use leaderboard_evaluation::workload::Reserved;
use leaderboard_protocol::files::Member;

const OWN_VOLUMES: [&str; 4] = [LOGS_VOLUME, TOOLS_VOLUME, PODINFO_VOLUME, IDENTITY_VOLUME];

pub const LOGS_VOLUME: &str = "logs";
pub(super) const TOOLS_VOLUME: &str = "tools";
pub(super) const PODINFO_VOLUME: &str = "podinfo";
pub(super) const IDENTITY_VOLUME: &str = "identity";
/// Shared memory of one container of a worker, whose name follows.
pub const SHM_VOLUME: &str = "shm-";
/// Where programs look for it.
pub(super) const SHM: &str = "/dev/shm";

/// The folder of its log, in `contents`.
pub(super) const CONTENTS_LOG_FOLDER: &str = "/tmp/leaderboard-log";
/// Status files, in the workers' containers.
pub(super) const STATUS: &str = "/tmp/status";

/// Annotation that keeps EKS from putting the ServiceAccount's role into the containers it names.
pub(super) const ANNOTATION_SKIP_CONTAINERS: &str = "eks.amazonaws.com/skip-containers";

/// True for a volume of ours in every Pod. Nothing but our own mounts of it keeps a stranger from what is in it.
pub(super) fn is_own_volume(name: &str) -> bool {
    let member = name.strip_prefix(SHM_VOLUME).and_then(Member::parse);
    OWN_VOLUMES.contains(&name) || member.is_some()
}

/// Paths at and below which an overlay may mount nothing.
pub(super) fn protected_mounts(reserved: &Reserved) -> impl Iterator<Item = &'static str> {
    let contents = reserved.volumes.iter().flat_map(|volume| [volume.written, volume.read]);
    contents
        .chain([LOGS, TOOLS, PODINFO, IDENTITY, STATUS, CONTENTS_LOG_FOLDER])
        .chain(reserved.folders.iter().copied())
        .chain(NAME_FILES)
}
