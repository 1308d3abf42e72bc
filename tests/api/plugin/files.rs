//! `submit --file` against a real API server: where the file goes, and that nothing is written for what is refused.

use std::os::unix::fs::PermissionsExt as _;
use std::path::PathBuf;

use kube::ResourceExt;
use kube::api::ListParams;
use leaderboard_contract::keys::INPUT_FILE;
use serde_json::{Value, json};

use super::terminal::{Printed, Terminal, assert_has, ended};
use crate::api::objects::{Kind, merge};

/// Digest of the file `predictions.csv`.
const DIGEST: &str = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
/// A program that keeps what it was called with, and refuses a bucket of this name.
const AWS: &str = "#!/bin/sh\necho \"$*\" >> \"$CALLS\"\n\
                   case \"$*\" in *s3://closed/*) echo 'fatal error: (403) Forbidden' >&2; exit 1;; esac\n";

/// A person with a file, a program `aws`, and a Leaderboard `local` of files.
struct Person {
    terminal: Terminal,
    folder: tempfile::TempDir,
}

impl Person {
    async fn new(storage: &Value) -> Self {
        let (terminal, folder) = (Terminal::new().await, tempfile::tempdir().unwrap());
        let container =
            json!({"mode": "Predictions", "image": "evaluator:1", "command": ["evaluate"], "input": {"maxBytes": "8"}});
        let mut spec = json!({
            "tracks": [{"name": "test", "container": {"score": {"metric": "accuracy"}}}],
            "evaluation": {"carla": null, "container": container},
        });
        merge(&mut spec, &json!({"storage": {"s3": storage}}));
        terminal.leaderboard(&spec).await;
        let program = folder.path().join("aws");
        std::fs::write(&program, AWS).unwrap();
        std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).unwrap();
        std::fs::write(folder.path().join("predictions.csv"), "abc").unwrap();
        std::fs::write(folder.path().join("large.csv"), "123456789").unwrap();
        Self { terminal, folder }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    async fn submits(&self, file: &str, more: &[&str]) -> Printed {
        let usual = ["submit", "--leaderboard", "local", "--track", "test", "--file", file];
        let mut command = self.terminal.command(&[&usual[..], more].concat());
        command
            .env("PATH", self.folder.path())
            .env("CALLS", self.path("calls"))
            .current_dir(self.folder.path());
        Printed::of(&ended(&mut command).await)
    }

    fn calls(&self) -> String {
        std::fs::read_to_string(self.path("calls")).unwrap_or_default()
    }

    async fn names(&self) -> Vec<String> {
        let api = self.terminal.api(Kind::Submission);
        let all = api.list(&ListParams::default()).await.unwrap();
        all.iter().map(ResourceExt::name_any).collect()
    }
}

#[tokio::test]
async fn a_file_goes_where_the_pods_read_it_and_then_its_submission_is_created() {
    let key = "arn:aws:kms:eu-west-1:123456789012:key/1";
    let storage = json!({"bucket": "results", "prefix": "v1/", "region": "eu-west-1", "kmsKeyARN": key});
    let person = Person::new(&storage).await;
    let text = person.submits("predictions.csv", &[]).await.well();
    let names = person.names().await;
    let [name] = names.as_slice() else { panic!("{names:?}") };
    assert!(name.starts_with("local-"), "{name}");
    let address = format!("s3://results/v1/{name}/{INPUT_FILE}");
    assert_has(&text, &[&address, &format!("Submitted {name} to track test")]);
    let place = "--only-show-errors --region=eu-west-1 ./predictions.csv";
    assert_eq!(
        person.calls(),
        format!("s3 cp --sse=aws:kms --sse-kms-key-id={key} {place} {address}\n")
    );
    let made = person.terminal.api(Kind::Submission).get(name).await.unwrap();
    assert_eq!(made.data["spec"]["input"], json!({"sha256": DIGEST, "size": 3}));
    assert!(made.data["spec"].get("image").is_none());
}

#[tokio::test]
async fn what_is_refused_writes_nothing_into_the_bucket() {
    let person = Person::new(&json!({"bucket": "results"})).await;
    person.submits("predictions.csv", &["--name", "mine"]).await.well();
    let before = person.calls();
    assert_eq!(before.lines().count(), 1, "{before}");
    for (file, more, expected) in [
        ("predictions.csv", &["--name", "mine"][..], "already exists"),
        ("predictions.csv", &["--name", "a.b"], "may not contain a dot"),
        ("large.csv", &[], "takes at most 8"),
        (".", &[], "is no regular file"),
        ("missing.csv", &[], "cannot read missing.csv"),
    ] {
        let words = person.submits(file, more).await.refused();
        assert!(words.contains(expected), "{words}");
    }
    let usual = ["submit", "--leaderboard", "local", "--track", "test", "--image", "a:1"];
    let words = person.terminal.run(&usual).await.refused();
    assert_has(&words, &["takes files and no images"]);
    let words = person
        .terminal
        .run(&["check", "local", "--image", "a:1"])
        .await
        .refused();
    assert_has(&words, &["kubectl leaderboard submit --file"]);
    assert_eq!(
        (person.calls(), person.names().await),
        (before, vec!["mine".to_owned()])
    );
}

#[tokio::test]
async fn without_the_file_in_the_bucket_there_is_no_submission() {
    let person = Person::new(&json!({"bucket": "closed"})).await;
    let printed = person.submits("predictions.csv", &["--name", "mine"]).await;
    let expected = format!("cannot write s3://closed/mine/{INPUT_FILE}: fatal error: (403) Forbidden.");
    assert_has(&printed.err, &[&expected, "your AWS credentials may write"]);
    std::fs::remove_file(person.path("aws")).unwrap();
    let without = person.submits("predictions.csv", &["--name", "mine"]).await;
    assert_has(&without.err, &["the program aws is not on the PATH"]);
    assert_eq!((printed.code, without.code), (Some(1), Some(1)));
    assert_eq!(person.names().await, Vec::<String>::new());
}

#[tokio::test]
async fn a_server_that_is_not_awss_gets_a_file_only_by_a_flag_that_names_it() {
    let person = Person::new(&json!({"bucket": "results", "endpoint": "https://minio.example"})).await;
    let words = person.submits("predictions.csv", &[]).await.refused();
    assert_has(&words, &["Leaderboard local", "add --endpoint=https://minio.example"]);
    assert_eq!((person.calls().as_str(), person.names().await.len()), ("", 0));
    person
        .submits("predictions.csv", &["--endpoint=https://minio.example"])
        .await
        .well();
    assert_has(&person.calls(), &["--endpoint-url=https://minio.example"]);
}
