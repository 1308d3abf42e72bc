//! The commands that show something: asks the cluster, and prints what the pure modules make of it.

use std::pin::pin;
use std::process::ExitCode;
use std::time::Duration;

use futures::future::ready;
use futures::{Stream, StreamExt};
use jiff::Timestamp;
use kube::runtime::watcher;
use serde_json::Value;

use crate::cluster::{Cluster, Fetched, Scope};
use crate::error::{self, Error};
use crate::output::{self, Format, Screen, note_once, print};
use crate::text::Frame;
use crate::{Show, Watched, facts, overview, status, top, why};
use leaderboard_api::Submission;
use leaderboard_api::client_errors::watch as watch_error;

/// How often the times on a screen go on.
const TICK: Duration = Duration::from_secs(1);

/// This moment, on this terminal.
#[allow(clippy::disallowed_methods, reason = "the edge of a person's program")]
pub fn frame() -> Frame {
    Frame {
        now: Timestamp::now(),
        width: output::width(),
    }
}

/// `why`.
pub async fn why(cluster: &Cluster, wanted: &Show) -> Result<ExitCode, Error> {
    let format = wanted.output.format;
    let lines = match &wanted.name {
        Some(name) => explained(cluster, name, format).await?,
        None => survey(cluster, &wanted.scope, format).await?,
    };
    print(&lines);
    Ok(ExitCode::SUCCESS)
}

async fn explained(cluster: &Cluster, name: &str, format: Format) -> Result<Vec<String>, Error> {
    let submission = cluster.submission(name).await?;
    let leaderboard = cluster.leaderboard(&submission.spec.leaderboard_name).await?;
    let lines = output::document(format, &why::value(&submission, leaderboard.observed()));
    Ok(lines.unwrap_or_else(|| why::explain(&submission, leaderboard.observed(), frame())))
}

async fn survey(cluster: &Cluster, scope: &Scope, format: Format) -> Result<Vec<String>, Error> {
    let submissions = cluster.submissions(scope).await?;
    let leaderboards = cluster.leaderboards(scope).await?;
    let boards = leaderboards.as_deref();
    let document = output::document(format, &overview::value(&submissions, boards, frame().now));
    Ok(match document {
        Some(lines) => lines,
        None if submissions.is_empty() => nothing(cluster, scope).await,
        None => overview::lines(place(cluster, scope), &submissions, boards, frame()),
    })
}

fn place<'a>(cluster: &'a Cluster, scope: &Scope) -> overview::Place<'a> {
    overview::Place {
        namespace: &cluster.namespace,
        is_all: scope.all_namespaces,
    }
}

/// The message where no submission is found: most often the namespace is another one.
pub async fn nothing(cluster: &Cluster, scope: &Scope) -> Vec<String> {
    let elsewhere = if scope.all_namespaces {
        Vec::new()
    } else {
        cluster.elsewhere().await
    };
    overview::nothing(place(cluster, scope), scope.words().as_deref(), &elsewhere, frame())
}

/// `status`.
pub async fn show_status(cluster: &Cluster, show: &Watched) -> Result<ExitCode, Error> {
    let format = show.format;
    let Some(name) = &show.name else {
        let submissions = cluster.submissions(&show.scope).await?;
        let value = Value::Array(submissions.iter().map(status::value).collect());
        let (is_all, is_wide) = (show.scope.all_namespaces, format == Format::Wide);
        let lines = match output::document(format, &value) {
            Some(lines) => lines,
            None if submissions.is_empty() => nothing(cluster, &show.scope).await,
            None => status::lines(&submissions, is_all, is_wide, frame()),
        };
        print(&lines);
        return Ok(ExitCode::SUCCESS);
    };
    let submission = cluster.submission(name).await?;
    if show.watch {
        follow(cluster, name, |one, board| screen(one, board, format)).await?;
        return Ok(ExitCode::SUCCESS);
    }
    let leaderboard = cluster.leaderboard(&submission.spec.leaderboard_name).await?;
    print(&screen(&submission, &leaderboard, format));
    Ok(ExitCode::SUCCESS)
}

fn screen(submission: &Submission, leaderboard: &Fetched, format: Format) -> Vec<String> {
    let lines = output::document(format, &status::value(submission));
    lines.unwrap_or_else(|| status::screen(submission, leaderboard.observed(), frame()))
}

/// Draws the screen of a submission each time it changes, until it has ended; on a terminal its times go on in between. Returns the two
/// objects as they were at the end.
pub async fn follow(
    cluster: &Cluster,
    name: &str,
    screen: impl Fn(&Submission, &Fetched) -> Vec<String>,
) -> Result<(Submission, Fetched), Error> {
    let mut drawn = Screen::default();
    let mut last: Option<(Submission, Fetched)> = None;
    let mut changes = pin!(changes(cluster, name));
    let mut ticks = tokio::time::interval(TICK);
    loop {
        let submission = tokio::select! {
            biased;
            changed = next(&mut changes) => changed?,
            _ = ticks.tick(), if Screen::is_live() => {
                if let Some((submission, leaderboard)) = &last {
                    drawn.draw(&screen(submission, leaderboard));
                }
                continue;
            }
        };
        let leaderboard = cluster.leaderboard(&submission.spec.leaderboard_name).await?;
        drawn.draw(&screen(&submission, &leaderboard));
        if facts::has_ended(&submission) {
            return Ok((submission, leaderboard));
        }
        last = Some((submission, leaderboard));
    }
}

/// `top`.
pub async fn top(cluster: &Cluster, scope: &Scope, format: Format) -> Result<ExitCode, Error> {
    let submissions = cluster.submissions(scope).await?;
    let leaderboards = cluster.leaderboards(scope).await?.unwrap_or_default();
    let lines = match output::document(format, &top::value(&submissions)) {
        Some(lines) => lines,
        None if submissions.is_empty() && leaderboards.is_empty() => nothing(cluster, scope).await,
        None => top::lines(&submissions, &leaderboards, frame()),
    };
    print(&lines);
    Ok(ExitCode::SUCCESS)
}

/// A submission each time it changes; an error once it is gone.
pub fn changes(cluster: &Cluster, name: &str) -> impl Stream<Item = Result<Submission, Error>> {
    let gone = name.to_owned();
    uninterrupted(cluster.changes(name)).map(move |change| change?.ok_or_else(|| Error::Gone(gone.clone())))
}

/// Objects that a watch shows, through its interruptions.
pub fn uninterrupted<T>(watch: impl Stream<Item = Result<T, watcher::Error>>) -> impl Stream<Item = Result<T, Error>> {
    watch.filter_map(|change| {
        ready(match change {
            Ok(change) => Some(Ok(change)),
            Err(error) => interruption(error).map(Err),
        })
    })
}

/// Notes that a watch was interrupted and goes on; the error if going on does not help.
fn interruption(error: watcher::Error) -> Option<Error> {
    let message = error::phrase(&watch_error(&error));
    let permanent = error::permanent(error);
    if permanent.is_none() {
        note_once(&format!("{message}; retrying."));
    }
    permanent
}

/// The next change. A watch has no end of its own.
pub async fn next<T>(watch: &mut (impl Stream<Item = Result<T, Error>> + Unpin)) -> Result<T, Error> {
    let ended = || Err(Error::Api("the watch has ended".to_owned()));
    watch.next().await.unwrap_or_else(ended)
}
