//! `get` with a program `aws` that answers as the bucket would: what is listed, what is copied, and what is refused.

use std::fs::Permissions;
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;
use std::process::{Command, Stdio};

use crate::stub::Stub;
use crate::stub::cluster::cluster;

/// Lists `$LISTED`, and copies by making one file. It keeps what it was called with.
const AWS: &str = r#"#!/bin/sh
echo "$*" >> "$CALLS"
case "$1" in
  s3api) printf '%s' "$LISTED" ;;
  s3) for last; do :; done; /bin/mkdir -p "$last/agent" && echo text > "$last/agent/a.log" ;;
esac
"#;
const LISTED: &str = r#"[["v2/42/agent/a.log", 2048, "2026-11-01T10:00:00+00:00"], ["v2/42/results.json", 12, "2026-11-01T10:00:00Z"],
  ["v2/42/empty/", 0, "2026-11-01T10:00:00Z"]]"#;

struct Bucket {
    folder: tempfile::TempDir,
    stub: Stub,
}

impl Bucket {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let program = folder.path().join("aws");
        std::fs::write(&program, AWS).unwrap();
        std::fs::set_permissions(&program, Permissions::from_mode(0o755)).unwrap();
        Self {
            folder,
            stub: Stub::start(cluster),
        }
    }

    /// Exit code and output, with the errors in it.
    fn get(&self, listed: &str, arguments: &[&str]) -> (i32, String) {
        let output = Command::new(env!("CARGO_BIN_EXE_kubectl-leaderboard"))
            .arg("get")
            .args(arguments)
            .env("KUBECONFIG", &self.stub.kubeconfig)
            .env("PATH", self.folder.path())
            .env("CALLS", self.folder.path().join("calls"))
            .env("LISTED", listed)
            .current_dir(self.folder.path())
            .stdin(Stdio::null())
            .output()
            .unwrap();
        let text = [output.stdout, output.stderr].concat();
        (output.status.code().unwrap(), String::from_utf8(text).unwrap())
    }

    fn calls(&self) -> String {
        std::fs::read_to_string(self.folder.path().join("calls")).unwrap_or_default()
    }
}

#[test]
fn all_that_is_stored_is_listed_and_copied_into_a_new_folder() {
    let bucket = Bucket::new();
    let (code, text) = bucket.get(LISTED, &["submission-42"]);
    assert_eq!(code, 0, "{text}");
    assert!(
        text.contains("2Ki") && text.contains("agent/a.log") && text.contains("2 objects (2Ki)"),
        "{text}"
    );
    let (code, text) = bucket.get(LISTED, &["submission-42", "--download", "--x/y"]);
    assert_eq!(code, 2, "a flag is no folder: {text}");
    let (code, text) = bucket.get(LISTED, &["submission-42", "--download=--x"]);
    assert_eq!(code, 0, "{text}");
    assert!(bucket.folder.path().join("--x/agent/a.log").exists(), "{text}");
    let calls = bucket.calls();
    assert!(calls.contains("--bucket=results --prefix=v2/42/\n"), "{calls}");
    assert!(
        calls.contains("s3 cp --recursive --only-show-errors s3://results/v2/42/ ./--x"),
        "{calls}"
    );
}

#[test]
fn no_file_is_overwritten_and_no_name_leaves_the_folder() {
    let bucket = Bucket::new();
    std::fs::write(bucket.folder.path().join("mine"), "kept").unwrap();
    let (code, text) = bucket.get(LISTED, &["submission-42", "--download", "."]);
    assert!(
        code == 1 && text.contains(". is not empty, and no file is overwritten"),
        "{text}"
    );
    let (code, text) = bucket.get(LISTED, &["submission-42", "--download", "mine"]);
    assert!(code == 1 && text.contains("cannot write to mine"), "{text}");
    for key in ["../x", "a/../../x", "/etc/x", "a//x", "a\\\\x", "C:x", "a\\u0007"] {
        let listed = format!(r#"[["v2/42/{key}", 1, "2026-11-01T10:00:00Z"]]"#);
        let (code, text) = bucket.get(&listed, &["submission-42", "--download", "new"]);
        assert!(code == 1 && text.contains("Nothing was copied"), "{key}: {text}");
    }
    assert!(!bucket.calls().contains("s3 cp"), "{}", bucket.calls());
    assert!(!Path::new(&bucket.folder.path().join("new")).exists());
}

#[test]
fn a_run_without_results_and_an_empty_bucket_are_named() {
    let bucket = Bucket::new();
    let (code, text) = bucket.get(LISTED, &["submission-45"]);
    assert!(
        code == 1 && text.contains("submission-45 is Pending and has stored nothing yet"),
        "{text}"
    );
    let (code, text) = bucket.get("null", &["submission-42"]);
    assert!(code == 0 && text.contains("retention has deleted it"), "{text}");
    let (code, text) = bucket.get("An error", &["submission-42"]);
    assert!(code == 1 && text.contains("aws printed something else"), "{text}");
}
