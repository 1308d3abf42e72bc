//! The operator's programs as child processes of a test: each is limited to the test's namespace and has its own Lease, so
//! that it can be killed, stopped and started again without anybody else's notice.

use std::convert::Infallible;
use std::ffi::OsStr;
use std::fs::{self, File};
use std::path::PathBuf;
use std::process::{ExitStatus, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;
use tokio::process::{Child, Command};
use tokio::time::{sleep, timeout};

use super::gate::Gate;
use super::scene::{Scene, say};

/// What the programs log, unless `LEADERBOARD_TEST_LOG` says otherwise.
const LOG: &str = "info,leaderboard_operator=debug";
/// Name of each test's Lease, in its namespace.
pub const LEASE: &str = "operator";
/// Between the end of a program and its next start, as the kubelet has it.
const BACK_OFF: Duration = Duration::from_secs(1);

/// A running program. It is killed when this is dropped.
pub struct Process {
    child: Child,
    name: String,
}

/// Starts `leaderboard-operator controller`.
pub fn controller(scene: &Scene) -> Process {
    Process::start(scene, "controller", &controller_arguments(scene), &[])
}

/// Starts controller and bridge with a variable in their environment.
pub fn both_with(scene: &Scene, name: &str, value: &str) -> [Process; 2] {
    let variables = [(name, OsStr::new(value))];
    [
        Process::start(scene, "controller", &controller_arguments(scene), &variables),
        Process::start(scene, "bridge", &[], &variables),
    ]
}

/// Starts one that reaches the API server through a gate. It ends by itself when the gate is shut for long.
pub fn controller_through(scene: &Scene, gate: &Gate) -> Process {
    let ours = std::env::var_os("KUBECONFIG").unwrap();
    let mut config: Value = serde_json::from_str(&fs::read_to_string(ours).unwrap()).unwrap();
    config["clusters"][0]["cluster"]["server"] = gate.url.replacen("http:", "https:", 1).into();
    let path = scene.logs.join("kubeconfig");
    fs::write(&path, config.to_string()).unwrap();
    let variables = [("KUBECONFIG", path.as_os_str())];
    Process::start(scene, "controller", &controller_arguments(scene), &variables)
}

fn controller_arguments(scene: &Scene) -> [&str; 6] {
    let (image, namespace) = (&scene.lab.image, &scene.namespace);
    ["--image", image, "--lease", LEASE, "--lease-namespace", namespace]
}

/// Starts `leaderboard-operator bridge`.
pub fn bridge(scene: &Scene) -> Process {
    Process::start(scene, "bridge", &[], &[])
}

/// Keeps a program running: starts it again whenever it has ended by itself, as the kubelet would. It never returns; the
/// program is killed when this is dropped.
pub async fn kept(scene: &Scene, start: impl Fn(&Scene) -> Process) -> Infallible {
    loop {
        let mut program = start(scene);
        let status = program.child.wait().await.unwrap();
        say(&format!(
            "{}: {} ended by itself, {status}",
            scene.namespace, program.name
        ));
        sleep(BACK_OFF).await;
    }
}

impl Process {
    fn start(scene: &Scene, program: &str, arguments: &[&str], variables: &[(&str, &OsStr)]) -> Self {
        static NUMBER: AtomicU32 = AtomicU32::new(1);
        let name = format!("{program}-{}", NUMBER.fetch_add(1, Ordering::Relaxed));
        let log = File::create(scene.logs.join(format!("{name}.log"))).unwrap();
        // A killed test drops nothing; the kernel ends its children all the same.
        let mut command = Command::new("setpriv");
        command
            .args(["--pdeathsig", "KILL"])
            .arg(binary())
            .arg(program)
            .args(["--namespace", &scene.namespace, "--http", "127.0.0.1:0"])
            .args(arguments)
            .env("POD_NAME", &name)
            // As in a cluster: what a Leaderboard names is all there is.
            .env_remove("AWS_ENDPOINT_URL")
            .env(
                "RUST_LOG",
                std::env::var("LEADERBOARD_TEST_LOG").as_deref().unwrap_or(LOG),
            )
            .envs(variables.iter().copied())
            .stdin(Stdio::null())
            .stdout(log.try_clone().unwrap())
            .stderr(log)
            .kill_on_drop(true);
        let child = command
            .spawn()
            .unwrap_or_else(|error| panic!("{program} does not start: {error}"));
        Self { child, name }
    }

    fn signal(&self, signal: Signal) {
        let id = self.child.id().unwrap_or_else(|| panic!("{} has ended", self.name));
        kill(Pid::from_raw(i32::try_from(id).unwrap()), signal).unwrap();
    }

    /// Kills it, as a lost node would, and waits for its end.
    pub async fn kill(&mut self) {
        assert!(
            self.child.try_wait().unwrap().is_none(),
            "{} had ended by itself",
            self.name
        );
        self.child.kill().await.unwrap();
    }

    /// Stops it in mid-step; it believes that no time passes.
    pub fn freeze(&self) {
        self.signal(Signal::SIGSTOP);
    }

    /// Lets it go on.
    pub fn thaw(&self) {
        self.signal(Signal::SIGCONT);
    }

    /// Waits until it has ended by itself.
    pub async fn ended(&mut self, limit: Duration) -> ExitStatus {
        let ended = timeout(limit, self.child.wait()).await;
        ended
            .unwrap_or_else(|_| panic!("{} still runs after {} s", self.name, limit.as_secs()))
            .unwrap()
    }
}

fn binary() -> PathBuf {
    let given = std::env::var_os("LEADERBOARD_OPERATOR_BIN");
    given.map_or_else(|| env!("CARGO_BIN_EXE_leaderboard-operator").into(), PathBuf::from)
}
