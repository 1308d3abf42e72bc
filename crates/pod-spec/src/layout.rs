//! The inside of a Pod as the Job and the rules for an overlay agree on it: volumes, paths, variables. Pure.

use crate::job::workload::ContentsVolume;
use leaderboard_contract::run::{IDENTITY, LOGS, NAME_FILES, PODINFO, TOOLS};
use leaderboard_evaluation::carla::layout::{CARLA_ROOT, LEADERBOARD_ROOT, SCENARIO_RUNNER_ROOT};

/// Volumes with the private contents.
pub(super) const CONTENTS_VOLUMES: [ContentsVolume; 3] = [
    ContentsVolume {
        name: "leaderboard",
        written: "/tmp/leaderboard",
        read: LEADERBOARD_ROOT,
    },
    ContentsVolume {
        name: "scenario-runner",
        written: "/tmp/scenario_runner",
        read: SCENARIO_RUNNER_ROOT,
    },
    ContentsVolume {
        name: "carla-python-api",
        written: "/tmp/CARLA",
        read: CARLA_ROOT,
    },
];
/// The other volumes of ours. Nothing but our own mounts of them keeps a stranger from what is in them.
pub(super) const OWN_VOLUMES: [&str; 4] = [LOGS_VOLUME, TOOLS_VOLUME, PODINFO_VOLUME, IDENTITY_VOLUME];

pub const LOGS_VOLUME: &str = "logs";
pub(super) const TOOLS_VOLUME: &str = "tools";
pub(super) const PODINFO_VOLUME: &str = "podinfo";
pub(super) const IDENTITY_VOLUME: &str = "identity";
/// Shared memory of an agent; the number of its pair follows.
pub const SHM_VOLUME: &str = "shm-agent-";
/// Where programs look for it.
pub(super) const SHM: &str = "/dev/shm";

/// The folder of its log, in `contents`.
pub(super) const CONTENTS_LOG_FOLDER: &str = "/tmp/leaderboard-log";
/// Status files, in simulators and agents.
pub(super) const STATUS: &str = "/tmp/status";
/// An agent's own folder of results and log.
pub(super) const AGENT: &str = "/tmp/agent";
/// What a simulator keeps.
pub(super) const SAVED: &str = "/home/carla/CarlaUE4/Saved";

/// Annotation that keeps EKS from putting the ServiceAccount's role into the containers it names.
pub(super) const ANNOTATION_SKIP_CONTAINERS: &str = "eks.amazonaws.com/skip-containers";

/// Variables of simulators and agents that follow from the plan: nobody else may set them.
pub(super) const FIXED_ENV: [&str; 12] = [
    "CARLA_PORT",
    "CARLA_TM_PORT",
    "CHALLENGE_TRACK_CODENAME",
    "ROUTES",
    "ROUTES_SUBSET",
    "SCENARIOS",
    "REPETITIONS",
    "RESUME",
    "CHECKPOINT_ENDPOINT",
    "CARLA_ROOT",
    "SCENARIO_RUNNER_ROOT",
    "LEADERBOARD_ROOT",
];

/// Paths at and below which an overlay may mount nothing.
pub(super) fn protected_mounts() -> impl Iterator<Item = &'static str> {
    let contents = CONTENTS_VOLUMES
        .into_iter()
        .flat_map(|volume| [volume.written, volume.read]);
    contents
        .chain([
            LOGS,
            TOOLS,
            PODINFO,
            IDENTITY,
            STATUS,
            AGENT,
            SAVED,
            CONTENTS_LOG_FOLDER,
        ])
        .chain(NAME_FILES)
}
