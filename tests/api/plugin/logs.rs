//! `logs` once the Pod is gone: with the person's program `aws`, and without it.

use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;

use serde_json::{Value, json};

use super::terminal::{Printed, Terminal, assert_has, ended, finished};

/// A finished submission `mine` of two pairs.
async fn stored() -> Terminal {
    stored_at(&json!({"bucket": "results", "region": "eu-west-1"})).await
}

async fn stored_at(storage: &Value) -> Terminal {
    let terminal = Terminal::new().await;
    let plan = json!({"runId": "mine",
        "carla": {"version": "V2", "codename": "S", "slices": [{"first": 0, "last": 0}, {"first": 1, "last": 1}],
            "routes": 2, "repetitions": 1, "contentsImage": "c", "simulatorImage": "s"},
        "track": "sensors",
                      "storage": {"s3": storage}, "image": "a"});
    let mut status = finished();
    status["plan"] = plan;
    terminal.submission("mine", &json!({}), &status).await;
    terminal
}

async fn with_path(terminal: &Terminal, path: &Path, arguments: &[&str]) -> Printed {
    Printed::of(&ended(terminal.command(arguments).env("PATH", path)).await)
}

#[tokio::test]
async fn without_the_program_its_commands_are_printed() {
    let terminal = stored().await;
    let nowhere = tempfile::tempdir().unwrap();
    let text = with_path(&terminal, nowhere.path(), &["logs", "mine", "--worker", "2"])
        .await
        .well();
    assert_has(
        &text,
        &["aws s3 cp s3://results/42/agent/agent2/leaderboard.log - --region eu-west-1"],
    );
    assert!(!text.contains("agent1"), "{text}");
    let text = terminal.run(&["logs", "mine", "--worker", "3"]).await.refused();
    assert_has(&text, &["mine has no worker 3"]);
}

#[tokio::test]
async fn the_program_reads_each_log_and_one_that_cannot_be_read_does_not_hold_up_the_others() {
    let terminal = stored().await;
    let folder = tempfile::tempdir().unwrap();
    let program = folder.path().join("aws");
    let script = "#!/bin/sh\ncase \"$*\" in *agent2*) echo 'fatal error: (403) Forbidden' >&2; exit 1;; esac\n\
                  echo \"$*\"; printf 'a \\033[2J b\\nlast'\n";
    std::fs::write(&program, script).unwrap();
    std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).unwrap();
    let printed = with_path(&terminal, folder.path(), &["logs", "mine"]).await;
    assert_eq!(printed.code, Some(1), "{printed:?}");
    assert_eq!(
        printed.out,
        "[1] s3 cp --only-show-errors --region=eu-west-1 s3://results/42/agent/agent1/leaderboard.log -\n\
         [1] a \u{fffd}[2J b\n[1] last\n"
    );
    assert_has(
        &printed.err,
        &[
            "cannot read s3://results/42/agent/agent2/leaderboard.log: fatal error: (403) Forbidden.",
            "your AWS credentials may read the bucket",
        ],
    );
    let text = with_path(
        &terminal,
        folder.path(),
        &["logs", "mine", "-f", "--worker", "1", "--color", "always"],
    )
    .await;
    assert!(
        text.out.starts_with("\u{1b}[33m[1]\u{1b}[0m s3 cp "),
        "a pair has its colour, also alone"
    );
}

/// A program `aws` that prints what it was called with.
fn echoing(folder: &Path) {
    let program = folder.join("aws");
    std::fs::write(&program, "#!/bin/sh\necho \"$*\"\n").unwrap();
    std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).unwrap();
}

#[tokio::test]
async fn a_server_that_is_not_awss_gets_a_persons_credentials_only_by_a_flag_that_names_it() {
    const ENDPOINT: &str = "https://minio.example";
    let terminal = stored_at(&json!({"bucket": "results", "endpoint": ENDPOINT})).await;
    let folder = tempfile::tempdir().unwrap();
    echoing(folder.path());
    let call = "s3 cp --only-show-errors --endpoint-url=https://minio.example";
    for arguments in [
        &["logs", "mine", "--worker", "1"][..],
        &["logs", "mine", "--worker", "1", "--endpoint=https://other.example"],
    ] {
        let printed = with_path(&terminal, folder.path(), arguments).await;
        assert!(!printed.out.contains(call), "{printed:?}");
        assert_has(&printed.refused(), &[ENDPOINT, "add --endpoint=https://minio.example"]);
    }
    let trusted = ["logs", "mine", "--worker", "1", "--endpoint=https://minio.example"];
    let printed = with_path(&terminal, folder.path(), &trusted).await;
    assert_eq!(printed.code, Some(0), "{printed:?}");
    assert_has(&printed.out, &[call]);
}
