//! The Pod's volumes, and who mounts which of them where. Pure; called by the builders of the containers.

use k8s_openapi::api::core::v1::{
    DownwardAPIVolumeFile, DownwardAPIVolumeSource, EmptyDirVolumeSource, HostPathVolumeSource, ObjectFieldSelector,
    ProjectedVolumeSource, ServiceAccountTokenProjection, Volume, VolumeMount, VolumeProjection,
};
use k8s_openapi::apimachinery::pkg::api::resource::Quantity;

use super::JobInput;
use crate::layout::{
    CONTENTS_LOG_FOLDER, IDENTITY_VOLUME, LOGS_VOLUME, PODINFO_VOLUME, SHM, SHM_VOLUME, STATUS, TOOLS_VOLUME,
};
use leaderboard_api::{ByteQuantity, names};
use leaderboard_contract::run::{
    IDENTITY, IDENTITY_TOKEN_FILE, LOGS, NAME_FILES, PODINFO, STATUS_FOLDER, STOP_FILE, TOOLS,
};
use leaderboard_evaluation::workload::{Mount, Workload};
use leaderboard_protocol::files::{Member, Pair, Side};

const AUDIENCE: &str = "sts.amazonaws.com";
const TOKEN_SECONDS: i64 = 3600;
/// Room in `logs` beyond what the limits on uploads and logs add up to: filling it up evicts the Pod with 1 s of grace,
/// so those limits must be met first.
const LOGS_MARGIN: u64 = 1 << 30;

/// Every volume of the Pod.
pub(super) fn all(input: &JobInput<'_>, workloads: &[Workload]) -> Vec<Volume> {
    let contents = input
        .kind()
        .reserved()
        .volumes
        .iter()
        .map(|volume| empty(volume.name, None));
    let own = [
        empty(LOGS_VOLUME, Some(Quantity(logs_limit(input).to_string()))),
        empty(TOOLS_VOLUME, Some(Quantity("64Mi".into()))),
        podinfo(),
    ];
    let identity = input.spec().has_role().then(identity);
    let shared = input.spec().agent.shm_size.iter();
    let shared = shared.flat_map(|size| Pair::first(input.workers()).map(|worker| memory(worker, size)));
    let all = contents.chain(own).chain(identity);
    all.chain(of_node(workloads)).chain(shared).collect()
}

/// Folders of the node that a worker's containers mount, which are the same for all workers.
fn of_node(workloads: &[Workload]) -> Vec<Volume> {
    let roles = workloads
        .iter()
        .take(1)
        .flat_map(|workload| [Some(&workload.host), workload.agent.as_ref()]);
    let mounts = roles.flatten().flat_map(|role| &role.mounts);
    let volumes = mounts.filter_map(|mount| match mount {
        Mount::OfNode { volume, path } => Some(Volume {
            name: (*volume).into(),
            host_path: Some(HostPathVolumeSource {
                path: (*path).into(),
                type_: Some("Directory".into()),
            }),
            ..Volume::default()
        }),
        Mount::Own { .. } | Mount::Contents(_) => None,
    });
    volumes.collect()
}

/// The shared memory of one agent, which no other one sees.
fn memory(pair: Pair, size: &ByteQuantity) -> Volume {
    Volume {
        name: format!("{SHM_VOLUME}{pair}"),
        empty_dir: Some(EmptyDirVolumeSource {
            size_limit: Some(Quantity(size.bytes().to_string())),
            medium: Some("Memory".into()),
        }),
        ..Volume::default()
    }
}

/// Most bytes of the `logs` volume.
pub(super) fn logs_limit(input: &JobInput<'_>) -> u64 {
    let workers = u64::try_from(input.workers()).unwrap_or(u64::MAX);
    let agent_logs = workers.saturating_mul(input.spec().agent.log_size_limit.bytes());
    input
        .plan
        .storage
        .s3
        .size_limit
        .bytes()
        .saturating_add(agent_logs)
        .saturating_add(LOGS_MARGIN)
}

fn empty(name: &str, size_limit: Option<Quantity>) -> Volume {
    Volume {
        name: name.into(),
        empty_dir: Some(EmptyDirVolumeSource {
            size_limit,
            medium: None,
        }),
        ..Volume::default()
    }
}

fn podinfo() -> Volume {
    let file = DownwardAPIVolumeFile {
        path: STOP_FILE.into(),
        field_ref: Some(ObjectFieldSelector {
            field_path: format!("metadata.annotations['{}']", names::ANNOTATION_STOP),
            api_version: None,
        }),
        ..DownwardAPIVolumeFile::default()
    };
    Volume {
        name: PODINFO_VOLUME.into(),
        downward_api: Some(DownwardAPIVolumeSource {
            items: Some(vec![file]),
            default_mode: None,
        }),
        ..Volume::default()
    }
}

fn identity() -> Volume {
    let token = ServiceAccountTokenProjection {
        audience: Some(AUDIENCE.into()),
        expiration_seconds: Some(TOKEN_SECONDS),
        path: IDENTITY_TOKEN_FILE.into(),
    };
    let source = VolumeProjection {
        service_account_token: Some(token),
        ..VolumeProjection::default()
    };
    Volume {
        name: IDENTITY_VOLUME.into(),
        projected: Some(ProjectedVolumeSource {
            sources: Some(vec![source]),
            default_mode: None,
        }),
        ..Volume::default()
    }
}

/// Where `contents` writes, and the runner that keeps what it prints.
pub(super) fn of_contents(input: &JobInput<'_>) -> Vec<VolumeMount> {
    let written = input
        .kind()
        .reserved()
        .volumes
        .iter()
        .map(|volume| mount(volume.name, volume.written));
    let own = [
        read_only(mount(TOOLS_VOLUME, TOOLS)),
        mount_part(LOGS_VOLUME, "contents".into(), CONTENTS_LOG_FOLDER),
    ];
    written.chain(own).collect()
}

/// Mounts of `workspace`, which prepares the volumes.
pub(super) fn of_workspace(input: &JobInput<'_>) -> Vec<VolumeMount> {
    let own = [mount(LOGS_VOLUME, LOGS), mount(TOOLS_VOLUME, TOOLS)];
    own.into_iter().chain(token(input)).collect()
}

/// Mounts of `logcopy`: the logs to write, the stop request to read.
pub(super) fn of_logcopy(input: &JobInput<'_>) -> Vec<VolumeMount> {
    let own = [mount(LOGS_VOLUME, LOGS), read_only(mount(PODINFO_VOLUME, PODINFO))];
    own.into_iter().chain(token(input)).collect()
}

/// Mounts of a worker's container: the runner, the status files, its own volumes, and for an agent its shared memory.
pub(super) fn of_member(input: &JobInput<'_>, member: Member, mounts: &[Mount]) -> Vec<VolumeMount> {
    let (of_node, of_pod): (Vec<&Mount>, Vec<&Mount>) =
        mounts.iter().partition(|mount| matches!(mount, Mount::OfNode { .. }));
    let has_shared = member.side == Side::Agent && input.spec().agent.shm_size.is_some();
    let shared = has_shared.then(|| mount(&format!("{SHM_VOLUME}{}", member.pair), SHM));
    runner_and_status(&member.to_string())
        .into_iter()
        .chain(of_pod.into_iter().map(mounted))
        .chain(name_files())
        .chain(of_node.into_iter().map(mounted))
        .chain(shared)
        .collect()
}

fn mounted(wanted: &Mount) -> VolumeMount {
    match wanted {
        Mount::Own { folder, path } => mount_part(LOGS_VOLUME, folder.clone(), path),
        Mount::Contents(volume) => read_only(mount(volume.name, volume.read)),
        Mount::OfNode { volume, path } => read_only(mount(volume, path)),
    }
}

/// The Pod's own ones are one file for all containers, and root could write to them.
fn name_files() -> [VolumeMount; 3] {
    NAME_FILES.map(|path| read_only(mount_part(TOOLS_VOLUME, path.trim_start_matches('/').to_owned(), path)))
}

/// The runner; all status files to read, the container's own to write. The kubelet makes a sub-folder when it comes to
/// its mount, so the outer one stands first.
fn runner_and_status(container: &str) -> [VolumeMount; 3] {
    [
        read_only(mount(TOOLS_VOLUME, TOOLS)),
        read_only(mount_part(LOGS_VOLUME, STATUS_FOLDER.into(), STATUS)),
        mount_part(
            LOGS_VOLUME,
            format!("{STATUS_FOLDER}/{container}"),
            &format!("{STATUS}/{container}"),
        ),
    ]
}

fn token(input: &JobInput<'_>) -> Option<VolumeMount> {
    input
        .spec()
        .has_role()
        .then(|| read_only(mount(IDENTITY_VOLUME, IDENTITY)))
}

fn mount(volume: &str, path: &str) -> VolumeMount {
    VolumeMount {
        name: volume.into(),
        mount_path: path.into(),
        ..VolumeMount::default()
    }
}

fn mount_part(volume: &str, sub_path: String, path: &str) -> VolumeMount {
    VolumeMount {
        sub_path: Some(sub_path),
        ..mount(volume, path)
    }
}

fn read_only(mount: VolumeMount) -> VolumeMount {
    VolumeMount {
        read_only: Some(true),
        ..mount
    }
}
