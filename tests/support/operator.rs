//! The operator's programs as child processes of a test. Each is limited to the test's namespace and has its own Lease. So a test can
//! kill, stop and start it without a disturbance of other tests.

use std::convert::Infallible;
use std::ffi::{OsStr, OsString};
use std::fs::{self, File};
use std::path::PathBuf;
use std::process::{ExitStatus, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;
use tokio::process::{Child, Command};
use tokio::task::JoinHandle;
use tokio::time::{sleep, timeout};

use super::gate::Gate;
use super::scene::{Scene, say};

/// Log filter of the programs, unless `LEADERBOARD_TEST_LOG` sets another.
const LOG: &str = "info,leaderboard=debug";
/// Name of each test's Lease, in its namespace.
pub const LEASE: &str = "operator";
/// Between the end of a program and its next start, as the kubelet has it.
const BACK_OFF: Duration = Duration::from_secs(1);

/// The words of a shell that starts a program with a file in place of `/etc/hosts`.
const MOUNT_HOSTS: &str = r#"mount --bind "$0" /etc/hosts && exec "$@""#;

/// Last words of a controller that could not renew its Lease.
const LOST_LEASE: &str = "this process no longer leads";

/// A running program. It is killed when this is dropped.
pub struct Process {
    child: Child,
    name: String,
    log: PathBuf,
}

/// A program that is started again when it has lost its Lease, as the kubelet would. An API server that is busy for 10 s costs the Lease,
/// and these tests are not about that. Any other end is final, and part of a failed wait's message. It is killed when this is dropped.
pub struct Kept(JoinHandle<()>);

impl Drop for Kept {
    fn drop(&mut self) {
        self.0.abort();
    }
}

/// How a program is started.
#[derive(Clone)]
struct Start {
    program: &'static str,
    namespace: String,
    logs: PathBuf,
    arguments: Vec<String>,
    variables: Vec<(&'static str, OsString)>,
    /// File that it sees as `/etc/hosts`.
    hosts: Option<PathBuf>,
}

/// Starts `leaderboard-operator controller`, and keeps it running.
pub fn controller(scene: &Scene) -> Kept {
    Start::controller(scene).keep(scene)
}

/// Starts a controller that looks names up in these lines of `/etc/hosts`, and keeps it running.
pub fn controller_with_hosts(scene: &Scene, hosts: &str) -> Kept {
    let path = scene.logs.join("hosts");
    fs::write(&path, hosts).unwrap();
    let start = Start {
        hosts: Some(path),
        ..Start::controller(scene)
    };
    start.keep(scene)
}

/// Starts `leaderboard-operator bridge`, and keeps it running.
pub fn bridge(scene: &Scene) -> Kept {
    Start::bridge(scene).keep(scene)
}

/// Starts `leaderboard-operator controller` for a test that ends it or sees it end.
pub fn controller_process(scene: &Scene) -> Process {
    Start::controller(scene).start()
}

/// Starts `leaderboard-operator bridge` for a test that ends it or sees it end.
pub fn bridge_process(scene: &Scene) -> Process {
    Start::bridge(scene).start()
}

/// Starts controller and bridge with a variable in their environment.
pub fn both_with(scene: &Scene, name: &'static str, value: &str) -> [Kept; 2] {
    [Start::controller(scene), Start::bridge(scene)].map(|start| start.with(name, value.as_ref()).keep(scene))
}

/// Starts one that reaches the API server through a gate. It ends by itself when the gate is shut for long.
pub fn controller_through(scene: &Scene, gate: &Gate) -> Process {
    let ours = std::env::var_os("KUBECONFIG").unwrap();
    let mut config: Value = serde_json::from_str(&fs::read_to_string(ours).unwrap()).unwrap();
    config["clusters"][0]["cluster"]["server"] = gate.url.replacen("http:", "https:", 1).into();
    let path = scene.logs.join("kubeconfig");
    fs::write(&path, config.to_string()).unwrap();
    Start::controller(scene).with("KUBECONFIG", path.as_os_str()).start()
}

/// Keeps a program running: starts it again whenever it has ended by itself, as the kubelet would. It never returns; the
/// program is killed when this is dropped.
pub async fn kept(scene: &Scene, start: impl Fn(&Scene) -> Process) -> Infallible {
    loop {
        let mut program = start(scene);
        let status = program.child.wait().await.unwrap();
        say(&format!("{}: {}", scene.namespace, program.end(status)));
        sleep(BACK_OFF).await;
    }
}

impl Start {
    fn controller(scene: &Scene) -> Self {
        let (image, namespace) = (&scene.lab.image, &scene.namespace);
        let arguments = [["--image", image], ["--lease", LEASE], ["--lease-namespace", namespace]];
        Self {
            arguments: arguments.as_flattened().iter().map(|&text| text.to_owned()).collect(),
            ..Self::of(scene, "controller")
        }
    }

    fn bridge(scene: &Scene) -> Self {
        Self::of(scene, "bridge")
    }

    fn of(scene: &Scene, program: &'static str) -> Self {
        Self {
            program,
            namespace: scene.namespace.clone(),
            logs: scene.logs.clone(),
            arguments: Vec::new(),
            variables: Vec::new(),
            hosts: None,
        }
    }

    fn with(mut self, name: &'static str, value: &OsStr) -> Self {
        self.variables.push((name, value.to_owned()));
        self
    }

    fn keep(self, scene: &Scene) -> Kept {
        let ended = scene.ended.clone();
        Kept(tokio::spawn(async move {
            loop {
                let mut program = self.start();
                let Ok(status) = program.child.wait().await else { return };
                let end = program.end(status);
                say(&format!("{}: {end}", self.namespace));
                ended.lock().unwrap().push(end);
                if !program.has_lost_its_lease() {
                    return;
                }
                sleep(BACK_OFF).await;
            }
        }))
    }

    fn start(&self) -> Process {
        static NUMBER: AtomicU32 = AtomicU32::new(1);
        let name = format!("{}-{}", self.program, NUMBER.fetch_add(1, Ordering::Relaxed));
        let path = self.logs.join(format!("{name}.log"));
        let log = File::create(&path).unwrap();
        // A killed test drops nothing; the kernel ends its children all the same.
        let mut command = Command::new("setpriv");
        command.args(["--pdeathsig", "KILL"]);
        if let Some(hosts) = &self.hosts {
            // A mount that no other process on this machine sees.
            command.args(["unshare", "--mount", "sh", "-c", MOUNT_HOSTS]).arg(hosts);
        }
        command
            .arg(binary())
            .arg(self.program)
            .args(["--namespace", &self.namespace, "--http", "127.0.0.1:0"])
            .args(&self.arguments)
            .env("POD_NAME", &name)
            // As in a cluster: what a Leaderboard names is all there is.
            .env_remove("AWS_ENDPOINT_URL")
            .env(
                "RUST_LOG",
                std::env::var("LEADERBOARD_TEST_LOG").as_deref().unwrap_or(LOG),
            )
            .envs(self.variables.iter().cloned())
            .stdin(Stdio::null())
            .stdout(log.try_clone().unwrap())
            .stderr(log)
            .kill_on_drop(true);
        let child = command
            .spawn()
            .unwrap_or_else(|error| panic!("{} does not start: {error}", self.program));
        Process { child, name, log: path }
    }
}

impl Process {
    fn has_lost_its_lease(&self) -> bool {
        fs::read_to_string(&self.log).is_ok_and(|log| log.contains(LOST_LEASE))
    }

    /// One line about its end, with the last one of its log.
    fn end(&self, status: ExitStatus) -> String {
        let log = fs::read_to_string(&self.log).unwrap_or_default();
        let last = log.lines().last().unwrap_or("nothing");
        format!("{} ended by itself, {status}: {last}", self.name)
    }

    fn signal(&self, signal: Signal) {
        let id = self.child.id().unwrap_or_else(|| panic!("{} has ended", self.name));
        kill(Pid::from_raw(i32::try_from(id).unwrap()), signal).unwrap();
    }

    /// Kills it, as a lost node would, and waits for its end. One that has lost its Lease in this very moment counts as killed.
    pub async fn kill(&mut self) {
        if let Some(status) = self.child.try_wait().unwrap() {
            assert!(self.has_lost_its_lease(), "{}", self.end(status));
            return say(&self.end(status));
        }
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
