//! `import` as a person starts it: which files it takes, and what it prints of them.

#![cfg(unix)]
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "clippy knows a test by its attribute; what tests call is a test too"
)]

use std::fs::{File, Permissions};
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use serde_json::{Value, json};

const TOKEN: &str = "local-host-token";

fn answer(name: &str, entry: &Value) -> String {
    let arn = format!("arn:aws:secretsmanager:us-west-2:123456789012:secret:{name}-Ab12Cd");
    format!(
        "{:#}\n",
        json!({"ARN": arn, "Name": name, "SecretString": entry.to_string()})
    )
}

/// The entries of one Leaderboard, with the token.
fn answers() -> String {
    let board = json!({"simulator_image": "r/simulator:1", "leaderboard_image": "r/contents:1", "s3_bucket": "results",
                       "dynamodb_submissions_table": "rows", "logcopy_image": "r/logcopy:1"});
    [
        answer("evalai", &json!({"auth_token": TOKEN, "api_server": "https://eval.ai"})),
        answer("evalai-tracks", &json!({"4172": "leaderboard-20-sensors"})),
        answer("leaderboard-20", &board),
    ]
    .concat()
}

/// A file of this test alone.
fn file(name: &str, text: &str, mode: u32) -> PathBuf {
    let path = std::env::temp_dir().join(format!("leaderboard-import-{}-{name}", std::process::id()));
    std::fs::write(&path, text).unwrap();
    std::fs::set_permissions(&path, Permissions::from_mode(mode)).unwrap();
    path
}

/// The command's exit code, standard output and standard error. Fails if any of them holds the token.
fn import(words: &[&str], input: Stdio) -> (Option<i32>, String, String) {
    let queue = "https://sqs.us-west-2.amazonaws.com/123456789012/leaderboard";
    let mut command = Command::new(env!("CARGO_BIN_EXE_kubectl-leaderboard"));
    // No cluster is asked.
    command.env("KUBECONFIG", "/nonexistent/config").stdin(input);
    let output = command
        .args(["import", "--challenge", "2098", "--queue", queue])
        .args(words);
    let output = output.output().unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    let (out, err) = (text(output.stdout), text(output.stderr));
    assert!(!out.contains(TOKEN) && !err.contains(TOKEN), "{out}{err}");
    (output.status.code(), out, err)
}

fn words(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[test]
fn a_file_with_the_token_must_be_its_owners_alone() {
    for (mode, is_taken) in [
        (0o600, true),
        (0o400, true),
        (0o644, false),
        (0o640, false),
        (0o660, false),
        (0o604, false),
    ] {
        let path = file("mode", &answers(), mode);
        let (code, out, err) = import(&[words(&path)], Stdio::null());
        std::fs::remove_file(&path).unwrap();
        assert_eq!(code == Some(0), is_taken, "{mode:o}: {err}");
        assert_eq!(out.contains("\n  name: leaderboard-20\n"), is_taken, "{mode:o}: {out}");
        let refused = format!(
            "holds EvalAI's token, and others may read it. Run `chmod 600 {}`",
            path.display()
        );
        assert_eq!(err.contains(&refused), !is_taken, "{mode:o}: {err}");
        let dropped = "kubectl leaderboard: not taken over: leaderboard-20: logcopy_image (logcopy is part of the operator's own image)";
        assert_eq!(err.contains(dropped), is_taken, "{mode:o}: {err}");
    }
}

#[test]
fn standard_input_may_hold_the_token_and_a_file_without_it_may_be_anybodys() {
    let whole = file("whole", &answers(), 0o600);
    let (code, from_input, err) = import(&["-"], File::open(&whole).unwrap().into());
    assert_eq!(code, Some(0), "{err}");
    let bare = file("bare", &answers().replace("auth_token", "other"), 0o644);
    let (code, out, err) = import(&[words(&bare)], Stdio::null());
    assert!(
        code == Some(0) && err.contains("not taken over: evalai: other"),
        "{err}"
    );
    let manifests = |text: &str| text.split_once("---\n").unwrap().1.to_owned();
    assert_eq!(manifests(&out), manifests(&from_input));
    for path in [whole, bare] {
        std::fs::remove_file(path).unwrap();
    }
}

#[test]
fn what_cannot_be_used_is_named_without_its_text_and_nothing_is_printed() {
    let odd = file("odd", &format!("{}\n{TOKEN}", answers()), 0o600);
    let half = file("half", &answer("evalai", &json!({"auth_token": TOKEN})), 0o600);
    for (path, wanted) in [
        (
            words(&odd),
            "line 17: this is no answer of `aws secretsmanager get-secret-value --output json`",
        ),
        (
            words(&half),
            "there is no answer for the entry evalai-tracks; print that entry too; the entry evalai lacks api_server",
        ),
        (
            "/nonexistent/entries.json",
            "cannot read /nonexistent/entries.json: No such file or directory",
        ),
    ] {
        let (code, out, err) = import(&[path], Stdio::null());
        assert_eq!((code, out.as_str()), (Some(1), ""), "{err}");
        assert!(err.contains(wanted) && err.lines().count() == 1, "{err}");
    }
    let (code, _, err) = import(&[], Stdio::null());
    assert!(code == Some(2) && err.contains("<FILE>"), "{err}");
    for path in [odd, half] {
        std::fs::remove_file(path).unwrap();
    }
}
