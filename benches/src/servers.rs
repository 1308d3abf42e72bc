//! etcd, kube-apiserver and the Job controller as processes of their own, on free loopback ports, gone with this program.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant};

use kube::{Client, Config};
use serde_json::json;
use tempfile::TempDir;
use tokio::process::{Child, Command};
use tokio::time::sleep;

use crate::bench::Outcome;
pub use control_plane::free_ports;
use control_plane::{apiserver_arguments, etcd_arguments, kubeconfig, probe};

#[path = "../../tests/support/control_plane.rs"]
mod control_plane;

const START_LIMIT: Duration = Duration::from_mins(3);
const POLL: Duration = Duration::from_millis(50);
const END_LIMIT: Duration = Duration::from_secs(5);
const END_POLL: Duration = Duration::from_millis(5);
/// A free port can be taken by somebody else before the server has it.
const TRIES: usize = 3;
/// The users, all of them with all rights: fairness between users is no part of what is measured.
const USERS: [&str; 3] = [BENCH, OPERATOR, CONTROLLERS];
const BENCH: &str = "bench";
/// The user that the operator is.
pub const OPERATOR: &str = "operator";
const CONTROLLERS: &str = "controllers";

/// How much of each request the audit log keeps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Audit {
    Metadata,
    /// The operator's bodies too.
    Bodies,
}

/// A child process. It is killed when this is dropped, and by the kernel when this program is.
pub struct Program {
    name: &'static str,
    child: Child,
    log: PathBuf,
}

impl Program {
    pub fn start(name: &'static str, binary: &Path, arguments: &[String], folder: &Path) -> Outcome<Self> {
        Self::start_with(name, binary, arguments, folder, &[])
    }

    pub fn start_with(
        name: &'static str,
        binary: &Path,
        arguments: &[String],
        folder: &Path,
        variables: &[(&str, String)],
    ) -> Outcome<Self> {
        let log = folder.join(format!("{name}.log"));
        let output = File::options().create(true).append(true).open(&log)?;
        let child = Command::new("setpriv")
            .args(["--pdeathsig", "KILL"])
            .arg(binary)
            .args(arguments)
            .envs(variables.iter().map(|(name, value)| (*name, value)))
            .stdin(Stdio::null())
            .stdout(output.try_clone()?)
            .stderr(output)
            .spawn()
            .map_err(|error| format!("{name} does not start: {error}"))?;
        Ok(Self { name, child, log })
    }

    pub fn pid(&self) -> Outcome<u32> {
        self.child.id().ok_or_else(|| format!("{} has ended", self.name).into())
    }

    /// Why it runs no longer.
    pub fn ended(&mut self) -> Option<String> {
        let status = self.child.try_wait().ok().flatten()?;
        let log = fs::read_to_string(&self.log).unwrap_or_default();
        let last = log.lines().last().unwrap_or("nothing");
        Some(format!("{} ended ({status}); its last line is: {last}", self.name))
    }

    /// Kills it and waits until it is gone.
    pub async fn kill(&mut self) -> Outcome<()> {
        Ok(self.child.kill().await?)
    }
}

impl Drop for Program {
    /// Waits for the end: the folder that is removed next must not be written to.
    fn drop(&mut self) {
        let _ = self.child.start_kill();
        let end = Instant::now() + END_LIMIT;
        while matches!(self.child.try_wait(), Ok(None)) && Instant::now() < end {
            std::thread::sleep(END_POLL);
        }
    }
}

/// The running servers.
pub struct Servers {
    // Dropped in this order: the folder last.
    controllers: Option<Program>,
    apiserver: Program,
    etcd: Program,
    pub config: Config,
    pub folder: TempDir,
}

impl Servers {
    pub async fn start(tools: &Path, audit: Audit, has_controllers: bool) -> Outcome<Self> {
        let mut failures = Vec::new();
        for _ in 0..TRIES {
            match Self::start_once(tools, audit, has_controllers).await {
                Ok(servers) => return Ok(servers),
                Err(error) => failures.push(error.to_string()),
            }
        }
        Err(format!("no API server after {TRIES} starts: {}", failures.join("; ")).into())
    }

    async fn start_once(tools: &Path, audit: Audit, has_controllers: bool) -> Outcome<Self> {
        let folder = tempfile::Builder::new().prefix("leaderboard-bench-").tempdir()?;
        let [client, peer, port, controllers] = free_ports()?;
        prepare(folder.path(), audit)?;
        let at = folder.path();
        let mut arguments = etcd_arguments(at, client, peer);
        // 5,000 submissions with all their versions do not fit into the default of 2 GiB.
        arguments.push("--quota-backend-bytes=8589934592".into());
        let mut etcd = Program::start("etcd", &tools.join("etcd"), &arguments, at)?;
        let binary = tools.join("kube-apiserver");
        let mut apiserver = Program::start("kube-apiserver", &binary, &apiserver_arguments(at, client, port), at)?;
        let end = Instant::now() + START_LIMIT;
        let config = loop {
            if let Some(why) = etcd.ended().or_else(|| apiserver.ended()) {
                return Err(why.into());
            }
            match probe(at, port, &USERS).await {
                Ok(config) => break config,
                Err(error) if Instant::now() > end => return Err(error.into()),
                Err(_) => sleep(POLL).await,
            }
        };
        let controllers = if has_controllers {
            let binary = tools.join("kube-controller-manager");
            let arguments = controllers_arguments(at, controllers);
            Some(Program::start("kube-controller-manager", &binary, &arguments, at)?)
        } else {
            None
        };
        Ok(Self {
            controllers,
            apiserver,
            etcd,
            config,
            folder,
        })
    }

    pub fn client(&self) -> Outcome<Client> {
        Ok(Client::try_from(self.config.clone())?)
    }

    pub fn apiserver(&self) -> Outcome<u32> {
        self.apiserver.pid()
    }

    /// etcd and the Job controller.
    pub fn others(&self) -> Vec<u32> {
        let programs = self.controllers.iter().chain([&self.etcd]);
        programs.filter_map(|program| program.pid().ok()).collect()
    }

    /// The operator's way to the API server.
    pub fn kubeconfig(&self) -> PathBuf {
        kubeconfig(self.folder.path(), OPERATOR)
    }

    pub fn audit_log(&self) -> PathBuf {
        self.folder.path().join("audit.log")
    }

    /// Why one of them runs no longer.
    pub fn ended(&mut self) -> Option<String> {
        let first = self.etcd.ended().or_else(|| self.apiserver.ended());
        first.or_else(|| self.controllers.as_mut().and_then(Program::ended))
    }
}

/// The users, what is logged of their requests, and the key that signs the tokens of service accounts.
fn prepare(folder: &Path, audit: Audit) -> Result<(), String> {
    let rules = match audit {
        Audit::Metadata => json!([{"level": "Metadata"}]),
        Audit::Bodies => json!([{"level": "Request", "users": [OPERATOR]}, {"level": "Metadata"}]),
    };
    control_plane::prepare(folder, USERS, &rules)
}

/// Jobs and their time to live only, at a rate that is no limit.
fn controllers_arguments(folder: &Path, port: u16) -> Vec<String> {
    let config = kubeconfig(folder, CONTROLLERS).display().to_string();
    vec![
        format!("--kubeconfig={config}"),
        format!("--authentication-kubeconfig={config}"),
        format!("--authorization-kubeconfig={config}"),
        "--bind-address=127.0.0.1".into(),
        format!("--secure-port={port}"),
        format!("--cert-dir={}", folder.join("controllers-certificates").display()),
        "--leader-elect=false".into(),
        "--use-service-account-credentials=false".into(),
        "--controllers=job-controller,ttl-after-finished-controller".into(),
        "--kube-api-qps=1000".into(),
        "--kube-api-burst=2000".into(),
        "--concurrent-job-syncs=5".into(),
    ]
}
