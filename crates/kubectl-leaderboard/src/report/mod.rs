//! `report`: what a person who helps needs of a namespace, in one file, without secrets, logs and names of teams.
//!
//! `redact`, which is pure, takes out secrets, routes and names of teams.

mod redact;

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Args;
use leaderboard_api::text::sentence;
use serde_json::{Value, json};

use crate::cluster::{Cluster, Scope};
use crate::commands::frame;
use crate::error::Error;
use crate::output::{self, Format, print};
use crate::text::{Frame, counted};

/// Where the report goes.
#[derive(Args, Debug)]
pub struct Report {
    /// File to write [default: leaderboard-report-NAMESPACE.json].
    #[arg(long, value_name = "FILE")]
    file: Option<PathBuf>,
}

/// A part of the report: its name, what it counts, and the objects.
type Part = (&'static str, &'static str, Result<Vec<Value>, Error>);

/// Writes the report.
pub async fn report(cluster: &Cluster, wanted: &Report) -> Result<ExitCode, Error> {
    let now = frame().now;
    let parts = ask(cluster).await;
    let [_, (.., submissions), ..] = &parts;
    let names = submissions.as_deref().map(redact::names).unwrap_or_default();
    let about = format!(
        "kubectl leaderboard {} of namespace {} at {now:.0}",
        env!("CARGO_PKG_VERSION"),
        cluster.namespace
    );
    let mut document = json!({ "about": about });
    let (mut missing, mut counts) = (Vec::new(), Vec::new());
    for (part, one, objects) in parts {
        match objects {
            Ok(objects) => {
                counts.push(counted(objects.len(), one));
                document[part] = redact::objects(part, objects, &names);
            }
            // Without credentials or an API server every other part would be empty too.
            Err(error @ (Error::Credentials(_) | Error::Unreachable { .. })) => return Err(error),
            // Without a right to one kind, the others help all the same.
            Err(error) => missing.push(format!("{part}: {error}")),
        }
    }
    document["missing"] = json!(missing);
    let default = || PathBuf::from(format!("leaderboard-report-{}.json", cluster.namespace));
    let file = wanted.file.clone().unwrap_or_else(default);
    // The document escapes control characters, so that a participant's text cannot command the reader's terminal.
    let text = output::document(Format::Json, &document).unwrap_or_default().concat();
    let path = file.display().to_string();
    std::fs::write(&file, text + "\n").map_err(|error| Error::File(path.clone(), error))?;
    print(&lines(&path, &cluster.namespace, &counts, &missing, frame()));
    Ok(ExitCode::SUCCESS)
}

async fn ask(cluster: &Cluster) -> [Part; 4] {
    let scope = Scope::default();
    let unread = || Error::Forbidden("Leaderboards cannot be listed".to_owned());
    let leaderboards = cluster.leaderboards(&scope).await;
    let leaderboards = leaderboards.and_then(|all| all.ok_or_else(unread));
    [
        ("leaderboards", "Leaderboard", documents(leaderboards)),
        (
            "submissions",
            "submission",
            documents(cluster.submissions(&scope).await),
        ),
        ("pods", "Pod", documents(cluster.pods().await)),
        ("events", "event", documents(cluster.events().await)),
    ]
}

/// Lines about the file, the parts that are missing, and the check before it is handed on.
pub(super) fn lines(file: &str, namespace: &str, counts: &[String], missing: &[String], frame: Frame) -> Vec<String> {
    let mut page = frame.page();
    page.paragraph(&format!(
        "Wrote {file}, of namespace {namespace}: {}.",
        counts.join(", ")
    ));
    for why in missing {
        page.paragraph(&format!("Without {}", sentence(why)));
    }
    if counts.iter().all(|count| count.starts_with("0 ")) {
        page.paragraph("Nothing was found: use -n for the namespace of the Leaderboard.");
    }
    page.paragraph(
        "Left out: Secrets, values of environment variables, podOverrides, names of teams, texts that quote results, and logs.",
    );
    page.paragraph("Look through it before you hand it on: images, buckets and addresses are in it.");
    page.into_lines()
}

fn documents<K: serde::Serialize>(objects: Result<Vec<K>, Error>) -> Result<Vec<Value>, Error> {
    let objects = objects?.into_iter().map(serde_json::to_value);
    objects
        .collect::<Result<_, _>>()
        .map_err(|error| Error::Malformed(error.to_string()))
}
