//! What another program still runs is left alone: a row or objects without this operator's mark hold a submission back until the
//! other run has ended, or a person hands it over.

use std::time::Duration;

use jiff::Timestamp;

use super::plan::Action;
use super::plan_builder::{PlanBuilder, Terms, after};
use super::stored;
use crate::controller::submissions::foreign_runs::{
    AGAIN, Looked, ObservedTraces, Question, StoredRun, Traces, Unread, question,
};
use crate::controller::submissions::view::{EvalaiInfo, Standing};
use crate::services::table::ObservedRow;
use leaderboard_api::conditions::{self, Truth};
use leaderboard_api::text::{LONGEST_NAME, one_line, sentence};
use leaderboard_api::{effective, names, reasons};

/// The old pipeline writes its end to the row and to EvalAI, one after the other: EvalAI is read again so long after the row was.
const SETTLED_SECONDS: i64 = 15;
/// How long an object may be the newest of a run that has no time limit and still goes on.
const DAY_SECONDS: i64 = 86_400;
/// What the old pipeline's row shows of a run that has not ended.
const UNDER_WAY: [&str; 2] = ["SUBMITTED", "RUNNING"];

/// Whether the submission has to wait, because another program runs it or that is not known yet. Only EvalAI hands a submission
/// to more than one program; others, and those that a person hands over, are looked for if they may have lost their status.
pub(super) fn waits(draft: &mut PlanBuilder<'_>, terms: Terms<'_>) -> bool {
    let accepted = draft.status.condition(conditions::ACCEPTED);
    let is_accepted = accepted.is_some_and(|c| c.status == "True");
    // One that observes stores below a prefix of its own, and runs what another program runs on purpose.
    let is_settled = is_accepted || draft.status.has_run() || draft.observes();
    let is_asked = if draft.is_adopted() || terms.info.is_none() {
        stored::may_be(draft) && stored::is_marked(draft)
    } else {
        true
    };
    if is_settled || !is_asked {
        return false;
    }
    let Some(answer) = look(draft, terms) else {
        return true;
    };
    let question = ask(draft, terms);
    let why = match (&answer.found, terms.info) {
        // A person's word stands above what was found of another program.
        _ if draft.is_adopted() => return false,
        (Err(unread), _) => not_known(
            draft,
            unread,
            "Whether another program runs the submission",
            &format!("to start it all the same, {}", adoption()),
        ),
        (Ok(_), None) => return false,
        (Ok(traces), Some(info)) => {
            let window = match effective::deadlines(terms.leaderboard, Some(terms.track)).run_seconds {
                0 => DAY_SECONDS,
                seconds => seconds,
            };
            let Some(found) = found(traces, info, window, draft.now()) else {
                return is_unsettled(draft, answer.at);
            };
            draft.moves();
            found.message(&question.prefix())
        }
    };
    waits_for_look(draft, question, why);
    true
}

/// An end that EvalAI shows may be one of ours, and an end that is shown here stands: while that is not known none is shown.
pub(super) fn looks_again(draft: &mut PlanBuilder<'_>, terms: Terms<'_>, unread: &Unread) {
    let shown = terms.info.map_or("an end", |info| info.status.as_str());
    let what = format!("EvalAI shows {shown}, and whether a run of this operator has ended so");
    let way_out = "to end the Submission without that, set its spec.cancel: it is then Cancelled, and EvalAI and table keep what \
                   they have.";
    let why = not_known(draft, unread, &what, way_out);
    let question = ask(draft, terms);
    waits_for_look(draft, question, why);
}

/// Looks again when the present answer is no longer good.
fn waits_for_look(draft: &mut PlanBuilder<'_>, question: Question, why: String) {
    draft.act(Action::LookForForeignRun(Box::new(question)));
    draft.requeue_in(AGAIN + Duration::from_secs(1));
    draft.condition(conditions::ACCEPTED, Truth::False, reasons::FOREIGN, &why);
    draft.show(reasons::FOREIGN, why);
}

/// Whether a submission that was held back waits for EvalAI's own word on how the other run has ended: what is known of it may be
/// older than that end.
fn is_unsettled(draft: &mut PlanBuilder<'_>, looked_at: Timestamp) -> bool {
    let accepted = draft.status.condition(conditions::ACCEPTED);
    let was_held = accepted.is_some_and(|c| c.reason == reasons::FOREIGN);
    let settled = after(looked_at, SETTLED_SECONDS);
    let read_at = draft.view.evalai.as_ref().and_then(|evalai| evalai.read_at);
    if !was_held || read_at.is_some_and(|at| at >= settled) {
        return false;
    }
    draft.keeps_status();
    if draft.now() < settled {
        draft.requeue_at(settled);
    } else {
        draft.act(Action::ForgetEvalai);
        draft.requeue_in(Duration::from_secs(1));
    }
    true
}

/// What was found in table and bucket; none yet: the submission waits.
pub(super) fn look<'a>(draft: &mut PlanBuilder<'a>, terms: Terms<'_>) -> Option<&'a Looked> {
    let view = draft.view;
    let waited = match &view.traces {
        ObservedTraces::Answered(answer) => return Some(answer),
        ObservedTraces::NotAsked => Duration::ZERO,
        ObservedTraces::Asked(waited) => *waited,
    };
    let question = ask(draft, terms);
    looks(draft, question, waited);
    None
}

fn ask(draft: &PlanBuilder<'_>, terms: Terms<'_>) -> Question {
    let attempt = draft.status.attempt.unwrap_or_default();
    let team = draft.status.team.as_ref().and_then(|team| team.id.clone());
    let team = terms.info.map_or(team, |info| Some(info.team_id.clone()));
    question(draft.submission(), terms.leaderboard, attempt, team.unwrap_or_default())
}

fn looks(draft: &mut PlanBuilder<'_>, question: Question, waited: Duration) {
    draft.act(Action::LookForForeignRun(Box::new(question)));
    if draft.waits_quietly(waited) {
        return;
    }
    draft.requeue_in(AGAIN);
    draft.condition(
        conditions::ACCEPTED,
        Truth::Unknown,
        reasons::LOOKING_FOR_FOREIGN_RUN,
        "",
    );
    let message = "Table and bucket are asked whether another program runs the submission.";
    draft.show(reasons::LOOKING_FOR_FOREIGN_RUN, message);
}

/// While that cannot be known nothing starts, since a second run would write over the first one's results, and nothing ends. `what` is
/// not known; `way_out` is what a person can do without it.
fn not_known(draft: &mut PlanBuilder<'_>, unread: &Unread, what: &str, way_out: &str) -> String {
    let why = sentence(&unread.why);
    let message = format!("{what} is not known: {why} It is looked for again; {way_out}");
    if !unread.is_refused {
        draft.moves();
        return message;
    }
    let shown = draft.status.condition(conditions::STALLED);
    if shown.is_some_and(|c| c.message.starts_with(what)) {
        return draft.stall(reasons::FOREIGN, &message);
    }
    // What is not known may be another thing than before, with another way out.
    draft.stall_with(reasons::FOREIGN, &message);
    message
}

/// What shows that another program runs the submission.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Found {
    Row {
        status: String,
        since: Option<String>,
    },
    /// Objects, the newest of this moment; from `until` on they are those of a run that has ended.
    Objects {
        newest: Timestamp,
        until: Timestamp,
    },
}

impl Found {
    fn message(&self, prefix: &str) -> String {
        let adoption = adoption();
        match self {
            Self::Row { status, since } => {
                let since = since
                    .as_ref()
                    .map(|since| format!(" since {since}"))
                    .unwrap_or_default();
                format!(
                    "The table's row says {status}{since} and is not this operator's, since it has no column attempt: another \
                     program runs the submission. It goes on when the row's submission_status is FINISHED, FAILED or \
                     CANCELLED. If nothing runs it any more, set that to FAILED, or {adoption}"
                )
            }
            Self::Objects { newest, until } => format!(
                "The newest object below {prefix} is of {newest:.0}, and none has this operator's mark: another program may run the \
                 submission. It goes on at {until:.0} if nothing more is stored there. If nothing runs it any more, {adoption}"
            ),
        }
    }
}

/// How a person hands a submission over.
fn adoption() -> String {
    format!(
        "annotate the Submission with {}=true: it then takes up what is stored.",
        names::ANNOTATION_ADOPT
    )
}

/// What shows that another program runs the submission; `window` is how many seconds an object may be the newest of a live run.
pub(super) fn found(traces: &Traces, info: &EvalaiInfo, window: i64, now: Timestamp) -> Option<Found> {
    match &traces.row {
        // The row decides: the old pipeline writes it before all else, and at the end.
        Some(row) => of_row(row),
        None => of_objects(&traces.stored, info, window, now),
    }
}

fn of_row(row: &ObservedRow) -> Option<Found> {
    let is_under_way = UNDER_WAY.contains(&row.status.as_str());
    let line = |text: &String| one_line(text, LONGEST_NAME);
    (is_under_way && !row.is_ours).then(|| Found::Row {
        status: row.status.clone(),
        since: row.since.as_ref().map(line),
    })
}

fn of_objects(stored: &StoredRun, info: &EvalaiInfo, window: i64, now: Timestamp) -> Option<Found> {
    let newest = stored.newest.filter(|_| !stored.is_ours && !stored.has_ended)?;
    // EvalAI resumes only what has failed: what was stored before is of a run that has ended.
    let resumed = info.resumed_at.filter(|_| info.standing == Standing::Resumed);
    let until = after(newest, window);
    let is_of_ended = resumed.is_some_and(|at| newest < at) || now >= until;
    (!is_of_ended).then_some(Found::Objects { newest, until })
}
