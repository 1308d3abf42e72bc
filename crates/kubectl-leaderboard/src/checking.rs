//! Carries a check out: creates its Submission, prints its states, and removes it.
//!
//! Called by `main`. What is made and what is printed is decided in `check`.

use std::pin::pin;
use std::process::ExitCode;
use std::time::Duration;

use clap::Args;
use futures::StreamExt;
use jiff::Timestamp;
use kube::ResourceExt;
use serde_json::json;

use crate::board::Observed;
use crate::check::{
    self, Collectors, Outcome, Patience, Readers, Seen, Wanted, ask_for_collectors, ask_for_readers, findings,
    submission,
};
use crate::cluster::{Cluster, Scope};
use crate::commands::{frame, note_interruption};
use crate::error::Error;
use crate::output::{print, width};
use crate::transitions::Waiting;
use leaderboard_api::{Attempt, Leaderboard, State, Submission};

/// How long the operator may take to note a check in its Leaderboard.
const NOTE: Duration = Duration::from_secs(20);

/// What is to be checked, and how long to wait.
#[derive(Args, Debug)]
pub struct Check {
    /// Name of the Leaderboard [default: the only one of the namespace].
    name: Option<String>,
    /// Track to drive [default: the first].
    #[arg(long)]
    track: Option<String>,
    /// Image of an agent of your own [default: spec.check.image of the Leaderboard].
    #[arg(long)]
    image: Option<String>,
    /// Keep the check's Submission.
    #[arg(long)]
    keep: bool,
    /// Give the check up after so many seconds.
    #[arg(long, default_value_t = 3600, value_name = "SECONDS", value_parser = clap::value_parser!(i64).range(1..=86_400))]
    timeout: i64,
}

/// What became of the wait for a check.
struct Waited {
    submission: Submission,
    given_up: Option<String>,
}

/// Who else reads the queue, and who else stores the lines.
struct Others {
    readers: Readers,
    collectors: Collectors,
}

/// Checks a Leaderboard; the exit code shows whether it passed.
pub async fn check(cluster: &Cluster, wanted: &Check) -> Result<ExitCode, Error> {
    let leaderboard = leaderboard(cluster, wanted.name.as_deref()).await?;
    let name = leaderboard.name_any();
    let object = submission(
        &leaderboard,
        Wanted {
            track: wanted.track.as_deref(),
            image: wanted.image.as_deref(),
        },
    )
    .map_err(Error::Unfit)?;
    let created = cluster.create(&object).await?;
    print(&check::begun(&created, frame()));
    let waited = tokio::select! {
        waited = run(cluster, &created, wanted.timeout) => waited,
        _ = tokio::signal::ctrl_c() => Err(Error::Interrupted),
    };
    let shown = match waited {
        Ok((waited, others)) => show(cluster, &name, &waited, &others).await,
        Err(error) => Err(error),
    };
    if wanted.keep {
        print(&check::kept(&created, frame()));
    } else {
        cluster.delete(&created.name_any()).await?;
    }
    shown
}

async fn leaderboard(cluster: &Cluster, name: Option<&str>) -> Result<Leaderboard, Error> {
    let all = cluster.leaderboards(&Scope::default()).await?;
    let all = all.ok_or_else(|| Error::Forbidden("Leaderboards cannot be listed".to_owned()))?;
    let known: Vec<String> = all.iter().map(ResourceExt::name_any).collect();
    let mut found = all
        .into_iter()
        .filter(|one| name.is_none_or(|name| one.name_any() == name));
    match (found.next(), found.next(), name) {
        (Some(one), None, _) => Ok(one),
        (.., Some(name)) => Err(cluster.unknown_leaderboard(name).await?),
        (.., None) => Err(Error::Unfit(check::which(&known, &cluster.namespace))),
    }
}

/// Waits for the end of a check, and asks meanwhile who else reads the queue. Who else stores the lines depends on the Pod's node.
async fn run(cluster: &Cluster, created: &Submission, seconds: i64) -> Result<(Waited, Others), Error> {
    let board = cluster.leaderboard(&created.spec.leaderboard_name).await?;
    let queue = board
        .observed()
        .leaderboard()
        .and_then(|board| board.spec.queue.as_ref());
    let (waited, readers) = tokio::join!(wait(cluster, created, seconds), ask_for_readers(queue));
    let waited = waited?;
    let status = waited.submission.status.as_ref();
    let node = status.and_then(|status| status.node_name.as_deref());
    let collectors = ask_for_collectors(cluster, node).await;
    Ok((waited, Others { readers, collectors }))
}

async fn wait(cluster: &Cluster, created: &Submission, seconds: i64) -> Result<Waited, Error> {
    let name = created.name_any();
    let mut transitions = Waiting::new(Attempt::FIRST).within(width());
    let mut interruption = String::new();
    let mut patience = Patience::new(Timestamp::now(), seconds);
    let mut last = created.clone();
    let mut changes = pin!(cluster.changes(&name));
    loop {
        let left = patience.next().duration_since(Timestamp::now());
        let left = Duration::try_from(left).unwrap_or_default();
        match tokio::time::timeout(left, changes.next()).await {
            Ok(Some(Ok(Some(submission)))) => {
                let now = Timestamp::now();
                print(&transitions.observe(&submission, now).lines);
                patience.observe(&submission, now);
                last = submission;
            }
            Ok(Some(Ok(None)) | None) => return Err(Error::Gone(name)),
            Ok(Some(Err(error))) => note_interruption(error, &mut interruption)?,
            Err(_) => {}
        }
        let now = Timestamp::now();
        if patience.is_over(now) {
            return Ok(Waited {
                submission: last,
                given_up: None,
            });
        }
        if let Some(why) = patience.given_up(now) {
            return give_up(cluster, last, why).await;
        }
    }
}

/// Cancels the check, so that the operator notes it as failed; what it waited for is what is shown.
async fn give_up(cluster: &Cluster, last: Submission, why: String) -> Result<Waited, Error> {
    let name = last.name_any();
    if let Err(error) = cluster.patch(&name, &json!({"spec": {"cancel": true}})).await? {
        return Err(error.into());
    }
    let ended = async {
        let mut changes = pin!(cluster.changes(&name));
        while let Some(change) = changes.next().await {
            if matches!(&change, Ok(Some(submission)) if submission.check_end().is_some()) {
                return;
            }
        }
    };
    // If the operator does not run, it ends with its deletion.
    let _ = tokio::time::timeout(NOTE, ended).await;
    Ok(Waited {
        submission: last,
        given_up: Some(why),
    })
}

/// Prints what was found. The Leaderboard is read again: the check's Pod has measured its isolation.
async fn show(cluster: &Cluster, name: &str, waited: &Waited, others: &Others) -> Result<ExitCode, Error> {
    let check = waited.submission.name_any();
    let noted = |board: &Leaderboard| {
        let status = board.status.as_ref();
        status
            .and_then(|s| s.last_check.as_ref())
            .is_some_and(|last| last.submission_name == check)
    };
    cluster.await_leaderboard(name, NOTE, noted).await;
    let board = cluster.leaderboard(name).await?;
    let Observed::Found(leaderboard) = board.observed() else {
        return Err(Error::Unfit(format!(
            "Leaderboard {name} was deleted in the meantime. Apply it again"
        )));
    };
    let found = findings(Seen {
        leaderboard,
        submission: Some(&waited.submission),
        given_up: waited.given_up.as_deref(),
        readers: &others.readers,
        collectors: &others.collectors,
    });
    let status = waited.submission.status.as_ref();
    let has_finished = status.is_some_and(|status| status.state_of_conditions() == State::Finished);
    let outcome = Outcome::of(&found, has_finished);
    print(&[String::new()]);
    print(&check::lines(&found, outcome, width()));
    print(&check::left(&waited.submission, frame()));
    Ok(if outcome.has_passed {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}
