//! The bucket, read with the person's own `aws` program and credentials: the plugin has no client of S3.
//!
//! Called by `get`, and by `logs` once the Pod is gone. A person without the program gets its commands.

use std::process::Stdio;

use leaderboard_api::S3Bucket;
use tokio::io::AsyncReadExt as _;
use tokio::process::Command;

use crate::error::complaint;
use crate::lines::{Lines, PIECE};
use crate::text::clean;

/// Bytes of the program's errors that are read.
const LONGEST_ERROR: u64 = 64 * 1024;

/// Why the bucket was not read.
#[derive(thiserror::Error, Debug, PartialEq, Eq)]
pub enum Unread {
    /// There is no program `aws`.
    #[error("the program aws is not on the PATH")]
    NoProgram,
    /// It has failed, and why.
    #[error("{0}")]
    Failed(String),
}

/// The flags that name the place of a bucket, with their values.
pub fn place(storage: Option<&S3Bucket>) -> impl Iterator<Item = (&'static str, &String)> {
    let places = [
        ("--region", storage.and_then(|storage| storage.region.as_ref())),
        ("--endpoint-url", storage.and_then(|storage| storage.endpoint.as_ref())),
    ];
    places.into_iter().filter_map(|(flag, value)| Some((flag, value?)))
}

/// Arguments of the program that name the place. No value is taken for a flag.
pub fn flags(storage: Option<&S3Bucket>) -> impl Iterator<Item = String> {
    place(storage).map(|(flag, value)| format!("{flag}={value}"))
}

/// Arguments of `aws` for the copy of one object, with only errors printed.
pub fn copy(from: &str, to: &str, storage: Option<&S3Bucket>) -> Vec<String> {
    let mut arguments = ["s3", "cp", "--only-show-errors"].map(str::to_owned).to_vec();
    arguments.extend(flags(storage));
    arguments.extend([from.to_owned(), to.to_owned()]);
    arguments
}

/// Hands each line of an object to `show`.
pub async fn read(object: &str, storage: Option<&S3Bucket>, show: impl FnMut(&str)) -> Result<(), Unread> {
    is_address(object)?;
    run(&copy(object, "-", storage), show).await
}

/// Refuses what is no address in a bucket. An imported address is a text of a table's row: it must not become a flag, nor name a file of
/// this machine.
pub fn is_address(object: &str) -> Result<(), Unread> {
    if object.starts_with("s3://") {
        return Ok(());
    }
    Err(Unread::Failed(format!("{} is no address in a bucket", clean(object))))
}

/// Runs `aws`, and hands each line that it prints to `show`.
pub async fn run(arguments: &[String], mut show: impl FnMut(&str)) -> Result<(), Unread> {
    let mut child = match Command::new("aws")
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .kill_on_drop(true)
        .spawn()
    {
        Ok(child) => child,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Err(Unread::NoProgram),
        Err(error) => return Err(Unread::Failed(format!("aws cannot be run: {error}"))),
    };
    let failed = |error: std::io::Error| Unread::Failed(format!("aws was interrupted: {error}"));
    let (out, errors) = (child.stdout.take(), child.stderr.take());
    let lines = async {
        let Some(mut out) = out else { return Ok(()) };
        let (mut lines, mut piece) = (Lines::default(), vec![0; PIECE]);
        loop {
            let read = out.read(&mut piece).await.map_err(failed)?;
            for line in &lines.take(piece.get(..read).unwrap_or_default()) {
                show(line);
            }
            if read == 0 {
                return Ok(());
            }
        }
    };
    let printed = async {
        let mut text = Vec::new();
        if let Some(errors) = errors {
            // An unreadable complaint is left out: the exit status shows the failure.
            let _ = errors.take(LONGEST_ERROR).read_to_end(&mut text).await;
        }
        text
    };
    let (shown, printed) = tokio::join!(lines, printed);
    shown?;
    let status = child.wait().await.map_err(failed)?;
    if status.success() {
        return Ok(());
    }
    Err(Unread::Failed(complaint(&printed, status)))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn the_place_of_the_bucket_is_handed_on_and_no_part_of_an_address_is_a_flag() {
        let storage = json!({"bucket": "b", "region": "eu-west-1", "endpoint": "https://s3.example"});
        let storage: S3Bucket = serde_json::from_value(storage).unwrap();
        assert_eq!(
            copy("s3://b/1/a.log", "-", Some(&storage)),
            [
                "s3",
                "cp",
                "--only-show-errors",
                "--region=eu-west-1",
                "--endpoint-url=https://s3.example",
                "s3://b/1/a.log",
                "-"
            ]
        );
    }

    #[tokio::test]
    async fn what_is_no_address_in_a_bucket_is_not_read() {
        for object in ["/etc/passwd", "--endpoint-url=https://x", "https://s3/b"] {
            let why = read(object, None, |_| unreachable!()).await.unwrap_err();
            assert_eq!(why, Unread::Failed(format!("{object} is no address in a bucket")));
        }
    }
}
