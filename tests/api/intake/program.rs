//! One of the operator's programs as a child process that can be killed and started again.

use std::fs;
use std::path::{Path, PathBuf};

use tokio::process::{Child, Command};

use super::super::process::operator;
use crate::support::apiserver::server;

/// Last words of a controller that could not renew its Lease, which may happen on a busy machine.
const LOST_LEASE: &str = "this process no longer leads";

/// A running program, in a Pod of its own that keeps its name. It is killed when this is dropped.
pub struct Program {
    command: &'static str,
    name: &'static str,
    namespace: String,
    kubeconfig: PathBuf,
    folder: tempfile::TempDir,
    child: Child,
}

impl Program {
    pub async fn start(program: &'static str, name: &'static str, namespace: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let kubeconfig = server().await.kubeconfig();
        let child = command(program, name, namespace, &kubeconfig, &folder).spawn().unwrap();
        Self {
            command: program,
            name,
            namespace: namespace.to_owned(),
            kubeconfig,
            folder,
            child,
        }
    }

    /// Kills it, as a lost node would, and waits for its end.
    pub async fn kill(&mut self) {
        self.keep();
        self.child.kill().await.unwrap();
    }

    /// As the kubelet would.
    pub fn start_again(&mut self) {
        let mut command = command(self.command, self.name, &self.namespace, &self.kubeconfig, &self.folder);
        self.child = command.spawn().unwrap();
    }

    /// Starts it again if it has lost its Lease. No other end by itself is allowed.
    pub fn keep(&mut self) {
        let Some(status) = self.child.try_wait().unwrap() else {
            return;
        };
        let log = self.log();
        let last = log.lines().last().unwrap_or("nothing");
        assert!(
            last.contains(LOST_LEASE),
            "{} has ended by itself, {status}: {last}",
            self.name
        );
        self.start_again();
    }

    /// Its resident memory in KiB.
    pub fn memory(&self) -> u64 {
        self.of_status("VmRSS:")
    }

    /// The most that its resident memory has been, in KiB.
    pub fn most_memory(&self) -> u64 {
        self.of_status("VmHWM:")
    }

    fn of_status(&self, field: &str) -> u64 {
        let id = self.child.id().expect("it runs");
        let status = fs::read_to_string(format!("/proc/{id}/status")).unwrap();
        let line = status.lines().find_map(|line| line.strip_prefix(field)).unwrap();
        line.trim().trim_end_matches(" kB").parse().unwrap()
    }

    /// All that it has logged.
    pub fn log(&self) -> String {
        fs::read_to_string(log(&self.folder)).unwrap_or_default()
    }
}

fn log(folder: &tempfile::TempDir) -> PathBuf {
    folder.path().join("log")
}

fn command(program: &str, name: &str, namespace: &str, kubeconfig: &Path, folder: &tempfile::TempDir) -> Command {
    let mut command = operator(program, name, namespace, kubeconfig, &log(folder));
    command.env("POD_UID", name).env("RUST_LOG", "warn");
    command
}
