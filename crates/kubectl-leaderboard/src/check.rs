//! `check`: one worker with an agent of the host's own, shown as `why` shows it, next to the conditions of its Leaderboard.
//!
//! Called by `main`. `object`, `lines` and `has_passed` are pure.

use std::process::ExitCode;
use std::time::Duration;

use clap::Args;
use kube::ResourceExt;
use leaderboard_api::conditions::{self, Condition};
use leaderboard_api::text::sentence;
use leaderboard_api::{Evaluation, Leaderboard, State, Submission, reasons};
use serde_json::{Value, json};

use crate::board::Observed;
use crate::cluster::Cluster;
use crate::commands::{follow, frame};
use crate::error::Error;
use crate::output::{code, note, print};
use crate::text::Frame;
use crate::{facts, submit, why};

/// Start of a check's name. The API server takes no other, so that its prefix in the bucket is never a team's.
const NAME_PREFIX: &str = "check-";

/// Arguments of `check`: the Leaderboard, the agent, and the time to wait.
#[derive(Args, Debug)]
pub struct Check {
    /// Name of the Leaderboard.
    name: String,
    /// Track to run it on [default: the first].
    #[arg(long)]
    track: Option<String>,
    /// Image of an agent of your own [default: spec.check.image of the Leaderboard].
    #[arg(long)]
    image: Option<String>,
    /// Keep the check's Submission.
    #[arg(long)]
    keep: bool,
    /// Give the check up after so many seconds.
    #[arg(long, default_value_t = 3600, value_name = "SECONDS", value_parser = clap::value_parser!(u64).range(1..=86_400))]
    timeout: u64,
}

/// Checks a Leaderboard; the exit code shows whether it passed.
pub async fn check(cluster: &Cluster, wanted: &Check) -> Result<ExitCode, Error> {
    let leaderboard = cluster.known_leaderboard(&wanted.name).await?;
    let object = object(&leaderboard, wanted).map_err(Error::Unfit)?;
    let created = cluster.create(&object, false).await?;
    let name = created.name_any();
    let followed = tokio::select! {
        biased;
        _ = tokio::signal::ctrl_c() => Err(Error::Interrupted),
        followed = follow(cluster, &name, |check, board| lines(check, board.observed(), frame())) => followed,
        () = tokio::time::sleep(Duration::from_secs(wanted.timeout)) => Err(Error::Unfit(format!(
            "{name} did not end within {} s (--timeout). Do what is named above, and run the check again", wanted.timeout
        ))),
    };
    if wanted.keep {
        note(&format!("{name} is kept, for `{}`.", facts::command("why", &created)));
    } else {
        cluster.delete(&name).await?;
    }
    let (submission, leaderboard) = followed?;
    let has_passed = has_passed(&submission, leaderboard.observed());
    let verdict = if has_passed {
        "The check passed."
    } else {
        "The check did not pass. Correct what is named above, and run it again."
    };
    print(&[String::new(), verdict.to_owned()]);
    Ok(code(has_passed))
}

/// The Submission to create, or why a check cannot begin, with the next step.
pub(super) fn object(leaderboard: &Leaderboard, wanted: &Check) -> Result<Value, String> {
    let spec = &leaderboard.spec;
    let first = spec.tracks.first().map(|track| track.name.clone());
    let track = wanted.track.clone().or(first).unwrap_or_default();
    submit::fits(&wanted.name, &track, false, Observed::Found(leaderboard))?;
    let named = spec.check.as_ref().map(|check| check.image.clone());
    let image = wanted.image.clone().or(named).ok_or_else(|| {
        let of_carla = match spec.evaluation {
            Evaluation::Carla(_) => "; examples/check-agent/Dockerfile makes one of the Leaderboard's NPC agent",
            Evaluation::Container(_) => "",
        };
        format!(
            "Leaderboard {} names no image for a check. Give the image of an agent of your own with --image, or set \
             spec.check.image{of_carla}",
            wanted.name
        )
    })?;
    let spec = json!({"leaderboardName": wanted.name, "track": track, "image": image, "check": true});
    Ok(submit::manifest(NAME_PREFIX, &wanted.name, &spec))
}

/// Lines about a check: its own `why`, and all conditions of its Leaderboard.
pub(super) fn lines(submission: &Submission, leaderboard: Observed<'_>, frame: Frame) -> Vec<String> {
    let mut page = frame.page();
    for found in conditions_of(leaderboard) {
        let text = format!("{}, {}: {}", found.status, found.reason, sentence(&found.message));
        page.row(&found.type_, text.trim_end_matches(": "));
        if let Some(reason) = found.reason.known().filter(|_| !found.is_true()) {
            page.row("", &reasons::plain(reason.next_step()));
        }
    }
    let mut lines = why::explain(submission, leaderboard, frame);
    lines.push(String::new());
    lines.extend(page.into_lines());
    lines
}

/// True if the check is Finished, its condition Logged is not False, and the Leaderboard is Ready.
pub(super) fn has_passed(submission: &Submission, leaderboard: Observed<'_>) -> bool {
    let status = facts::status(submission);
    let logged = status.condition(conditions::LOGGED);
    status.state_of_conditions() == State::Finished
        && logged.is_none_or(|logged| logged.status != "False")
        && conditions::is_true(conditions_of(leaderboard), conditions::READY)
}

fn conditions_of(leaderboard: Observed<'_>) -> &[Condition] {
    let status = leaderboard.leaderboard().and_then(|board| board.status.as_ref());
    status.map(|status| status.conditions.as_slice()).unwrap_or_default()
}
