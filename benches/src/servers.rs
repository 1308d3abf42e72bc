//! etcd, kube-apiserver and the Job controller as processes of their own, on free loopback ports, gone with this program.

use std::fs::{self, File};
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant};

use kube::config::{KubeConfigOptions, Kubeconfig};
use kube::{Client, Config};
use serde_json::json;
use tempfile::TempDir;
use tokio::process::{Child, Command};
use tokio::time::sleep;

use crate::api;
use crate::bench::Outcome;

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
        let mut etcd = Program::start("etcd", &tools.join("etcd"), &etcd_arguments(at, client, peer), at)?;
        let binary = tools.join("kube-apiserver");
        let mut apiserver = Program::start("kube-apiserver", &binary, &apiserver_arguments(at, client, port), at)?;
        let end = Instant::now() + START_LIMIT;
        let config = loop {
            if let Some(why) = etcd.ended().or_else(|| apiserver.ended()) {
                return Err(why.into());
            }
            match probe(at, port).await {
                Ok(config) => break config,
                Err(error) if Instant::now() > end => return Err(error),
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

/// Ports that nobody listens on now, all different.
pub fn free_ports<const N: usize>() -> Outcome<[u16; N]> {
    let mut listeners = Vec::new();
    let mut ports = [0; N];
    for port in &mut ports {
        let listener = TcpListener::bind(("127.0.0.1", 0))?;
        *port = listener.local_addr()?.port();
        listeners.push(listener);
    }
    Ok(ports)
}

fn kubeconfig(folder: &Path, user: &str) -> PathBuf {
    folder.join(format!("{user}.kubeconfig"))
}

/// The users' tokens, what is logged of their requests, and the key that signs the tokens of service accounts.
fn prepare(folder: &Path, audit: Audit) -> Outcome<()> {
    let tokens: Vec<String> = USERS
        .map(|user| format!("{user},{user},{user},system:masters"))
        .to_vec();
    fs::write(folder.join("tokens.csv"), tokens.join("\n"))?;
    let mut rules = vec![json!({"level": "Metadata"})];
    if audit == Audit::Bodies {
        rules.insert(0, json!({"level": "Request", "users": [OPERATOR]}));
    }
    let policy = json!({
        "apiVersion": "audit.k8s.io/v1", "kind": "Policy", "omitStages": ["RequestReceived", "ResponseStarted"],
        "rules": rules,
    });
    fs::write(folder.join("audit-policy.json"), policy.to_string())?;
    let key = std::process::Command::new("openssl")
        .args(["ecparam", "-name", "prime256v1", "-genkey", "-noout", "-out"])
        .arg(folder.join("accounts.key"))
        .output()
        .map_err(|error| format!("openssl does not run: {error}; install it"))?;
    if key.status.success() {
        return Ok(());
    }
    Err(format!("openssl made no key: {}", String::from_utf8_lossy(&key.stderr).trim()).into())
}

fn etcd_arguments(folder: &Path, client: u16, peer: u16) -> Vec<String> {
    let (client, peer) = (format!("http://127.0.0.1:{client}"), format!("http://127.0.0.1:{peer}"));
    vec![
        format!("--data-dir={}", folder.join("etcd").display()),
        format!("--listen-client-urls={client}"),
        format!("--advertise-client-urls={client}"),
        format!("--listen-peer-urls={peer}"),
        format!("--initial-advertise-peer-urls={peer}"),
        format!("--initial-cluster=default={peer}"),
        "--unsafe-no-fsync".into(),
        // 5,000 submissions with all their versions do not fit into the default of 2 GiB.
        "--quota-backend-bytes=8589934592".into(),
        "--log-level=warn".into(),
    ]
}

fn apiserver_arguments(folder: &Path, etcd: u16, port: u16) -> Vec<String> {
    let file = |name: &str| folder.join(name).display().to_string();
    vec![
        format!("--etcd-servers=http://127.0.0.1:{etcd}"),
        "--bind-address=127.0.0.1".into(),
        "--advertise-address=127.0.0.1".into(),
        "--endpoint-reconciler-type=none".into(),
        format!("--secure-port={port}"),
        format!("--cert-dir={}", file("certificates")),
        format!("--token-auth-file={}", file("tokens.csv")),
        format!("--audit-policy-file={}", file("audit-policy.json")),
        format!("--audit-log-path={}", file("audit.log")),
        "--authorization-mode=RBAC".into(),
        // Nobody makes the namespaces' service accounts.
        "--disable-admission-plugins=ServiceAccount".into(),
        "--allow-privileged=true".into(),
        "--service-cluster-ip-range=10.0.0.0/24".into(),
        "--service-account-issuer=https://kubernetes.default.svc".into(),
        format!("--service-account-key-file={}", file("accounts.key")),
        format!("--service-account-signing-key-file={}", file("accounts.key")),
    ]
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

/// Writes every user's kubeconfig once there is a certificate, and asks the server whether it is ready.
async fn probe(folder: &Path, port: u16) -> Outcome<Config> {
    let authority = folder.join("certificates/apiserver.crt");
    if !authority.is_file() {
        return Err("no certificate".into());
    }
    for user in USERS {
        let text = json!({
            "apiVersion": "v1",
            "kind": "Config",
            "clusters": [{"name": "bench", "cluster": {
                "server": format!("https://127.0.0.1:{port}"), "certificate-authority": authority,
            }}],
            "users": [{"name": user, "user": {"token": user}}],
            "contexts": [{"name": "bench", "context": {"cluster": "bench", "user": user, "namespace": "default"}}],
            "current-context": "bench",
        });
        fs::write(kubeconfig(folder, user), text.to_string())?;
    }
    let read = Kubeconfig::read_from(kubeconfig(folder, BENCH))?;
    let config = Config::from_custom_kubeconfig(read, &KubeConfigOptions::default()).await?;
    api::text(&Client::try_from(config.clone())?, "/readyz").await?;
    Ok(config)
}
