//! The commands that make and change submissions: asks the cluster, sends what the pure modules have planned, and waits for the end.

use std::pin::pin;
use std::process::ExitCode;

use futures::StreamExt;
use jiff::Timestamp;
use kube::ResourceExt;

use crate::change::{self, Request};
use crate::cluster::{Cluster, Fetched, Scope};
use crate::commands::{frame, note_interruption, nothing};
use crate::error::{self, Error};
use crate::output::{self, note, print};
use crate::transitions::Waiting;
use crate::{Change, requeue, rerun, submit};
use leaderboard_api::{Attempt, State, Submission};

/// How often a change is tried again after a conflict with somebody else's.
const TRIES: usize = 4;

/// `rerun`.
pub async fn rerun(cluster: &Cluster, wanted: &rerun::Rerun) -> Result<ExitCode, Error> {
    let scope = of_labels(wanted.selector.as_ref());
    let submissions = cluster.submissions(&scope).await?;
    if submissions.is_empty() {
        print(&nothing(cluster, &scope).await);
        return Ok(ExitCode::SUCCESS);
    }
    let (frame, reason) = (frame(), wanted.reason.as_deref());
    let chosen = rerun::chosen(&submissions, reason);
    if chosen.is_empty() {
        print(&rerun::none(submissions.len(), reason, &cluster.namespace, frame));
        return Ok(ExitCode::SUCCESS);
    }
    if wanted.dry_run {
        print(&requeue::dry_run("resume", &chosen, frame));
        return Ok(ExitCode::SUCCESS);
    }
    send_all(cluster, Request::Rerun, &chosen).await
}

/// `requeue`.
pub async fn requeue(cluster: &Cluster, wanted: &requeue::Requeue) -> Result<ExitCode, Error> {
    let scope = of_labels(wanted.selector.as_ref());
    let submissions = if wanted.names.is_empty() {
        cluster.submissions(&scope).await?
    } else {
        let mut named = Vec::new();
        for name in &wanted.names {
            named.push(cluster.submission(name).await?);
        }
        named
    };
    if submissions.is_empty() {
        print(&nothing(cluster, &scope).await);
        return Ok(ExitCode::SUCCESS);
    }
    let frame = frame();
    let chosen = wanted.chosen(&submissions, frame.now);
    if chosen.is_empty() {
        print(&requeue::none(submissions.len(), &cluster.namespace, frame));
        return Ok(ExitCode::SUCCESS);
    }
    if wanted.dry_run {
        print(&requeue::dry_run("requeue", &chosen, frame));
        return Ok(ExitCode::SUCCESS);
    }
    print(&requeue::lines(&chosen, frame));
    print(&[String::new()]);
    let question = format!("Requeue {}?", requeue::counted(chosen.len()));
    if !wanted.yes && !output::is_confirmed(&question) {
        print(&["Nothing was changed.".to_owned()]);
        return Ok(ExitCode::SUCCESS);
    }
    send_all(cluster, Request::Requeue(wanted.why.as_deref()), &chosen).await
}

fn of_labels(selector: Option<&String>) -> Scope {
    Scope {
        selector: selector.cloned(),
        ..Scope::default()
    }
}

/// Sends a request for each; one that is refused does not hold up the others, but without the right to it, or a way to the API server, no
/// further one is tried.
async fn send_all(cluster: &Cluster, request: Request<'_>, chosen: &[&Submission]) -> Result<ExitCode, Error> {
    let mut requested = 0;
    for one in chosen {
        match send(cluster, request, &one.name_any()).await {
            Ok(_) => requested += 1,
            Err(error @ (Error::Forbidden(_) | Error::Credentials(_) | Error::Unreachable { .. })) => {
                return Err(error);
            }
            Err(error) => note(&error.to_string()),
        }
    }
    print(&requeue::summary(requested, chosen.len(), &cluster.namespace, frame()));
    Ok(if requested < chosen.len() {
        ExitCode::FAILURE
    } else {
        ExitCode::SUCCESS
    })
}

/// `cancel` and `resume`.
pub async fn change(cluster: &Cluster, request: Request<'_>, target: &Change) -> Result<ExitCode, Error> {
    let attempt = send(cluster, request, &target.name).await?;
    if !target.wait {
        return Ok(ExitCode::SUCCESS);
    }
    let end = wait(cluster, &target.name, attempt).await?;
    // A cancel succeeds with any end, a resume only with a result.
    let is_fulfilled = request == Request::Cancel || end == State::Finished;
    Ok(if is_fulfilled {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}

/// `submit`.
pub async fn submit(cluster: &Cluster, wanted: &submit::Submit) -> Result<ExitCode, Error> {
    let leaderboard = cluster.leaderboard(&wanted.leaderboard).await?;
    if matches!(leaderboard, Fetched::Missing) {
        return Err(cluster.unknown_leaderboard(&wanted.leaderboard).await?);
    }
    submit::fits(wanted, leaderboard.observed()).map_err(Error::Unfit)?;
    let created = cluster.create(&submit::object(wanted)).await?;
    let name = created.name_any();
    print(&submit::lines(&created, leaderboard.observed(), frame()));
    if !wanted.wait {
        return Ok(ExitCode::SUCCESS);
    }
    let end = wait(cluster, &name, Attempt::FIRST).await?;
    Ok(if end == State::Finished {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}

/// Sends a request to the API server; returns the attempt whose end fulfils it.
async fn send(cluster: &Cluster, request: Request<'_>, name: &str) -> Result<Attempt, Error> {
    for _ in 0..TRIES {
        let submission = cluster.submission(name).await?;
        let leaderboard = cluster.leaderboard(&submission.spec.leaderboard_name).await?;
        let plan = change::plan(request, &submission, leaderboard.observed(), frame()).map_err(Error::Unfit)?;
        if let Some(patch) = &plan.patch {
            match cluster.patch(name, patch).await? {
                Ok(_) => {}
                Err(kube::Error::Api(status)) if status.is_conflict() => continue,
                Err(error) => return Err(refusal(request, &submission, error)),
            }
        }
        print(&plan.lines);
        return Ok(plan.attempt);
    }
    Err(Error::Conflict(name.to_owned()))
}

/// The next step after a refusal by the API server's rules, or for lack of a right where EvalAI is another way.
fn refusal(request: Request<'_>, submission: &Submission, error: kube::Error) -> Error {
    let kube::Error::Api(status) = &error else {
        return error.into();
    };
    let has_other_way = status.is_forbidden() && submission.spec.evalai.is_some();
    if has_other_way || status.is_invalid() || status.code == 400 {
        return Error::Refused {
            message: error::phrase(&status.message),
            next: change::after_refusal(request, submission),
        };
    }
    if status.is_not_found() {
        return Error::Gone(submission.name_any());
    }
    error.into()
}

/// Waits for the end of an attempt, and prints each state until then.
async fn wait(cluster: &Cluster, name: &str, attempt: Attempt) -> Result<State, Error> {
    let mut waiting = Waiting::new(attempt).within(output::width());
    let mut changes = pin!(cluster.changes(name));
    let mut printed = String::new();
    while let Some(change) = changes.next().await {
        match change {
            Ok(Some(submission)) => {
                let update = waiting.observe(&submission, Timestamp::now());
                print(&update.lines);
                if let Some(end) = update.end {
                    return Ok(end);
                }
            }
            Ok(None) => return Err(Error::Gone(name.to_owned())),
            Err(error) => note_interruption(error, &mut printed)?,
        }
    }
    Err(Error::Api("the watch has ended".to_owned()))
}
