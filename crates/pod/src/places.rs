//! Where things are for the programs in the Pod: the mounts, and the few values the Pod's template puts in the environment.
//!
//! Made by the programs' entry points from the constants of `leaderboard_contract::run`, and by tests from temporary folders.

use std::fs;
use std::net::{IpAddr, SocketAddr};
use std::path::{Path, PathBuf};

use leaderboard_contract::run::{
    ENV_POD_UID, ENV_ROLE_ARN, ENV_RUN, IDENTITY, IDENTITY_TOKEN_FILE, LOGS, PODINFO, RUNNER, RUNNER_IN_IMAGE, Run,
    SCHEMA, STATUS_FOLDER, STOP_FILE, TOOLS,
};
use leaderboard_contract::verdict::WorkspaceVerdict;
use leaderboard_evaluation::judge::Pace;

/// Files and folders.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Places {
    /// Root of the `logs` volume.
    pub logs: PathBuf,
    /// Folder that gets the runner.
    pub tools: PathBuf,
    /// The runner as it comes with the operator.
    pub runner: PathBuf,
    /// The file system in which the Pod's name files are.
    pub root: PathBuf,
    /// Folder of the downward API.
    pub podinfo: PathBuf,
    /// The projected token.
    pub token: PathBuf,
    /// File that the kubelet copies into the container's status.
    pub termination_log: PathBuf,
}

impl Places {
    /// The mounts of a Pod below a folder: `/` in a container.
    pub fn below(root: &Path) -> Self {
        let at = |path: &str| root.join(path.trim_start_matches('/'));
        Self {
            logs: at(LOGS),
            tools: at(TOOLS),
            runner: at(RUNNER_IN_IMAGE),
            root: root.to_owned(),
            podinfo: at(PODINFO),
            token: at(IDENTITY).join(IDENTITY_TOKEN_FILE),
            termination_log: at("/dev/termination-log"),
        }
    }

    /// Where the containers find the runner.
    pub fn runner_for_all(&self) -> PathBuf {
        self.tools.join(RUNNER)
    }

    /// The file with the stop annotation.
    pub fn stop(&self) -> PathBuf {
        self.podinfo.join(STOP_FILE)
    }

    /// The status files' root.
    pub fn status(&self) -> PathBuf {
        self.logs.join(STATUS_FOLDER)
    }

    /// Leaves a verdict for the controller, in the termination log.
    pub(crate) fn tell(&self, verdict: &WorkspaceVerdict) {
        if let Err(error) = fs::write(&self.termination_log, verdict.to_json()) {
            tracing::warn!("the termination log can't be written: {error}");
        }
    }
}

/// All that a program in the Pod is given.
#[derive(Clone, Debug)]
pub struct Setting {
    /// The run.
    pub run: Run,
    /// UID of the Pod.
    pub pod_uid: String,
    /// The API server's service address, which the kubelet gives to every container.
    pub api_server: Option<SocketAddr>,
    /// Role to assume, if the identity is one.
    pub role_arn: Option<String>,
    /// Mounts.
    pub places: Places,
    /// Waiting times.
    pub pace: Pace,
}

/// The Pod's template lacks something.
#[derive(thiserror::Error, Debug)]
pub enum SettingError {
    /// No such variable.
    #[error("the environment variable {0} is not set: this program runs inside a submission's Pod only")]
    Missing(&'static str),
    /// Not what the controller writes.
    #[error("{ENV_RUN} is not the description of a run: {0}. Operator and Pod must be of the same version")]
    Malformed(#[from] serde_json::Error),
    /// Document of a version that this program does not know.
    #[error(
        "{ENV_RUN} has schema {0}, and this program reads {SCHEMA}. Operator and Pod must be of the \
         same version"
    )]
    Schema(u32),
}

impl Setting {
    /// Reads the environment of a Pod.
    pub fn read(places: Places, pace: Pace) -> Result<Self, SettingError> {
        Ok(Self {
            run: run()?,
            pod_uid: variable(ENV_POD_UID)?,
            api_server: api_server(),
            role_arn: std::env::var(ENV_ROLE_ARN).ok().filter(|arn| !arn.is_empty()),
            places,
            pace,
        })
    }
}

/// The run in the environment of a Pod.
pub fn run() -> Result<Run, SettingError> {
    let run: Run = serde_json::from_str(&variable(ENV_RUN)?)?;
    if run.schema != SCHEMA {
        return Err(SettingError::Schema(run.schema));
    }
    Ok(run)
}

fn variable(name: &'static str) -> Result<String, SettingError> {
    std::env::var(name).map_err(|_| SettingError::Missing(name))
}

fn api_server() -> Option<SocketAddr> {
    let host: IpAddr = variable("KUBERNETES_SERVICE_HOST").ok()?.parse().ok()?;
    let port = variable("KUBERNETES_SERVICE_PORT").ok()?.parse().ok()?;
    Some(SocketAddr::new(host, port))
}
