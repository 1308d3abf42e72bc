//! Whether a submission may be cancelled or resumed, the patch that does it, and what happens then.
//!
//! Called by `mod`. Pure; the API server's own rules have the last word.

use kube::ResourceExt;
use serde_json::{Value, json};

use super::board::{self, Sight};
use super::text::{Page, when};
use super::why::{command, has_ended, is_attempt_wished};
use leaderboard_api::{Deadlines, State, Submission, reasons};

/// What a person wishes of a submission.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wish {
    Cancel,
    Resume,
}

/// How a wish is carried out.
#[derive(Debug, PartialEq)]
pub struct Plan {
    /// The merge patch; none if it is on its way already.
    pub patch: Option<Value>,
    /// What happens then, in lines.
    pub says: Vec<String>,
    /// The attempt whose end fulfils the wish.
    pub attempt: i64,
}

/// How to carry out a wish, or why it cannot be, with the next step.
pub fn plan(wish: Wish, submission: &Submission, leaderboard: Sight<'_>, now: jiff::Timestamp) -> Result<Plan, String> {
    match wish {
        Wish::Cancel => cancel(submission, leaderboard, now),
        Wish::Resume => resume(submission, leaderboard),
    }
}

fn cancel(submission: &Submission, leaderboard: Sight<'_>, now: jiff::Timestamp) -> Result<Plan, String> {
    let name = submission.name_any();
    let status = submission.status.as_ref();
    if has_ended(submission) {
        let state = status.and_then(|s| s.state).map_or("ended", State::as_str);
        let at = status.and_then(|s| s.times.finished.as_ref());
        let at = at.map(|at| format!(" since {}", when(at.0, now))).unwrap_or_default();
        return Err(format!(
            "{name} is {state}{at}, so there is nothing to cancel. See `{}`",
            command("why", submission)
        ));
    }
    let mut page = Page::default();
    let is_told = submission.spec.cancel;
    if is_told {
        page.say(&format!("{name} is being cancelled already."));
    } else {
        page.say(&format!("{name} is to be cancelled."));
    }
    page.say(&how_it_stops(submission, leaderboard));
    if submission.spec.evalai.is_some() {
        page.say("EvalAI is told `cancelled`.");
    }
    page.say(&format!("`{}` takes it up again.", command("resume", submission)));
    Ok(Plan {
        // Decided on what was read: it may end, or be resumed, at the same time.
        patch: (!is_told).then(|| {
            json!({
                "metadata": {"resourceVersion": submission.resource_version()},
                "spec": {"cancel": true},
            })
        }),
        says: page.into_lines(),
        attempt: submission.spec.attempt,
    })
}

/// What the operator does about a stop at this stage; docs/states.md tells it at length.
fn how_it_stops(submission: &Submission, leaderboard: Sight<'_>) -> String {
    let status = submission.status.as_ref().filter(|_| !is_attempt_wished(submission));
    if status.is_none_or(|s| s.job_name.is_none()) {
        return "It has no Job, so it ends at once.".to_owned();
    }
    let seconds = match leaderboard {
        Sight::There(leaderboard) => Some(leaderboard.spec.deadlines.cancel_seconds),
        // What the operator takes then.
        Sight::Missing => Some(Deadlines::default().cancel_seconds),
        Sight::Unread => None,
    };
    let grace = seconds.map_or_else(|| "deadlines.cancelSeconds".to_owned(), |s| format!("{s} s"));
    if status.is_none_or(|s| s.times.started.is_none()) {
        return format!(
            "None of its agents has started. Its Job is deleted at once; if its Pod is up already, that is told first and \
             has {grace}."
        );
    }
    format!(
        "Its Pod is told, stores what it has and ends; if it takes longer than {grace}, its Job is deleted, then its Pod by \
         force. What it has reached is kept, and results that are complete by then count."
    )
}

fn resume(submission: &Submission, leaderboard: Sight<'_>) -> Result<Plan, String> {
    let name = submission.name_any();
    if let Some(why_not) = not_resumable(submission) {
        return Err(why_not);
    }
    let attempt = submission.spec.attempt.saturating_add(1);
    let mut page = Page::default();
    let results = submission.status.as_ref().and_then(|s| s.results_url.as_deref());
    page.say(&format!("Attempt {attempt} of {name} is wished."));
    match results {
        Some(results) => page.say(&format!(
            "It takes up what is stored in {results} and runs what is missing."
        )),
        None => page.say("Nothing of it is stored yet, as far as its status says, so it begins with the first route."),
    }
    for trouble in board::troubles(&submission.spec.leaderboard_name, leaderboard) {
        page.say(&trouble.words);
    }
    if let Some(evalai) = submission.spec.evalai {
        page.say(&format!(
            "EvalAI is asked first. Where it has submission {} as archived, deleted or finished, the attempt ends as {}: \
             then resume it in EvalAI.",
            evalai.submission,
            reasons::ENDED_IN_EVALAI
        ));
    }
    Ok(Plan {
        // Decided on what was read: somebody else may raise the attempt at the same time.
        patch: Some(json!({
            "metadata": {"resourceVersion": submission.resource_version()},
            "spec": {"attempt": attempt, "cancel": false},
        })),
        says: page.into_lines(),
        attempt,
    })
}

fn not_resumable(submission: &Submission) -> Option<String> {
    let name = submission.name_any();
    let see = command("why", submission);
    if submission.metadata.deletion_timestamp.is_some() {
        return Some(format!(
            "{name} is being deleted. Wait until it is gone, and apply it again with a higher attempt to take up what is \
             stored"
        ));
    }
    if is_attempt_wished(submission) {
        let wanted = submission.spec.attempt;
        return Some(format!(
            "attempt {wanted} of {name} is wished already and not begun yet. See `{see}`"
        ));
    }
    let state = submission.status.as_ref().and_then(|s| s.state);
    match state.filter(|_| has_ended(submission)) {
        Some(State::Failed | State::Cancelled) => None,
        Some(State::Finished) => Some(format!(
            "{name} is Finished, which is for ever. Submit the image again to run it once more"
        )),
        _ => {
            let state = state.map_or("new", State::as_str);
            let cancel = command("cancel", submission);
            Some(format!(
                "{name} is {state}; only what is Failed or Cancelled is resumed. Wait for its end (`{see}`), or cancel it \
                 first (`{cancel}`)"
            ))
        }
    }
}

/// What to do when the API server refuses a patch.
pub fn after_refusal(wish: Wish, submission: &Submission) -> String {
    match (wish, submission.spec.evalai) {
        (Wish::Resume, Some(evalai)) => format!(
            "Resume submission {} in EvalAI (challenge {}): its message raises the attempt here",
            evalai.submission, evalai.challenge
        ),
        (Wish::Cancel, Some(evalai)) => format!(
            "Cancel submission {} in EvalAI (challenge {}): that is heard within seconds",
            evalai.submission, evalai.challenge
        ),
        (_, None) => format!("Mend what it says; see `{}`", command("why", submission)),
    }
}
