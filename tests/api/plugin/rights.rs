//! How the plugin finds its cluster and credentials, and which rights it needs.

use std::ffi::OsString;
use std::io::Write as _;
use std::path::PathBuf;
use std::process::Stdio;
use std::time::Duration;

use serde_json::{Value, json};
use tempfile::TempDir;
use tokio::process::Command;
use tokio::time::timeout;

use super::terminal::{Printed, Terminal, Waits, assert_has, end, ended, plugin, running, waiting};
use crate::api::bridge::LIMIT;
use crate::api::objects::{Kind, merge};

const DOCS: &str = include_str!("../../../docs/plugin.md");
/// A right applies a moment after it was given, and the API server reports nothing then: it is asked this often.
const POLL: Duration = Duration::from_millis(50);

#[tokio::test]
async fn kubectl_finds_it_on_the_path_and_the_context_names_the_namespace() {
    let terminal = Terminal::new().await;
    terminal.submission("a", &json!({}), &waiting()).await;
    let program = plugin();
    let bin = program.parent().unwrap();
    let mut path = OsString::from(bin);
    path.push(":");
    path.push(std::env::var_os("PATH").unwrap_or_default());
    let mut kubectl = Command::from(terminal.server.kubectl());
    kubectl
        .env("PATH", path)
        .args(["leaderboard", "why", "a", "-n", &terminal.namespace]);
    let text = Printed::of(&ended(&mut kubectl).await).well();
    assert!(text.starts_with("a is Pending since "), "{text}");

    let (folder, file) = person(&terminal, &json!({}));
    let mut command = Command::new(plugin());
    command
        .env("KUBECONFIG", &file)
        .args(["why", "a", "--context", "person"]);
    assert!(
        Printed::of(&ended(&mut command).await)
            .well()
            .starts_with("a is Pending since ")
    );
    let mut command = Command::new(plugin());
    command
        .env("KUBECONFIG", &file)
        .args(["why", "a", "--context", "nobody"]);
    let text = Printed::of(&ended(&mut command).await).refused();
    assert_has(&text, &["no cluster is configured: ", "nobody", "Set KUBECONFIG"]);
    drop(folder);
}

#[tokio::test]
async fn a_cluster_that_is_not_there_is_one_line() {
    let folder = tempfile::tempdir().unwrap();
    let missing = folder.path().join("missing");
    let mut command = Command::new(plugin());
    command.arg("why").arg("--kubeconfig").arg(&missing);
    let text = Printed::of(&ended(&mut command).await).refused();
    assert_has(&text, &["no cluster is configured: ", "Set KUBECONFIG"]);

    let broken = folder.path().join("broken");
    std::fs::write(&broken, "users: [secret-token\nclusters: {").unwrap();
    for set in [&["--kubeconfig"][..], &[]] {
        let mut command = Command::new(plugin());
        command.arg("why").args(set).env("KUBECONFIG", &broken);
        if !set.is_empty() {
            command.arg(&broken);
        }
        let text = Printed::of(&ended(&mut command).await).refused();
        assert_has(&text, &["no cluster is configured: ", "not YAML"]);
        assert!(!text.contains("secret-token"), "{text}");
    }

    let terminal = Terminal::new().await;
    let (_folder, file) = person(
        &terminal,
        &json!({"exec": {
            "apiVersion": "client.authentication.k8s.io/v1", "command": "sh", "interactiveMode": "Never",
            "args": ["-c", "echo secret-token; echo 'log in first' >&2; exit 3"],
        }}),
    );
    let text = terminal.run_as(&file, &["why"]).await.refused();
    assert_has(
        &text,
        &["the cluster does not accept your credentials: ", "log in first"],
    );
    assert!(!text.contains("secret-token"), "{text}");
}

/// The rights that the documentation lists are enough, and without them the plugin names what is missing.
#[tokio::test]
async fn the_documented_rights_are_enough() {
    let terminal = Terminal::new().await;
    terminal.leaderboard(&json!({})).await;
    terminal.submission("runs", &json!({}), &running()).await;
    let name = format!("person-of-{}", terminal.namespace);
    let (_folder, file) = person(&terminal, &json!({"as": name}));
    for arguments in [&["why"][..], &["why", "runs"], &["cancel", "runs"]] {
        let text = terminal.run_as(&file, arguments).await.refused();
        assert_has(
            &text,
            &["missing right: ", "is forbidden", "docs/plugin.md#rights has a Role"],
        );
    }

    give(&terminal, &name, "submissions");
    until_allowed(&terminal, &name, "submissions").await;
    let text = terminal.run_as(&file, &["why", "runs"]).await.well();
    assert_has(&text, &["You have no right to read Leaderboard local"]);
    let text = terminal.run_as(&file, &["why"]).await.well();
    assert_has(&text, &["You have no right to read Leaderboards"]);

    give(&terminal, &name, "leaderboards");
    until_allowed(&terminal, &name, "leaderboards").await;
    assert!(
        !terminal
            .run_as(&file, &["why", "runs"])
            .await
            .well()
            .contains("no right")
    );
    let mut command = terminal.command(&["cancel", "runs", "--wait"]);
    let mut waits = Waits::start(command.arg("--kubeconfig").arg(&file));
    waits.until("runs is Running").await;
    terminal
        .status(Kind::Submission, "runs", &end("Cancelled", "Cancelled"))
        .await;
    assert_eq!(waits.code().await, Some(0));
}

/// A person who may only look at submissions.
pub async fn reader(terminal: &Terminal) -> (TempDir, PathBuf) {
    let name = format!("reader-of-{}", terminal.namespace);
    let known = person(terminal, &json!({"as": name}));
    let read_only = |rule: &mut Value| rule["verbs"] = json!(["get", "list"]);
    give_changed(terminal, &name, "submissions", read_only);
    until_allowed(terminal, &name, "submissions").await;
    known
}

/// The kubeconfig of a person whose context names the namespace.
fn person(terminal: &Terminal, user: &Value) -> (TempDir, PathBuf) {
    let text = std::fs::read_to_string(&terminal.kubeconfig).unwrap();
    let mut config: Value = serde_json::from_str(&text).unwrap();
    if user.get("exec").is_some() {
        config["users"][0]["user"] = user.clone();
    } else {
        merge(&mut config["users"][0]["user"], user);
    }
    config["contexts"][0]["name"] = json!("person");
    config["contexts"][0]["context"]["namespace"] = json!(terminal.namespace);
    config["current-context"] = json!("person");
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("config");
    let mut out = std::fs::File::create(&file).unwrap();
    out.write_all(config.to_string().as_bytes()).unwrap();
    (folder, file)
}

/// Gives a person the rights on one kind that docs/plugin.md lists.
fn give(terminal: &Terminal, person: &str, resource: &str) {
    give_changed(terminal, person, resource, |_| {});
}

/// Gives a person the rights of the documents, with one rule changed.
fn give_changed(terminal: &Terminal, person: &str, resource: &str, change: impl FnOnce(&mut Value)) {
    let (_, rest) = DOCS.split_once("```yaml\n").unwrap();
    let (role, _) = rest.split_once("```").unwrap();
    let role: Value = serde_saphyr::from_str(role).unwrap();
    let rules = role["rules"].as_array().unwrap();
    let mut rule = rules
        .iter()
        .find(|rule| rule["resources"] == json!([resource]))
        .unwrap()
        .clone();
    change(&mut rule);
    let meta = json!({"name": resource, "namespace": terminal.namespace});
    let role = json!({"apiVersion": "rbac.authorization.k8s.io/v1", "kind": "Role", "metadata": meta, "rules": [rule]});
    let binding = json!({
        "apiVersion": "rbac.authorization.k8s.io/v1", "kind": "RoleBinding", "metadata": meta,
        "roleRef": {"apiGroup": "rbac.authorization.k8s.io", "kind": "Role", "name": resource},
        "subjects": [{"apiGroup": "rbac.authorization.k8s.io", "kind": "User", "name": person}],
    });
    let list = json!({"apiVersion": "v1", "kind": "List", "items": [role, binding]});
    let mut kubectl = terminal.server.kubectl();
    let mut child = kubectl
        .args(["apply", "-f", "-"])
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    child
        .stdin
        .take()
        .unwrap()
        .write_all(list.to_string().as_bytes())
        .unwrap();
    assert!(child.wait().unwrap().success());
}

/// Waits until the API server applies a person's right.
async fn until_allowed(terminal: &Terminal, person: &str, resource: &str) {
    let review = json!({
        "apiVersion": "authorization.k8s.io/v1", "kind": "SubjectAccessReview",
        "spec": {"user": person, "resourceAttributes": {
            "group": "leaderboard.carla.org", "resource": resource, "verb": "list", "namespace": terminal.namespace,
        }},
    });
    let allowed = async {
        loop {
            let request = http::Request::post("/apis/authorization.k8s.io/v1/subjectaccessreviews");
            let request = request.header("content-type", "application/json");
            let request = request.body(review.to_string().into_bytes()).unwrap();
            let answer: Value = terminal.client.request(request).await.unwrap();
            if answer["status"]["allowed"] == json!(true) {
                return;
            }
            tokio::time::sleep(POLL).await;
        }
    };
    timeout(LIMIT, allowed).await.expect("the right is known");
}
