//! `get`: what a submission has stored, listed, or copied into a folder. The person's own `aws` program reads the bucket.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Args;
use jiff::Timestamp;
use kube::ResourceExt;
use leaderboard_api::{S3Bucket, Submission};
use serde::Deserialize;

use crate::aws::{self, Unread};
use crate::cluster::Cluster;
use crate::commands::frame;
use crate::error::{Error, of_bucket};
use crate::output::{ask, print};
use crate::table::table;
use crate::text::{Frame, age, clean, counted, size, wrap};
use crate::{bucket, facts, foreign};

/// Arguments of `get`: the submission, and the folder for its files.
#[derive(Args, Debug)]
pub struct Get {
    /// Name of the submission.
    name: String,
    /// Copy all of it into this folder, which is new or empty.
    #[arg(long, value_name = "DIR")]
    download: Option<PathBuf>,
    /// Endpoint of the bucket, if it is not AWS's, that may get your AWS credentials.
    #[arg(long, value_name = "URL")]
    endpoint: Option<String>,
}

/// An object below the run's prefix.
#[derive(Deserialize, Debug, PartialEq)]
pub(super) struct Stored(pub(super) String, pub(super) u64, pub(super) Timestamp);

/// Lists or copies the objects.
pub async fn get(cluster: &Cluster, wanted: &Get) -> Result<ExitCode, Error> {
    let submission = cluster.submission(&wanted.name).await?;
    let Some(results) = facts::status(&submission).results_url.as_deref() else {
        return Err(Error::Unfit(format!(
            "{} is {} and has stored nothing yet. See `{}`",
            wanted.name,
            facts::shown(&submission),
            facts::command("why", &submission)
        )));
    };
    let storage = facts::storage(&submission);
    if let Some(folder) = &wanted.download {
        is_free(folder).map_err(Error::Unfit)?;
    }
    foreign::confirm(&wanted.name, storage, wanted.endpoint.as_deref(), ask)?;
    let stored = match list(results, storage).await {
        Ok(stored) => stored,
        Err(Unread::NoProgram) => {
            let command = bucket::folder(results, wanted.download.as_deref(), storage);
            let text = "With the program aws on the PATH, this command reads the bucket. Without it:";
            print(&[wrap(text, frame().width), vec![command]].concat());
            return Ok(ExitCode::FAILURE);
        }
        Err(Unread::Failed(why)) => return Err(of_bucket(results, &why)),
    };
    if let Some(folder) = &wanted.download {
        return download(&submission, results, storage, &stored, folder).await;
    }
    print(&lines(&submission, &stored, frame()));
    Ok(ExitCode::SUCCESS)
}

/// Copies all objects into a folder, unless one has a name that leads out of it.
async fn download(
    submission: &Submission,
    results: &str,
    storage: Option<&S3Bucket>,
    stored: &[Stored],
    folder: &Path,
) -> Result<ExitCode, Error> {
    if let Some(Stored(key, ..)) = stored.iter().find(|one| !stays_within(&one.0)) {
        return Err(Error::Unfit(format!(
            "{} has stored {key:?}, which would lie outside of {}. Nothing was copied; copy single objects with `aws s3 cp`",
            submission.name_any(),
            folder.display()
        )));
    }
    let text = format!("Copying {} of {results} to {}.", sum(stored), folder.display());
    print(&wrap(&text, frame().width));
    // A folder that begins like a flag or like an address is a folder all the same.
    let place = Path::new(".").join(folder).display().to_string();
    let mut arguments = aws::copy(&format!("{results}/"), &place, storage);
    arguments.insert(2, "--recursive".to_owned());
    let copied = aws::run(&arguments, |_| {}).await;
    copied.map_err(|why| of_bucket(results, &why.to_string()))?;
    print(&done(submission, frame()));
    Ok(ExitCode::SUCCESS)
}

/// Refuses a folder that has files, so that nothing is overwritten.
fn is_free(folder: &Path) -> Result<(), String> {
    let shown = folder.display();
    match std::fs::read_dir(folder).map(|mut entries| entries.next().is_none()) {
        Ok(true) => Ok(()),
        Ok(false) => Err(format!(
            "{shown} is not empty, and no file is overwritten. Name a new folder"
        )),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(()),
        Err(error) => Err(format!("cannot write to {shown}: {error}. Name a new folder")),
    }
}

/// All objects of a run. A prefix without its slash would have those of other runs too.
async fn list(results: &str, storage: Option<&S3Bucket>) -> Result<Vec<Stored>, Unread> {
    aws::is_address(results)?;
    let (bucket, prefix) = results.trim_start_matches("s3://").split_once('/').unwrap_or_default();
    let prefix = format!("{prefix}/");
    let mut arguments = [
        "s3api",
        "list-objects-v2",
        "--output=json",
        "--query=Contents[].[Key,Size,LastModified]",
    ]
    .map(str::to_owned)
    .to_vec();
    arguments.extend(aws::flags(storage));
    arguments.extend([format!("--bucket={bucket}"), format!("--prefix={prefix}")]);
    let mut text = String::new();
    aws::run(&arguments, |line| text.push_str(line)).await?;
    let all: Option<Vec<Stored>> = serde_json::from_str(if text.trim().is_empty() { "null" } else { &text })
        .map_err(|error| Unread::Failed(format!("aws printed something else than a list: {error}")))?;
    let below = |Stored(key, size, time): Stored| Some(Stored(key.strip_prefix(&prefix)?.to_owned(), size, time));
    let mut stored: Vec<Stored> = all.unwrap_or_default().into_iter().filter_map(below).collect();
    // Some programs keep an empty object for a folder.
    stored.retain(|Stored(key, ..)| !key.is_empty() && !key.ends_with('/'));
    stored.sort_by(|one, other| one.0.cmp(&other.0));
    Ok(stored)
}

/// True if a key is a path that stays below any folder, on each system.
pub(super) fn stays_within(key: &str) -> bool {
    let is_plain = |part: &str| !part.is_empty() && part != "." && part != "..";
    let is_safe = |c: char| !c.is_control() && c != '\\' && c != ':';
    key.split('/').all(is_plain) && key.chars().all(is_safe)
}

fn sum(stored: &[Stored]) -> String {
    let bytes = stored.iter().map(|one| one.1).sum();
    format!("{} ({})", counted(stored.len(), "object"), size(bytes))
}

/// The objects with their sizes and ages.
pub(super) fn lines(submission: &Submission, stored: &[Stored], frame: Frame) -> Vec<String> {
    if stored.is_empty() {
        let text = format!(
            "{} has stored nothing, or retention has deleted it.",
            submission.name_any()
        );
        return wrap(&text, frame.width);
    }
    let rows = stored
        .iter()
        .map(|Stored(key, bytes, time)| vec![size(*bytes), age(*time, frame.now), clean(key)]);
    let mut lines = table(&["SIZE", "AGE", "NAME"], &rows.collect::<Vec<_>>(), frame.width);
    let next = format!(
        "{}. `{} --download DIR` copies all.",
        sum(stored),
        facts::command("get", submission)
    );
    lines.push(String::new());
    lines.extend(wrap(&next, frame.width));
    lines
}

/// Lines at the end of a copy, with a note if the submission has not ended.
pub(super) fn done(submission: &Submission, frame: Frame) -> Vec<String> {
    let part = if facts::has_ended(submission) {
        String::new()
    } else {
        format!(
            " {} is {}: more may follow.",
            submission.name_any(),
            facts::shown(submission)
        )
    };
    wrap(
        &format!("Done.{part} Logs may reveal private data: show them to hosts only."),
        frame.width,
    )
}
