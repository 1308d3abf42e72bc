//! Decides if a submission can be cancelled, resumed or restarted; makes the patch that does it, and the lines that explain it.
//!
//! Called by `commands`. Pure; the API server's own rules decide in the end.

use kube::ResourceExt;
use serde_json::{Value, json};

use super::board::{self, Observed};
use super::facts::{command, has_ended, is_attempt_requested, is_run, shown, status};
use super::text::{Frame, span, when, wrap};
use leaderboard_api::{Attempt, Deadlines, Reason, State, Submission};

/// The change that a person requests.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Request {
    Cancel,
    Resume,
    /// Resume as one of many, explained in few words.
    ResumeMany,
    /// A higher attempt of a live run.
    Restart,
}

/// How a request is carried out.
#[derive(Debug, PartialEq)]
pub struct Change {
    /// The merge patch; none if the request was made before.
    pub patch: Option<Value>,
    /// Lines that explain the consequences.
    pub lines: Vec<String>,
    /// The attempt whose end fulfils the request.
    pub attempt: Attempt,
}

/// How to carry out a request, or why that is impossible, with the next step.
pub fn plan(
    request: Request,
    submission: &Submission,
    leaderboard: Observed<'_>,
    frame: Frame,
) -> Result<Change, String> {
    match request {
        Request::Cancel => cancel(submission, leaderboard, frame),
        Request::Resume => resume(submission, leaderboard, frame),
        Request::ResumeMany => resume_many(submission, frame),
        Request::Restart => restart(submission, frame),
    }
}

fn cancel(submission: &Submission, leaderboard: Observed<'_>, frame: Frame) -> Result<Change, String> {
    let name = submission.name_any();
    if has_ended(submission) {
        let at = status(submission).times.finished.as_ref();
        let at = at.map(|at| format!(" since {}", when(at.0, frame.now)));
        return Err(format!(
            "{name} is {}{}, so there is nothing to cancel. See `{}`",
            shown(submission),
            at.unwrap_or_default(),
            command("why", submission)
        ));
    }
    let mut page = frame.page();
    let is_requested = submission.spec.cancel;
    if is_requested {
        page.paragraph(&format!("{name} is already being cancelled."));
    } else {
        page.paragraph(&format!("Cancelling {name}."));
    }
    page.paragraph(&how_it_stops(submission, leaderboard));
    if submission.spec.evalai.is_some() {
        page.paragraph("EvalAI will show `cancelled`.");
    }
    page.paragraph(&format!("To continue it later: `{}`.", command("resume", submission)));
    Ok(Change {
        // The submission may end, or be resumed, at the same time: then the patch conflicts.
        patch: (!is_requested).then(|| {
            json!({
                "metadata": {"resourceVersion": submission.resource_version()},
                "spec": {"cancel": true},
            })
        }),
        lines: page.into_lines(),
        attempt: submission.spec.attempt,
    })
}

/// One sentence on how the operator stops the run at its present stage; docs/states.md has the details.
fn how_it_stops(submission: &Submission, leaderboard: Observed<'_>) -> String {
    if !is_run(submission) {
        return "It has no Job, so it ends at once.".to_owned();
    }
    let seconds = match leaderboard {
        Observed::Found(leaderboard) => Some(leaderboard.spec.deadlines.cancel_seconds),
        // The operator uses the default if the Leaderboard is gone.
        Observed::Missing => Some(Deadlines::default().cancel_seconds),
        Observed::Forbidden => None,
    };
    let grace = seconds.map_or_else(|| "deadlines.cancelSeconds".to_owned(), span);
    if status(submission).times.started.is_none() {
        return format!(
            "Its run has not begun, so the Job is deleted at once; a Pod that is already running is first asked to stop and \
             has {grace}."
        );
    }
    format!(
        "The Pod is asked to stop and uploads its results. After {grace} the Job is deleted, then the Pod is force-deleted. \
         Completed work is kept, and results that are complete by then count."
    )
}

/// In few words, since there may be many.
fn resume_many(submission: &Submission, frame: Frame) -> Result<Change, String> {
    let attempt = next_attempt(submission)?;
    let text = format!("Requested attempt {attempt} of {}.", submission.name_any());
    Ok(resumption(submission, attempt, wrap(&text, frame.width)))
}

fn restart(submission: &Submission, frame: Frame) -> Result<Change, String> {
    let name = submission.name_any();
    may_go_on(submission)?;
    if !is_run(submission) {
        return Err(format!(
            "{name} is {} and has no run to restart. See `{}`",
            shown(submission),
            command("why", submission)
        ));
    }
    let attempt = submission.spec.attempt.next();
    let text = format!(
        "Requested attempt {attempt} of {name}: its run stores its results, stops, and goes on when its turn comes."
    );
    Ok(resumption(submission, attempt, wrap(&text, frame.width)))
}

fn resume(submission: &Submission, leaderboard: Observed<'_>, frame: Frame) -> Result<Change, String> {
    let attempt = next_attempt(submission)?;
    let mut page = frame.page();
    page.paragraph(&format!("Requested attempt {attempt} of {}.", submission.name_any()));
    match &status(submission).results_url {
        Some(results) => page.paragraph(&format!(
            "It continues from the results in {results} and does what is missing."
        )),
        None => page.paragraph("Its status names no stored results, so it starts from the beginning."),
    }
    board::show_problems(&mut page, &submission.spec.leaderboard_name, leaderboard);
    if let Some(evalai) = submission.spec.evalai {
        page.paragraph(&format!(
            "The operator asks EvalAI first. If EvalAI shows submission {} as archived, deleted or finished, the attempt ends \
             as {}: then resume it in EvalAI.",
            evalai.submission,
            Reason::EndedInEvalAI
        ));
    }
    page.paragraph(&format!("To follow it: `{} -w`.", command("status", submission)));
    Ok(resumption(submission, attempt, page.into_lines()))
}

fn resumption(submission: &Submission, attempt: Attempt, lines: Vec<String>) -> Change {
    Change {
        // Somebody else may raise the attempt at the same time: then the patch conflicts.
        patch: Some(json!({
            "metadata": {"resourceVersion": submission.resource_version()},
            "spec": {"attempt": attempt, "cancel": false},
        })),
        lines,
        attempt,
    }
}

/// Why no attempt can be requested of it, whatever has become of the present one.
fn may_go_on(submission: &Submission) -> Result<(), String> {
    let name = submission.name_any();
    if submission.metadata.deletion_timestamp.is_some() {
        return Err(format!(
            "{name} is being deleted. Wait until it is gone, and apply it again with a higher attempt to continue from its \
             stored results"
        ));
    }
    if is_attempt_requested(submission) {
        let wanted = submission.spec.attempt;
        return Err(format!(
            "attempt {wanted} of {name} is already requested and has not started yet. See `{}`",
            command("why", submission)
        ));
    }
    Ok(())
}

/// The attempt that a resume requests, or why there is none.
fn next_attempt(submission: &Submission) -> Result<Attempt, String> {
    may_go_on(submission)?;
    let name = submission.name_any();
    match status(submission).known_state().filter(|_| has_ended(submission)) {
        Some(State::Failed | State::Cancelled) => Ok(submission.spec.attempt.next()),
        Some(State::Finished) => Err(format!(
            "{name} has finished and cannot be resumed. Submit again to run it once more"
        )),
        _ => {
            let (shown, see) = (shown(submission), command("why", submission));
            let or = if is_run(submission) {
                format!("restart its run (`{} --restart`)", command("resume", submission))
            } else {
                format!("cancel it first (`{}`)", command("cancel", submission))
            };
            Err(format!(
                "{name} is {shown}; only Failed and Cancelled submissions can be resumed. Wait for its end (`{see}`), or {or}"
            ))
        }
    }
}

/// Next step after the API server refused a patch.
pub fn after_refusal(request: Request, submission: &Submission) -> String {
    match (request, submission.spec.evalai) {
        (Request::Resume | Request::ResumeMany, Some(evalai)) => format!(
            "Resume submission {} in EvalAI (challenge {}): its message raises the attempt here",
            evalai.submission, evalai.challenge
        ),
        (Request::Cancel, Some(evalai)) => format!(
            "Cancel submission {} in EvalAI (challenge {}): the operator notices it within seconds",
            evalai.submission, evalai.challenge
        ),
        (Request::Restart, _) | (_, None) => format!("Fix what it names; see `{}`", command("why", submission)),
    }
}
