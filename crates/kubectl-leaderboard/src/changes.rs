//! The commands that make and change submissions: asks the cluster, sends what the pure modules have planned, and waits for the end.

use std::pin::pin;
use std::process::ExitCode;

use kube::ResourceExt;

use crate::change::{self, Request};
use crate::cluster::{Cluster, Fetched, Filter, Scope};
use crate::commands::{changes, frame, next, nothing};
use crate::error::{self, Error};
use crate::output::{self, code, note, print};
use crate::{Cancel, facts, resume, submit, upload};
use leaderboard_api::{Attempt, Leaderboard, State, Submission};

/// How often a change is tried again after a conflict with somebody else's.
const TRIES: usize = 4;

/// `resume`.
pub async fn resume(cluster: &Cluster, wanted: &resume::Resume) -> Result<ExitCode, Error> {
    if !wanted.names.is_empty() {
        if wanted.filter != Filter::default() {
            let text =
                "--leaderboard, --track and --team choose among all. Use them with --all or -l, and without names";
            return Err(Error::Unfit(text.to_owned()));
        }
        return resume_named(cluster, wanted).await;
    }
    let scope = Scope {
        selector: wanted.selector.clone(),
        filter: wanted.filter.clone(),
        ..Scope::default()
    };
    let submissions = cluster.submissions(&scope).await?;
    if submissions.is_empty() {
        print(&nothing(cluster, &scope).await);
        return Ok(ExitCode::SUCCESS);
    }
    let (frame, verb) = (frame(), wanted.verb());
    let chosen = wanted.chosen(&submissions);
    if chosen.is_empty() {
        print(&wanted.none(submissions.len(), &cluster.namespace, frame));
        return Ok(ExitCode::SUCCESS);
    }
    if wanted.dry_run {
        print(&resume::dry_run(verb, &chosen, frame));
        return Ok(ExitCode::SUCCESS);
    }
    print(&resume::lines(&chosen, frame));
    print(&[String::new()]);
    // Without a terminal there is no answer, and the command itself counts as a yes.
    if !wanted.yes && !output::ask(&resume::question(verb, chosen.len())).unwrap_or(true) {
        print(&["Nothing was changed.".to_owned()]);
        return Ok(ExitCode::SUCCESS);
    }
    send_all(cluster, wanted.request(), &chosen).await
}

async fn resume_named(cluster: &Cluster, wanted: &resume::Resume) -> Result<ExitCode, Error> {
    let sent = send_each(cluster, wanted.request(), &wanted.names).await?;
    let mut is_fulfilled = sent.len() == wanted.names.len();
    for (name, attempt) in sent.into_iter().filter(|_| wanted.wait) {
        is_fulfilled &= wait(cluster, name, attempt).await? == State::Finished;
    }
    Ok(code(is_fulfilled))
}

/// Sends a request for each, and says how many were taken.
async fn send_all(cluster: &Cluster, request: Request, chosen: &[&Submission]) -> Result<ExitCode, Error> {
    let names: Vec<String> = chosen.iter().map(|one| one.name_any()).collect();
    let requested = send_each(cluster, request, &names).await?.len();
    print(&resume::summary(requested, names.len(), &cluster.namespace, frame()));
    Ok(code(requested == names.len()))
}

/// Sends the request for each submission; returns those that the API server took, with their attempts. A refusal does not hold up the
/// others. It ends with the first error that each request would meet: no right, no credentials, or no API server.
async fn send_each<'a>(
    cluster: &Cluster,
    request: Request,
    names: &'a [String],
) -> Result<Vec<(&'a str, Attempt)>, Error> {
    let mut sent = Vec::new();
    for name in names {
        match send(cluster, request, name).await {
            Ok(attempt) => sent.push((name.as_str(), attempt)),
            Err(error @ (Error::Forbidden(_) | Error::Credentials(_) | Error::Unreachable { .. })) => {
                return Err(error);
            }
            Err(error) => note(&error.to_string()),
        }
    }
    Ok(sent)
}

/// `cancel`.
pub async fn cancel(cluster: &Cluster, target: &Cancel) -> Result<ExitCode, Error> {
    let attempt = send(cluster, Request::Cancel, &target.name).await?;
    if target.wait {
        wait(cluster, &target.name, attempt).await?;
    }
    Ok(ExitCode::SUCCESS)
}

/// `submit`.
pub async fn submit(cluster: &Cluster, wanted: &submit::Submit) -> Result<ExitCode, Error> {
    let leaderboard = cluster.leaderboard(&wanted.leaderboard).await?;
    if matches!(leaderboard, Fetched::Missing) {
        return Err(cluster
            .unknown::<Leaderboard>("Leaderboard", &wanted.leaderboard)
            .await?);
    }
    let (name, is_file) = (&wanted.leaderboard, wanted.file.is_some());
    submit::fits(name, &wanted.track, is_file, leaderboard.observed()).map_err(Error::Unfit)?;
    let mut object = submit::object(wanted);
    if let Some(file) = &wanted.file {
        upload::upload(cluster, wanted, file, leaderboard.observed(), &mut object).await?;
    }
    let created = cluster.create(&object, false).await?;
    let name = created.name_any();
    print(&submit::lines(&created, leaderboard.observed(), frame()));
    if !wanted.wait {
        return Ok(ExitCode::SUCCESS);
    }
    let end = wait(cluster, &name, Attempt::FIRST).await?;
    Ok(code(end == State::Finished))
}

/// Sends a request to the API server; returns the attempt whose end fulfils it.
async fn send(cluster: &Cluster, request: Request, name: &str) -> Result<Attempt, Error> {
    for _ in 0..TRIES {
        let submission = cluster.submission(name).await?;
        let leaderboard = cluster.leaderboard(&submission.spec.leaderboard_name).await?;
        let plan = change::plan(request, &submission, leaderboard.observed(), frame()).map_err(Error::Unfit)?;
        if let Some(patch) = &plan.patch {
            match cluster.patch::<Submission>(name, patch).await? {
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
fn refusal(request: Request, submission: &Submission, error: kube::Error) -> Error {
    let kube::Error::Api(status) = &error else {
        return error.into();
    };
    let has_other_way = status.is_forbidden() && request != Request::Restart && submission.spec.evalai.is_some();
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
    let mut changes = pin!(changes(cluster, name));
    let mut last = String::new();
    loop {
        let submission = next(&mut changes).await?;
        let Some((state, lines)) = facts::transition(&submission, attempt, frame()) else {
            continue;
        };
        if state != last {
            print(&lines);
            last = state;
        }
        let status = facts::status(&submission);
        if status.has_ended() {
            return Ok(status.state_of_conditions());
        }
    }
}
