//! An etcd and a kube-apiserver on loopback: their arguments, their files, and whether they are ready. For the tests and the benchmark,
//! which start and end them each in its own way.

use std::fs;
use std::io;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::Command;

use kube::config::{KubeConfigOptions, Kubeconfig};
use kube::{Client, Config};
use serde_json::{Value, json};

/// The key that signs the tokens of service accounts.
const KEY: &str = "service-accounts.key";

/// Free ports, all different.
pub fn free_ports<const N: usize>() -> io::Result<[u16; N]> {
    let mut listeners = Vec::new();
    let mut ports = [0; N];
    for port in &mut ports {
        let listener = TcpListener::bind(("127.0.0.1", 0))?;
        *port = listener.local_addr()?.port();
        listeners.push(listener);
    }
    Ok(ports)
}

/// Writes what the API server reads at its start. The users have all rights, and their names for tokens; the rules define which of their
/// requests are logged.
pub fn prepare(folder: &Path, users: impl IntoIterator<Item: AsRef<str>>, rules: &Value) -> Result<(), String> {
    let failed = |error: io::Error| format!("{} cannot be prepared: {error}", folder.display());
    let token = |user: &str| format!("{user},{user},{user},system:masters\n");
    let tokens: String = users.into_iter().map(|user| token(user.as_ref())).collect();
    fs::write(folder.join("tokens.csv"), tokens).map_err(failed)?;
    let policy = json!({
        "apiVersion": "audit.k8s.io/v1",
        "kind": "Policy",
        "omitStages": ["RequestReceived", "ResponseStarted"],
        "rules": rules,
    });
    fs::write(folder.join("audit-policy.json"), policy.to_string()).map_err(failed)?;
    let key = Command::new("openssl")
        // The traditional format: the server reads no other for this kind of key.
        .args(["ecparam", "-name", "prime256v1", "-genkey", "-noout", "-out"])
        .arg(folder.join(KEY))
        .output()
        .map_err(|error| format!("openssl does not run: {error}; install it"))?;
    if key.status.success() {
        return Ok(());
    }
    let why = String::from_utf8_lossy(&key.stderr);
    Err(format!("openssl made no key: {}", why.trim()))
}

pub fn etcd_arguments(folder: &Path, client: u16, peer: u16) -> Vec<String> {
    let (client, peer) = (format!("http://127.0.0.1:{client}"), format!("http://127.0.0.1:{peer}"));
    vec![
        format!("--data-dir={}", folder.join("etcd").display()),
        format!("--listen-client-urls={client}"),
        format!("--advertise-client-urls={client}"),
        format!("--listen-peer-urls={peer}"),
        format!("--initial-advertise-peer-urls={peer}"),
        format!("--initial-cluster=default={peer}"),
        "--unsafe-no-fsync".into(),
        "--log-level=warn".into(),
    ]
}

pub fn apiserver_arguments(folder: &Path, etcd: u16, port: u16) -> Vec<String> {
    let file = |name: &str| folder.join(name).display().to_string();
    vec![
        format!("--etcd-servers=http://127.0.0.1:{etcd}"),
        "--bind-address=127.0.0.1".into(),
        "--advertise-address=127.0.0.1".into(),
        // It refuses to write a loopback address to the Service `kubernetes`, which no test uses.
        "--endpoint-reconciler-type=none".into(),
        format!("--secure-port={port}"),
        format!("--cert-dir={}", file("certificates")),
        format!("--token-auth-file={}", file("tokens.csv")),
        format!("--audit-policy-file={}", file("audit-policy.json")),
        format!("--audit-log-path={}", file("audit.log")),
        "--authorization-mode=RBAC".into(),
        // No controller makes the namespaces' service accounts.
        "--disable-admission-plugins=ServiceAccount".into(),
        "--allow-privileged=true".into(),
        "--service-cluster-ip-range=10.0.0.0/24".into(),
        "--service-account-issuer=https://kubernetes.default.svc".into(),
        format!("--service-account-key-file={}", file(KEY)),
        format!("--service-account-signing-key-file={}", file(KEY)),
    ]
}

/// The file that a user's programs reach the server by.
pub fn kubeconfig(folder: &Path, user: &str) -> PathBuf {
    folder.join(format!("{user}.kubeconfig"))
}

/// Writes the users' kubeconfigs once there is a certificate, and asks the server as the first of them whether it is ready.
pub async fn probe(folder: &Path, port: u16, users: &[&str]) -> Result<Config, String> {
    // The server makes its own authority and writes it behind its certificate.
    let authority = folder.join("certificates/apiserver.crt");
    let [first, ..] = users else {
        return Err("nobody asks".into());
    };
    if !authority.is_file() {
        return Err("no certificate".into());
    }
    for user in users {
        let text = json!({
            "apiVersion": "v1",
            "kind": "Config",
            "clusters": [{"name": "local", "cluster": {
                "server": format!("https://127.0.0.1:{port}"),
                "certificate-authority": authority,
            }}],
            "users": [{"name": user, "user": {"token": user}}],
            "contexts": [{"name": "local", "context": {"cluster": "local", "user": user, "namespace": "default"}}],
            "current-context": "local",
        });
        fs::write(kubeconfig(folder, user), text.to_string()).map_err(|error| error.to_string())?;
    }
    let read = Kubeconfig::read_from(kubeconfig(folder, first)).map_err(|error| error.to_string())?;
    let config = Config::from_custom_kubeconfig(read, &KubeConfigOptions::default())
        .await
        .map_err(|error| error.to_string())?;
    let client = Client::try_from(config.clone()).map_err(|error| error.to_string())?;
    let request = http::Request::get("/readyz").body(Vec::new());
    let request = request.map_err(|error| error.to_string())?;
    client.request_text(request).await.map_err(|error| error.to_string())?;
    Ok(config)
}
