//! `report`: what a person who helps needs of a namespace, in one tar archive, without secrets, routes and names of teams.
//!
//! `redact` takes out what is nobody's business, `tar` writes the archive; both are pure.

mod redact;
mod tar;

use std::path::PathBuf;

use clap::Args;
use jiff::Timestamp;
use serde_json::Value;

use crate::cluster::{Cluster, Scope};
use crate::error::Error;
use crate::output::print;

/// Where the archive goes.
#[derive(Args, Debug)]
pub struct Report {
    /// File to write [default: leaderboard-report-NAMESPACE.tar].
    #[arg(long, value_name = "FILE")]
    file: Option<PathBuf>,
}

/// Writes the archive.
pub async fn report(cluster: &Cluster, wanted: &Report) -> Result<(), Error> {
    let scope = Scope::default();
    let now = Timestamp::now();
    let (mut files, mut missing) = (Vec::new(), Vec::new());
    let leaderboards = cluster.leaderboards(&scope).await.map(Option::unwrap_or_default);
    let pods = cluster.pods().await;
    let events = cluster.events().await;
    let parts = [
        ("leaderboards.json", documents(leaderboards)),
        ("submissions.json", documents(cluster.submissions(&scope).await)),
        ("pods.json", documents(pods)),
        ("events.json", documents(events)),
    ];
    for (name, part) in parts {
        match part {
            Ok(objects) => files.push((name.to_owned(), format!("{:#}\n", redact::objects(name, objects)))),
            // Without a right to one kind, the others help all the same.
            Err(error) => missing.push(format!("{name}: {error}")),
        }
    }
    let about = format!(
        "kubectl leaderboard {} of namespace {} at {now:.0}\n{}\n",
        env!("CARGO_PKG_VERSION"),
        cluster.namespace,
        missing.join("\n")
    );
    files.push(("about.txt".to_owned(), about));
    let default = || PathBuf::from(format!("leaderboard-report-{}.tar", cluster.namespace));
    let file = wanted.file.clone().unwrap_or_else(default);
    let archive = tar::archive(&files, now.as_second());
    std::fs::write(&file, archive).map_err(|error| Error::File(file.display().to_string(), error))?;
    print(&[
        format!("Wrote {}. Look through it before you hand it on.", file.display()),
        "Left out: Secrets, values of environment variables, names of teams, texts of results, logs.".to_owned(),
    ]);
    print(&missing.iter().map(|why| format!("Missing: {why}")).collect::<Vec<_>>());
    Ok(())
}

fn documents<K: serde::Serialize>(objects: Result<Vec<K>, Error>) -> Result<Vec<Value>, Error> {
    let objects = objects?.into_iter().map(serde_json::to_value);
    objects
        .collect::<Result<_, _>>()
        .map_err(|error| Error::Malformed(error.to_string()))
}
