//! The containers of a Pod, as plain data. A kind of evaluation describes them, and `pod-spec` makes Kubernetes' objects of them.

use leaderboard_api::{Attempt, DataSource, Deadlines, LeaderboardSpec, RunPlan, Track};
use leaderboard_protocol::graphics::Needs;

/// An agent's own folder, in its container.
pub(crate) const AGENT: &str = "/tmp/agent";
/// A host's program prints little; one that floods must not fill the disk. In bytes.
pub(crate) const HOST_LOG_LIMIT: u64 = 64 << 20;

/// Names that a kind of evaluation uses itself, so that no host gives them another meaning.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Reserved {
    /// Variables of the workers' containers.
    pub env: Vec<&'static str>,
    /// Volumes that `contents` fills.
    pub volumes: &'static [ContentsVolume],
    /// Folders that the workers' containers have for themselves.
    pub folders: Vec<&'static str>,
}

/// Data of the host's, in a volume that nobody but the operator mounts.
#[derive(Clone, Copy, Debug)]
pub struct Data<'a> {
    pub volume: ContentsVolume,
    /// Variable with the folder in which the workers read it.
    pub variable: &'static str,
    pub source: &'a DataSource,
}

/// The input of a workload: the spec, the plan, and the settings of the run.
#[derive(Clone, Copy, Debug)]
pub struct Asked<'a> {
    pub spec: &'a LeaderboardSpec,
    /// `None` if an edit of the Leaderboard has taken it away since.
    pub track: Option<&'a Track>,
    pub plan: &'a RunPlan,
    pub attempt: Attempt,
    pub deadlines: Deadlines,
    /// The run goes on with what is stored.
    pub resume: bool,
    /// The operator gives GPUs to the containers.
    pub has_gpus: bool,
}

/// The container that fills the volumes with what the host keeps private.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Contents {
    pub image: String,
    /// As Kubernetes gets it.
    pub command: Vec<String>,
}

/// The containers of one worker.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Workload {
    /// Runs the host's image.
    pub host: Role,
    /// Runs the participant's image.
    pub agent: Option<Role>,
}

/// One container behind the runner.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Role {
    pub image: String,
    /// Flags of the runner.
    pub flags: Vec<String>,
    /// The command that the runner starts, as Kubernetes gets it.
    pub command: Vec<String>,
    /// Variables with their values, which nothing expands.
    pub env: Vec<(&'static str, String)>,
    pub mounts: Vec<Mount>,
    /// Bytes of its own `/dev/shm`, in memory; `None`: it has that of the Pod.
    pub shm: Option<u64>,
    /// Variables of the image that the container does not get.
    pub removes: &'static [&'static str],
    /// The runner checks for a driver of this kind where the container has a GPU.
    pub draws: Option<Needs>,
}

/// A mount besides those that each container behind the runner has.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Mount {
    /// A folder of the `logs` volume that the container writes.
    Own { folder: String, path: &'static str },
    /// A folder of the `logs` volume, read-only.
    Read { folder: &'static str, path: &'static str },
    /// A volume with the private contents, or with data of the host's, read-only.
    Contents(ContentsVolume),
    /// A folder of the node, read-only, which the node must have.
    OfNode { volume: &'static str, path: &'static str },
}

/// A volume that an init container fills.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ContentsVolume {
    pub name: &'static str,
    /// Where the init container writes it.
    pub written: &'static str,
    /// Where the workers read it.
    pub read: &'static str,
}

/// The host's own command with its arguments, if there is one.
pub(crate) fn of_host(command: Option<&[String]>, arguments: Option<&[String]>) -> Option<Vec<String>> {
    let words = command?.iter().chain(arguments.unwrap_or_default());
    Some(words.cloned().collect())
}

/// A flag of the runner, which counts seconds in 32 bits.
pub(crate) fn seconds(what: &str, value: i64) -> String {
    let value = value.clamp(0, u32::MAX.into());
    format!("--{what}-seconds={value}")
}

/// Writes a word so that Kubernetes hands it on unchanged.
pub fn literal(word: &str) -> String {
    let mut out = String::with_capacity(word.len());
    let mut characters = word.chars().peekable();
    while let Some(character) = characters.next() {
        out.push(character);
        // Kubernetes reads `$$` as `$` and `$(` as the start of a name; any other `$` is a `$`.
        if character == '$' && matches!(characters.peek(), Some('$' | '(')) {
            out.push('$');
        }
    }
    out
}
