//! `kubectl leaderboard import` as a person runs it. Its manifests are applied to the API server, alone and with the decisions of the
//! documents laid over them.
#![cfg(test)]

use std::collections::BTreeMap;
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;
use std::process::{Command, Output};

use serde_json::{Value, json};
use tempfile::TempDir;

use super::plugin::plugin;
use crate::support::apiserver::server;

const TOKEN: &str = "local-host-token";
const FILE: &str = "entries.json";

/// The four entries, as the original has them.
fn entries() -> BTreeMap<&'static str, Value> {
    let file = include_str!("../../crates/kubectl-leaderboard/src/import/entries.json");
    serde_json::from_str(file).unwrap()
}

/// The output of `aws secretsmanager get-secret-value --output json` for these entries.
fn answers(entries: &BTreeMap<&str, Value>) -> String {
    let answer = |(name, entry): (&&str, &Value)| {
        let arn = format!("arn:aws:secretsmanager:us-west-2:123456789012:secret:{name}-Ab12Cd");
        format!(
            "{:#}\n",
            json!({"ARN": arn, "Name": name, "SecretString": entry.to_string()})
        )
    };
    entries.iter().map(answer).collect()
}

/// A folder with a file of answers.
fn folder(text: &str, mode: u32) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join(FILE);
    std::fs::write(&file, text).unwrap();
    std::fs::set_permissions(&file, std::fs::Permissions::from_mode(mode)).unwrap();
    folder
}

/// Runs the command of the documents in a folder, where no cluster is known.
fn import(folder: &Path, more: &[&str]) -> Output {
    let queue = "https://sqs.us-west-2.amazonaws.com/123456789012/leaderboard";
    let mut command = Command::new(plugin());
    command.env_clear().current_dir(folder);
    command
        .args(["import", FILE, "--challenge", "2098", "--queue", queue])
        .args(more);
    command.output().unwrap()
}

fn texts(output: &Output) -> (String, String) {
    let text = |bytes: &[u8]| String::from_utf8(bytes.to_vec()).unwrap();
    (text(&output.stdout), text(&output.stderr))
}

/// The objects of a file of manifests, as kubectl prints them after a dry run.
async fn dry_run(file: &Path) -> Vec<String> {
    let mut command = server().await.kubectl();
    command.args([
        "apply",
        "--server-side",
        "--validate=strict",
        "--dry-run=server",
        "--output",
        "name",
    ]);
    let output = command.arg("--filename").arg(file).output().unwrap();
    let (out, err) = texts(&output);
    assert!(output.status.success() && err.is_empty(), "{err}");
    out.lines().map(str::to_owned).collect()
}

#[tokio::test]
async fn what_is_printed_is_accepted_by_the_api_server() {
    let namespace = server().await.namespace("import").await;
    let folder = folder(&answers(&entries()), 0o600);
    let output = import(folder.path(), &["--namespace", &namespace]);
    let (manifests, notes) = texts(&output);
    assert!(output.status.success(), "{notes}");
    assert!(!manifests.contains(TOKEN) && !notes.contains(TOKEN));
    assert!(
        notes.contains("not taken over: leaderboard-20: certificate_authority"),
        "{notes}"
    );
    let file = folder.path().join("challenge.yaml");
    std::fs::write(&file, manifests).unwrap();
    let objects = dry_run(&file).await;
    assert_eq!(objects.len(), 4, "{objects:?}");
    assert_eq!(objects[3], "leaderboard.leaderboard.carla.org/leaderboard-20");
}

/// The lines with which a page has its reader lay decisions over the manifests, from one that begins with `first`.
fn decisions_of(page: &str) -> String {
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs").join(page);
    let page = std::fs::read_to_string(page).unwrap();
    let (_, rest) = page.split_once("\ncat > kustomization.yaml <<END\n").unwrap();
    let (file, _) = rest.split_once("\nkubectl apply").unwrap();
    format!("cat > kustomization.yaml <<END\n{file}\n")
}

#[tokio::test]
async fn the_api_server_accepts_the_manifests_with_the_decisions_of_the_documents() {
    let namespace = server().await.namespace("decisions").await;
    let mut given = entries();
    // The page's reader leaves the token out.
    given.insert("evalai", json!({"api_server": "https://eval.ai"}));
    for page in ["import.md", "migrate.md"] {
        let folder = folder(&answers(&given), 0o644);
        let (manifests, notes) = texts(&import(folder.path(), &["--namespace", &namespace]));
        assert!(!manifests.is_empty(), "{notes}");
        std::fs::write(folder.path().join("challenge.yaml"), manifests).unwrap();
        let kubectl = server().await.kubectl();
        let path = Path::new(kubectl.get_program()).parent().unwrap().to_owned();
        let shell = Command::new("bash")
            .args([
                "-euc",
                &format!("aws() {{ echo https://sqs.example/1/dead; }}\n{}", decisions_of(page)),
            ])
            .env("PATH", format!("{}:{}", path.display(), std::env::var("PATH").unwrap()))
            .env("s3", "https://bucket.example")
            .env("egress", "        - {cidr: 192.168.255.5/32, ports: [443]}")
            .current_dir(folder.path())
            .output()
            .unwrap();
        assert!(shell.status.success(), "{page}: {}", texts(&shell).1);
        let file = folder.path().join("leaderboards.yaml");
        assert_eq!(dry_run(&file).await.len(), 4, "{page}");
        let text = std::fs::read_to_string(file).unwrap();
        assert!(
            text.contains("enforcement: Require") && !text.contains(": null"),
            "{page}: {text}"
        );
    }
}
