//! `import`: the entries of the original pipeline become manifests, text to text. It asks neither AWS nor a cluster.
//!
//! `entries` parses, `manifests` writes: both pure. Standard output is YAML alone; what is not taken over is a comment of it, and on
//! standard error.

mod entries;
mod manifests;
#[cfg(test)]
mod samples_tests;

use std::fs::File;
use std::io::{self, Read as _};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Args;
use leaderboard_api::DOCUMENTS;

use self::entries::Entries;
use self::manifests::Queue;
use crate::error::Error;
use crate::output::{note, print};

/// The namespace that the roles of examples/aws trust.
const NAMESPACE: &str = "leaderboard";

/// Arguments of `import`.
#[derive(Args, Debug)]
pub struct Import {
    /// Files with what `aws secretsmanager get-secret-value --output json` prints of the entries, one or more in each; `-` is standard
    /// input. A file that holds EvalAI's token must have the mode 0600.
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// Id of the challenge in EvalAI, as in the address of its page. No entry holds it.
    #[arg(long, value_name = "ID", value_parser = clap::value_parser!(i64).range(1..))]
    challenge: i64,
    /// URL of the SQS queue that EvalAI writes to.
    #[arg(long, value_name = "URL")]
    queue: Queue,
}

/// Prints the manifests, for a namespace.
pub fn import(wanted: &Import, namespace: Option<&str>) -> Result<ExitCode, Error> {
    let mut entries = Entries::new();
    for path in &wanted.files {
        entries.extend(read(path)?);
    }
    let pipeline = entries::parse(&entries).map_err(|problems| Error::Unfit(problems.join("; ")))?;
    let yaml = manifests::yaml(&pipeline, wanted, namespace.unwrap_or(NAMESPACE));
    for line in &pipeline.dropped {
        note(&format!("not taken over: {line}"));
    }
    let open = yaml.matches("# To decide: ").count();
    note(&format!("{open} comments begin with \"To decide\": go through them"));
    print(&[yaml.trim_end().to_owned()]);
    Ok(ExitCode::SUCCESS)
}

/// The entries of a file.
fn read(path: &Path) -> Result<Entries, Error> {
    let shown = path.display();
    let (text, is_open) = text_of(path).map_err(|error| Error::Unread(shown.to_string(), error))?;
    let entries = entries::answers(&text).map_err(|line| {
        Error::Unfit(format!(
            "{shown}, line {line}: this is no answer of `aws secretsmanager get-secret-value --output json`. Print the entry again"
        ))
    })?;
    if is_open && entries.values().any(entries::Entry::has_token) {
        return Err(Error::Unfit(format!(
            "{shown} holds EvalAI's token, and others may read it. Run `chmod 600 {shown}`, or leave the token out: {DOCUMENTS}import.md"
        )));
    }
    Ok(entries)
}

/// The text of a file, and whether others than its owner may read or change the file.
pub(crate) fn text_of(path: &Path) -> io::Result<(String, bool)> {
    let mut text = String::new();
    if path == Path::new("-") {
        io::stdin().read_to_string(&mut text)?;
        return Ok((text, false));
    }
    let mut file = File::open(path)?;
    file.read_to_string(&mut text)?;
    Ok((text, is_open(&file.metadata()?)))
}

#[cfg(unix)]
fn is_open(file: &std::fs::Metadata) -> bool {
    use std::os::unix::fs::PermissionsExt as _;
    file.permissions().mode() & 0o077 != 0
}

/// Windows has no such mode: a file is as private as its folder.
#[cfg(not(unix))]
fn is_open(_: &std::fs::Metadata) -> bool {
    false
}
