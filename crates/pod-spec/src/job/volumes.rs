//! The Pod's volumes, and who mounts which of them where. Pure; called by the builders of the containers.

use serde_json::{Value, json};

use super::{JobInput, members};
use crate::layout::{
    CONTENTS_LOG_FOLDER, IDENTITY_VOLUME, LOGS_VOLUME, PODINFO_VOLUME, SHM, SHM_VOLUME, STATUS, TOOLS_VOLUME,
};
use leaderboard_api::{Agents, DataSource, names};
use leaderboard_contract::run::{
    IDENTITY, IDENTITY_TOKEN_FILE, LOGS, NAME_FILES, PODINFO, STATUS_FOLDER, STOP_FILE, TOOLS,
};
use leaderboard_evaluation::workload::{ContentsVolume, Data, Mount, Role, Workload};
use leaderboard_protocol::files::Member;

const AUDIENCE: &str = "sts.amazonaws.com";
const TOKEN_SECONDS: i64 = 3600;
/// Room in `logs` beyond what the limits on uploads and logs add up to: filling it up evicts the Pod with 1 s of grace,
/// so those limits must be met first.
const LOGS_MARGIN: u64 = 1 << 30;
/// Most bytes of the volumes of the private contents, and of each volume that an image fills. They have no limit of their own.
const CONTENTS_BYTES: u64 = 10 << 30;

/// Every volume of the Pod.
pub(super) fn all(input: &JobInput<'_>, workloads: &[Workload]) -> Vec<Value> {
    let (kind, spec) = (input.kind(), input.spec());
    let contents = kind
        .reserved(spec)
        .volumes
        .iter()
        .map(|volume| empty(volume.name, None));
    let data = kind.data(spec).into_iter().map(|data| with_data(&data));
    let own = [
        empty(LOGS_VOLUME, Some(&logs_limit(input).to_string())),
        empty(TOOLS_VOLUME, Some("64Mi")),
        podinfo(),
    ];
    let identity = spec.has_role().then(identity);
    let shared = members::members(input.plan).filter_map(|member| {
        let size = members::role(workloads, member)?.shm?;
        Some(memory(member, size))
    });
    let all = contents.chain(data).chain(own).chain(identity);
    all.chain(of_node(workloads)).chain(shared).collect()
}

/// A volume that an init container fills, or a claim of the host's.
fn with_data(data: &Data<'_>) -> Value {
    let name = data.volume.name;
    match data.source {
        DataSource::Image(_) => empty(name, None),
        DataSource::PersistentVolumeClaim(claim) => {
            json!({"name": name, "persistentVolumeClaim": {"claimName": claim.claim_name, "readOnly": true}})
        }
    }
}

/// Folders of the node that a worker's containers mount, which are the same for all workers.
fn of_node(workloads: &[Workload]) -> Vec<Value> {
    let roles = workloads
        .iter()
        .take(1)
        .flat_map(|workload| [Some(&workload.host), workload.agent.as_ref()]);
    let mounts = roles.flatten().flat_map(|role| &role.mounts);
    let volumes = mounts.filter_map(|mount| match mount {
        Mount::OfNode { volume, path } => {
            Some(json!({"name": volume, "hostPath": {"path": path, "type": "Directory"}}))
        }
        Mount::Own { .. } | Mount::Read { .. } | Mount::Contents(_) => None,
    });
    volumes.collect()
}

/// The shared memory of one container, which no other one sees. `size` is in bytes.
fn memory(member: Member, size: u64) -> Value {
    json!({"name": format!("{SHM_VOLUME}{member}"), "emptyDir": {"sizeLimit": size.to_string(), "medium": "Memory"}})
}

/// Most bytes of the `logs` volume.
fn logs_limit(input: &JobInput<'_>) -> u64 {
    let agents = u64::try_from(input.plan.agent_count()).unwrap_or(u64::MAX);
    let agent_logs = agents.saturating_mul(input.spec().agent.log_size_limit.bytes());
    let bounds = input.plan.container().and_then(|own| own.input.as_ref());
    // What an agent leaves is copied for the evaluators.
    let copies = if input.plan.agents() == Agents::First { 2 } else { 1 };
    let submitted = bounds.map_or(0, |bounds| bounds.max_bytes.bytes().saturating_mul(copies));
    [agent_logs, submitted, LOGS_MARGIN]
        .into_iter()
        .fold(input.plan.storage.s3.size_limit.bytes(), u64::saturating_add)
}

/// Most bytes that the volumes on the node's disk hold together.
pub(super) fn disk_limit(input: &JobInput<'_>) -> u64 {
    let (kind, spec) = (input.kind(), input.spec());
    let contents = u64::from(!kind.reserved(spec).volumes.is_empty());
    let filled = kind.data(spec).into_iter().filter(|data| data.source.image().is_some());
    let filled = filled.fold(contents, |count, _| count.saturating_add(1));
    logs_limit(input).saturating_add(filled.saturating_mul(CONTENTS_BYTES))
}

fn empty(name: &str, size_limit: Option<&str>) -> Value {
    json!({"name": name, "emptyDir": {"sizeLimit": size_limit}})
}

fn podinfo() -> Value {
    let field = format!("metadata.annotations['{}']", names::ANNOTATION_STOP);
    let file = json!({"path": STOP_FILE, "fieldRef": {"fieldPath": field}});
    json!({"name": PODINFO_VOLUME, "downwardAPI": {"items": [file]}})
}

fn identity() -> Value {
    let token = json!({"audience": AUDIENCE, "expirationSeconds": TOKEN_SECONDS, "path": IDENTITY_TOKEN_FILE});
    json!({"name": IDENTITY_VOLUME, "projected": {"sources": [{"serviceAccountToken": token}]}})
}

/// Where `contents` writes, and the runner that keeps what it prints.
pub(super) fn of_contents(input: &JobInput<'_>) -> Vec<Value> {
    let reserved = input.kind().reserved(input.spec());
    let written = reserved.volumes.iter().map(|volume| mount(volume.name, volume.written));
    let own = [
        read_only(mount(TOOLS_VOLUME, TOOLS)),
        mount_part(LOGS_VOLUME, "contents", CONTENTS_LOG_FOLDER),
    ];
    written.chain(own).collect()
}

/// Mounts of a container that copies data out of its image: the volume, and the runner that copies.
pub(super) fn of_data(volume: ContentsVolume) -> Vec<Value> {
    vec![
        read_only(mount(TOOLS_VOLUME, TOOLS)),
        mount(volume.name, volume.written),
    ]
}

/// Mounts of `workspace`, which prepares the volumes.
pub(super) fn of_workspace(input: &JobInput<'_>) -> Vec<Value> {
    let own = [mount(LOGS_VOLUME, LOGS), mount(TOOLS_VOLUME, TOOLS)];
    own.into_iter().chain(token(input)).collect()
}

/// Mounts of `logcopy`: the logs to write, the stop request to read.
pub(super) fn of_logcopy(input: &JobInput<'_>) -> Vec<Value> {
    let own = [mount(LOGS_VOLUME, LOGS), read_only(mount(PODINFO_VOLUME, PODINFO))];
    own.into_iter().chain(token(input)).collect()
}

/// Mounts of `collect`, which needs no identity.
pub(super) fn of_collect() -> Vec<Value> {
    vec![mount(LOGS_VOLUME, LOGS)]
}

/// Mounts of a worker's container: the runner, the status files, its own volumes, and its shared memory.
pub(super) fn of_member(member: Member, role: &Role) -> Vec<Value> {
    let is_of_node = |mount: &&Mount| matches!(mount, Mount::OfNode { .. });
    let (of_node, of_pod): (Vec<&Mount>, Vec<&Mount>) = role.mounts.iter().partition(is_of_node);
    let shared = role.shm.map(|_| mount(&format!("{SHM_VOLUME}{member}"), SHM));
    runner_and_status(&member.to_string())
        .into_iter()
        .chain(of_pod.into_iter().map(mounted))
        .chain(name_files())
        .chain(of_node.into_iter().map(mounted))
        .chain(shared)
        .collect()
}

fn mounted(wanted: &Mount) -> Value {
    match wanted {
        Mount::Own { folder, path } => mount_part(LOGS_VOLUME, folder, path),
        Mount::Read { folder, path } => read_only(mount_part(LOGS_VOLUME, folder, path)),
        Mount::Contents(volume) => read_only(mount(volume.name, volume.read)),
        Mount::OfNode { volume, path } => read_only(mount(volume, path)),
    }
}

/// The Pod's own ones are one file for all containers, and root could write to them.
fn name_files() -> [Value; 3] {
    NAME_FILES.map(|path| read_only(mount_part(TOOLS_VOLUME, path.trim_start_matches('/'), path)))
}

/// The runner; all status files to read, the container's own to write. The kubelet makes a sub-folder when it comes to
/// its mount, so the outer one stands first.
fn runner_and_status(container: &str) -> [Value; 3] {
    [
        read_only(mount(TOOLS_VOLUME, TOOLS)),
        read_only(mount_part(LOGS_VOLUME, STATUS_FOLDER, STATUS)),
        mount_part(
            LOGS_VOLUME,
            &format!("{STATUS_FOLDER}/{container}"),
            &format!("{STATUS}/{container}"),
        ),
    ]
}

fn token(input: &JobInput<'_>) -> Option<Value> {
    input
        .spec()
        .has_role()
        .then(|| read_only(mount(IDENTITY_VOLUME, IDENTITY)))
}

fn mount(volume: &str, path: &str) -> Value {
    json!({"name": volume, "mountPath": path})
}

fn mount_part(volume: &str, sub_path: &str, path: &str) -> Value {
    json!({"name": volume, "mountPath": path, "subPath": sub_path})
}

fn read_only(mut mount: Value) -> Value {
    mount["readOnly"] = true.into();
    mount
}
