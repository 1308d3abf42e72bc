//! The controller's input for a Pod: one JSON document without secrets, and the paths inside the Pod.
//!
//! Written by `pod-spec`, read by `workspace` and `logcopy`. Pure.

use serde::{Deserialize, Serialize};

use leaderboard_api::{Attempt, Enforcement, LogGroup, Logs, RunPlan, SubmittedFile, Verify};

/// Environment variable with the JSON of [`Run`].
pub const ENV_RUN: &str = "LEADERBOARD_RUN";
/// Version of [`Run`].
pub const SCHEMA: u32 = 1;
/// Environment variable with the Pod's UID, from the downward API.
pub const ENV_POD_UID: &str = "POD_UID";
/// The whole `logs` volume, in `workspace` and `logcopy`.
pub const LOGS: &str = "/logs";
/// Where `workspace` puts `leaderboard-runner`; mounted read-only in the workers' containers.
pub const TOOLS: &str = "/leaderboard-tools";
/// The runner's name in [`TOOLS`].
pub const RUNNER: &str = "leaderboard-runner";
/// The runner inside the operator's image.
pub const RUNNER_IN_IMAGE: &str = "/usr/local/bin/leaderboard-runner";
/// Files by which a container resolves names. The kubelet mounts one file of each for the whole Pod, writable; `workspace` copies
/// them into [`TOOLS`], at the same path below it.
pub const NAME_FILES: [&str; 3] = ["/etc/hosts", "/etc/resolv.conf", "/etc/hostname"];
/// Folder of the downward-API file with the stop annotation.
pub const PODINFO: &str = "/podinfo";
/// The file in it.
pub const STOP_FILE: &str = "stop";
/// Folder of the `logs` volume with the status files, one sub-folder a writer.
pub const STATUS_FOLDER: &str = "containers-status";
/// Folder of the projected token of `podIdentity.roleARN`.
pub const IDENTITY: &str = "/var/run/secrets/leaderboard";
/// The token in it.
pub const IDENTITY_TOKEN_FILE: &str = "token";
/// Environment variable with the role of `podIdentity.roleARN`, in `workspace` and `logcopy`.
pub const ENV_ROLE_ARN: &str = "LEADERBOARD_ROLE_ARN";

/// One attempt of one submission, as its Pod needs to know it.
#[derive(Serialize, Deserialize, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
pub struct Run {
    /// [`SCHEMA`].
    pub schema: u32,
    /// Namespace of the Submission.
    pub namespace: String,
    /// Name of the Submission.
    pub submission: String,
    /// UID of the Submission: a report of another one does not count.
    pub uid: String,
    pub attempt: Attempt,
    /// Share of each worker, images and storage.
    pub plan: RunPlan,
    /// The submitted file, of a run of the mode Predictions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub input: Option<SubmittedFile>,
    /// The reaction to scores that do not follow from their infractions.
    pub verify: Verify,
    /// Seconds between two rounds.
    pub period_seconds: u64,
    /// Seconds the last upload may take.
    pub flush_seconds: u64,
    /// Seconds from a cancel to the end.
    pub cancel_seconds: u64,
    /// The store of container logs; absent: they are in the store of the results alone.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub logs: Option<Logs>,
    /// How `workspace` measures whether the Pod's NetworkPolicy is enforced; absent: not at all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub isolation: Option<Isolation>,
}

impl Run {
    /// The log group of CloudWatch Logs.
    pub fn log_group(&self) -> Option<&LogGroup> {
        self.logs.as_ref().map(|logs| &logs.cloud_watch)
    }
}

/// The measurement of the Pod's NetworkPolicy, and its consequence.
#[derive(Serialize, Deserialize, Clone, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct Isolation {
    /// `Require` ends the run unless the policy is found to be enforced. `Warn` lets it go on.
    pub enforcement: Enforcement,
    /// The address to try, as `10.0.0.1:443`; absent: the API server's service address.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub probe: Option<String>,
    /// Ranges that the policy allows: an address in one of them shows nothing.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub egress: Vec<String>,
    /// A Pod before this one has lately waited in vain for the policy to be enforced, so a shorter wait is enough.
    #[serde(default)]
    pub is_known_open: bool,
}

/// Why a Pod is to stop: the value of the stop annotation.
#[derive(Serialize, Deserialize, Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stop {
    /// The participant, a host or a deletion ends it.
    Cancel,
    /// A worker has used up its crashes.
    Retries,
    /// `deadlines.runSeconds` is over.
    RunDeadline,
    /// Its node is about to be taken away, or a higher attempt is asked for.
    Interruption,
}

impl Stop {
    /// The annotation's value.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Cancel => "Cancel",
            Self::Retries => "Retries",
            Self::RunDeadline => "RunDeadline",
            Self::Interruption => "Interruption",
        }
    }

    /// Reads the annotation's value; unknown text is nothing.
    pub fn parse(text: &str) -> Option<Self> {
        [Self::Cancel, Self::Retries, Self::RunDeadline, Self::Interruption]
            .into_iter()
            .find(|s| s.as_str() == text.trim())
    }
}

/// Variable of the SDK that says when S3 is sent a checksum: `when_supported`, or `when_required` for stores that know none.
pub const ENV_CHECKSUMS: &str = "AWS_REQUEST_CHECKSUM_CALCULATION";
