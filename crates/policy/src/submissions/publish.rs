//! The report of an end to other systems: EvalAI first, then the table's row.
//!
//! The cancel race ([`CancelRace`]): EvalAI's own end wins until our result is answered (`amend`), and changes no state after it
//! (`note_late_cancel`).

use std::time::Duration;

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;

use super::plan::{Action, EvalaiUpdate, TableUpdate};
use super::run::report_of_end;
use super::status::PlanBuilder;
use super::waits::{Wait, after};
use super::{gates, leave, logs, stop};
use crate::leaderboards::view::previous_controller;
use crate::view::{EvalaiEnd, EvalaiView, ObservedLog};
use leaderboard_api::conditions::{self, Truth};
use leaderboard_api::evalai_status::Status;
use leaderboard_api::text::sentence;
use leaderboard_api::{Reason, State, SubmissionStatus};

const SENT_AGAIN: &str = "EvalAI may have lost its own end of this submission: one of our requests may have overwritten it, or \
                           the submission was deleted before its end. EvalAI is read again, and `cancelled` is written if \
                           needed.";

/// Decides for a submission in a terminal state.
pub(super) fn decide(draft: &mut PlanBuilder<'_>) {
    leave::leave_job(draft);
    leave::show_refused_attempt(draft);
    // Before EvalAI has the end, since its hosts read it there.
    let log_left = keep_at_end(draft);
    let published = publish(draft, log_left);
    // The row follows EvalAI's word, which may still turn the end into Cancelled; a refusal is a word too.
    let recorded = match published {
        Delivery::Waiting => {
            follow_evalai(draft);
            false
        }
        Delivery::Answered(at) => record(draft, draft.now() >= Wait::TOGETHER.shown_at(at)) == Delivery::Done,
        Delivery::Done | Delivery::Refused => record(draft, true) == Delivery::Done,
    };
    if let Delivery::Answered(at) = published {
        show_published(draft, at, recorded);
    }
    if let Some(left) = log_left {
        draft.requeue_in(left);
    }
    let is_published = matches!(published, Delivery::Done | Delivery::Answered(_));
    let complete = is_published && recorded && log_left.is_none();
    if complete {
        draft.act(Action::Forget);
        leave::delete_in_time(draft);
        leave::remove_job_in_time(draft);
    } else {
        draft.look_again(Wait::DELIVERY);
    }
    leave::release(draft, complete);
}

/// How far another system is with the end.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Delivery {
    /// It knows the end, or need not.
    Done,
    /// It has answered so at this time, which the status does not show yet.
    Answered(Timestamp),
    /// It will not take it.
    Refused,
    Waiting,
}

/// Shows that EvalAI has the end. The table's answer is waited for, so that both are one write.
fn show_published(draft: &mut PlanBuilder<'_>, at: Timestamp, recorded: bool) {
    if !recorded && draft.waits_until(Wait::TOGETHER.shown_at(at)) {
        return;
    }
    draft.status.times.published = Some(Time(at));
    let team = draft.view.evalai.as_ref().and_then(|evalai| evalai.team_id.clone());
    published(draft, team.as_deref());
}

/// A Leaderboard that is gone can't show what is wanted: what was decided before stands, and what never ran needs nothing.
fn without_leaderboard(draft: &mut PlanBuilder<'_>, type_: &str) -> Delivery {
    if draft.status.is_delivered(type_) {
        return Delivery::Done;
    }
    let message = draft.no_leaderboard();
    draft.condition(type_, Truth::False, Reason::LeaderboardNotFound, &message);
    if draft.status.plan.is_none() {
        Delivery::Done
    } else {
        Delivery::Waiting
    }
}

/// The cancel race: EvalAI may end a submission while our own end is decided, on its way, or there.
#[derive(Clone, Copy, PartialEq, Eq)]
enum CancelRace {
    /// No end is ours to send: EvalAI's was first, or the row is another phase's or program's. The condition shows this.
    NotOurs(&'static str),
    /// EvalAI's end was first, and a write of ours may have undone it: `cancelled` is sent.
    Overtaken,
    /// EvalAI has our end. A cancel after it changes no state.
    Over,
    /// Our end is on its way, and EvalAI's answer decides.
    Open,
}

fn cancel_race(draft: &PlanBuilder<'_>) -> CancelRace {
    let end = draft.status.condition(conditions::FINISHED);
    let is_evalais = end.is_some_and(|c| c.reason == Reason::EndedInEvalAI);
    let is_overtaken = is_evalais && is_overtaken(draft);
    // One that was deleted before its end is ended there all the same: EvalAI counts it against its team until then.
    let is_ours = draft.spec().evalai.is_some() && (is_overtaken || !is_of_another_phase(draft));
    if is_ours && draft.is_held() {
        CancelRace::NotOurs(gates::NOT_WRITTEN)
    } else if !is_ours || (is_evalais && !is_overtaken) || draft.observes() {
        CancelRace::NotOurs("")
    } else if draft.status.is_delivered(conditions::PUBLISHED) {
        CancelRace::Over
    } else if is_overtaken {
        CancelRace::Overtaken
    } else {
        CancelRace::Open
    }
}

fn publish(draft: &mut PlanBuilder<'_>, log_left: Option<Duration>) -> Delivery {
    let race = cancel_race(draft);
    match race {
        CancelRace::NotOurs(message) => {
            draft.condition(conditions::PUBLISHED, Truth::False, Reason::NotRequired, message);
            return Delivery::Done;
        }
        CancelRace::Over => {
            note_late_cancel(draft);
            return Delivery::Done;
        }
        CancelRace::Overtaken | CancelRace::Open => {}
    }
    if draft.leaderboard().is_none() {
        return without_leaderboard(draft, conditions::PUBLISHED);
    }
    let view = draft.view.evalai.clone().unwrap_or_default();
    match view.end {
        Some(EvalaiEnd::Published { at }) => Delivery::Answered(at),
        Some(EvalaiEnd::Ended(status)) => amend(draft, status),
        Some(EvalaiEnd::Refused { message }) => {
            refused(draft, &message);
            Delivery::Refused
        }
        None => {
            send_end(draft, view, race == CancelRace::Overtaken, log_left);
            Delivery::Waiting
        }
    }
}

/// Shows that EvalAI has cancelled a result that it had, as a host's re-run does. State, score and row stay.
fn note_late_cancel(draft: &mut PlanBuilder<'_>) {
    let listed = draft.view.evalai.as_ref().and_then(|evalai| evalai.cancelled_as_of);
    let (Some(listed), Some(published)) = (listed, draft.status.times.published.as_ref()) else {
        return;
    };
    if !draft.is_successful() || !draft.status.is_true(conditions::PUBLISHED) {
        return;
    }
    // The status has whole seconds. An older list shows what the result has replaced, and the next one wakes for no id a second time.
    if listed > after(published.0, 1) {
        draft.condition(conditions::PUBLISHED, Truth::False, Reason::CancelledInEvalAI, "");
    } else {
        draft.look_again(Wait::DELIVERY);
    }
}

/// Sends the end with all that belongs to it, once that is there. Returns why it cannot be read.
fn send_result(draft: &mut PlanBuilder<'_>, log_left: Option<Duration>) -> Option<String> {
    if let Err(why) = report_of_end(draft) {
        return why;
    }
    if log_left.is_none() {
        draft.act(Action::UpdateEvalai(match draft.status.state_of_conditions() {
            State::Finished => EvalaiUpdate::Finished,
            State::Cancelled => EvalaiUpdate::Cancelled,
            _ => EvalaiUpdate::Failed,
        }));
    }
    None
}

/// Sends the end, and shows that EvalAI does not have it yet.
fn send_end(draft: &mut PlanBuilder<'_>, evalai: EvalaiView, is_overtaken: bool, log_left: Option<Duration>) {
    let why = send_result(draft, log_left).or(evalai.unread);
    let unread = why.map(|why| cannot_be_read(draft, conditions::PUBLISHED, &why));
    let failed = evalai
        .error
        .map(|e| format!("The last request failed: {}", sentence(&e)));
    let (reason, message) = if is_overtaken {
        let message = failed.unwrap_or_else(|| SENT_AGAIN.to_owned());
        (Reason::ConcurrentUpdate, message)
    } else if let Some(until) = evalai.writes_from {
        draft.requeue_at(until);
        (Reason::WaitingForPreviousController, previous_controller(until))
    } else if let Some(unread) = unread.filter(|_| failed.is_none()) {
        (Reason::Unread, unread)
    } else {
        (Reason::Waiting, failed.unwrap_or_default())
    };
    draft.condition(conditions::PUBLISHED, Truth::False, reason, &message);
}

/// EvalAI has the end. Its row may by now be another team's, to whom EvalAI shows the result: participants can edit it.
fn published(draft: &mut PlanBuilder<'_>, team: Option<&str>) {
    let ours = draft.status.team.as_ref().and_then(|team| team.id.as_deref());
    let moved = ours.zip(team).filter(|(ours, theirs)| ours != theirs);
    let message = moved.map(|(ours, theirs)| {
        format!(
            "The submission was moved to team {theirs} in EvalAI, which shows the result there; it was run and recorded for team \
             {ours}. Set the team back in EvalAI, or correct the table."
        )
    });
    let left_out = draft.view.report.ours().and_then(|report| report.left_out.as_deref());
    let shown = message.as_deref().or(left_out).unwrap_or_default().to_owned();
    draft.condition(conditions::PUBLISHED, Truth::True, Reason::Published, &shown);
    if let Some(message) = message {
        draft.event(true, Reason::TeamDiffers, message);
    }
}

/// True if it was taken back before it was ever accepted, because EvalAI's row is another phase's: the row is not ours to end.
fn is_of_another_phase(draft: &PlanBuilder<'_>) -> bool {
    let accepted = draft.status.condition(conditions::ACCEPTED);
    let differs = accepted.is_some_and(|c| c.reason == Reason::PhaseDiffers);
    differs && draft.status.plan.is_none() && draft.status.state_of_conditions() == State::Cancelled
}

/// The message for an end that cannot be read. The first text stands: another one for the same would be a write each time.
fn cannot_be_read(draft: &PlanBuilder<'_>, type_: &str, why: &str) -> String {
    let known = draft.status.condition(type_).filter(|c| c.reason == Reason::Unread);
    known.map_or_else(
        || {
            format!(
                "The stored result cannot be read: {} It is published when it can; look at the bucket.",
                sentence(why)
            )
        },
        |c| c.message.to_string(),
    )
}

/// True if EvalAI's own end may have been undone by a write of ours that was under way. The condition remembers it.
fn is_overtaken(draft: &PlanBuilder<'_>) -> bool {
    let published = draft.status.condition(conditions::PUBLISHED);
    draft.view.evalai.as_ref().is_some_and(|e| e.overtaken)
        || published.is_some_and(|c| c.reason == Reason::ConcurrentUpdate)
}

fn refused(draft: &mut PlanBuilder<'_>, message: &str) {
    let message = format!(
        "EvalAI does not take the result: {} Compare its metrics with the leaderboard of the phase; it is tried again \
         from time to time.",
        sentence(message)
    );
    let known = draft.status.condition(conditions::PUBLISHED);
    let is_new = known.is_none_or(|c| c.reason != Reason::Refused);
    draft.condition(conditions::PUBLISHED, Truth::False, Reason::Refused, &message);
    if is_new {
        draft.event(true, Reason::Refused, message);
    }
}

/// EvalAI had ended it first: its cancel wins until our result is answered, so that all systems agree.
fn amend(draft: &mut PlanBuilder<'_>, status: Status) -> Delivery {
    draft.condition(conditions::PUBLISHED, Truth::False, Reason::NotRequired, "");
    if draft.status.state_of_conditions() == State::Cancelled {
        keep_evalais_end(draft, status);
        return Delivery::Done;
    }
    draft.status.failure = None;
    let message = format!("EvalAI shows {status}, so the result is not published.");
    draft.ends(Reason::EndedInEvalAI, &message);
    draft.show(Reason::EndedInEvalAI, message);
    // While EvalAI refused the result, the table was handed the outcome that no longer holds; the status may not show that yet.
    let is_written = draft.view.record.as_ref().is_some_and(|row| row.end_written);
    if !is_written && !draft.status.is_true(conditions::RECORDED) && superseded(draft).is_none() {
        return Delivery::Done;
    }
    draft.condition(conditions::RECORDED, Truth::False, Reason::Waiting, "");
    draft.act(Action::Record(TableUpdate::End));
    Delivery::Waiting
}

/// A cancel of what EvalAI calls finished: that is kept, and the object says whose end holds.
fn keep_evalais_end(draft: &mut PlanBuilder<'_>, status: Status) {
    let end = draft.status.condition(conditions::FINISHED);
    let is_ours = end.is_some_and(|end| end.reason != Reason::EndedInEvalAI);
    if is_ours && status == Status::Finished {
        let message = format!("EvalAI showed {status} before the submission was run here; that is kept.");
        draft.ends(Reason::EndedInEvalAI, &message);
        draft.show(Reason::EndedInEvalAI, message);
    }
}

/// Requests the log of a run that has failed, until EvalAI's answer to the end is known: its hosts read it there. Returns how
/// long EvalAI waits for it.
fn keep_at_end(draft: &mut PlanBuilder<'_>) -> Option<Duration> {
    let before = draft.view.submission.status.as_ref();
    let has_just_ended = !before.is_some_and(SubmissionStatus::has_ended);
    let is_published = before.is_some_and(|s| s.is_delivered(conditions::PUBLISHED));
    let is_answered = draft.view.evalai.as_ref().is_some_and(|e| e.end.is_some());
    let is_awaited = draft.spec().evalai.is_some() && !is_published && !is_answered;
    if is_awaited || (has_just_ended && !is_answered) {
        let places = logs::log_places(&draft.status, draft.view.pod.as_ref());
        if !places.is_empty() {
            draft.act(Action::KeepLog { places });
            // The known log is from before the end.
            let log = if has_just_ended {
                ObservedLog::NotRequested
            } else {
                draft.view.requested.log
            };
            return stop::log_left(log, Wait::LOG.left(Duration::ZERO));
        }
    }
    stop::log_left(draft.view.requested.log, None).filter(|_| !has_just_ended)
}

/// Shown while the row may still turn out otherwise.
const FOLLOWS_EVALAI: &str = "The table's row is written when EvalAI has answered, since EvalAI may still have cancelled the submission. The \
                              condition Published shows what EvalAI is waited for.";

/// Shown while the row is on its way.
const IN_LINE: &str = "The row waits for the table, which takes one row after the other.";

/// Writes the row of an end on which EvalAI has had its word. `is_shown`: the status shows that word. Until then its text about the row stays,
/// which saves a write.
fn record(draft: &mut PlanBuilder<'_>, is_shown: bool) -> Delivery {
    if draft.status.is_true(conditions::RECORDED) {
        return Delivery::Done;
    }
    if draft.leaderboard().is_none() {
        return without_leaderboard(draft, conditions::RECORDED);
    }
    if let Some((reason, message)) = why_without_row(draft) {
        draft.condition(conditions::RECORDED, Truth::False, reason, &message);
        return Delivery::Done;
    }
    let view = draft.view.record.clone().unwrap_or_default();
    if view.end_written {
        draft.condition(conditions::RECORDED, Truth::True, Reason::Recorded, "");
        return Delivery::Done;
    }
    // Only the row of a finished submission has metrics.
    let read = if draft.is_successful() {
        report_of_end(draft)
    } else {
        Ok(())
    };
    if read.is_ok() {
        draft.act(Action::Record(TableUpdate::End));
    }
    let unread = read.err().flatten();
    let (reason, message) = match view.error {
        Some(error) => (
            Reason::Refused,
            format!(
                "The last write failed: {} It is tried again; look at the table and the operator's rights.",
                sentence(&error)
            ),
        ),
        None => match unread {
            Some(why) => (Reason::Unread, cannot_be_read(draft, conditions::RECORDED, &why)),
            None if is_shown => (Reason::Waiting, IN_LINE.to_owned()),
            None => (Reason::Waiting, FOLLOWS_EVALAI.to_owned()),
        },
    };
    draft.condition(conditions::RECORDED, Truth::False, reason, &message);
    Delivery::Waiting
}

/// The reason and the message of an end that has no row of its own; None if it has one, or will.
fn why_without_row(draft: &PlanBuilder<'_>) -> Option<(Reason, String)> {
    let message = if draft.view.record.is_none() {
        ""
    } else if draft.is_held() {
        gates::NOT_WRITTEN
    } else if draft.status.plan.is_none() {
        "The submission was never accepted, so the table has no row for it."
    } else if !draft.has_row() {
        "The row needs a team: give spec.team.id to a submission that is not EvalAI's. A check has none."
    } else {
        return superseded(draft).map(|message| (Reason::Superseded, message));
    };
    Some((Reason::NotRequired, message.to_owned()))
}

/// Shows that the row waits for EvalAI, where there will be one.
fn follow_evalai(draft: &mut PlanBuilder<'_>) {
    let known = draft.status.condition(conditions::RECORDED);
    let is_waiting = known.is_some_and(|known| known.reason.is_one_of(&[Reason::Waiting, Reason::Unread]));
    if is_waiting && draft.leaderboard().is_some() && why_without_row(draft).is_none() {
        draft.condition(conditions::RECORDED, Truth::False, Reason::Waiting, FOLLOWS_EVALAI);
    }
}

/// The message for an end over which the table keeps another row: another try would be refused again. The recorder knows until it has forgotten
/// the end, then the status.
fn superseded(draft: &PlanBuilder<'_>) -> Option<String> {
    if let Some(kept) = draft.view.record.as_ref().and_then(|row| row.superseded_by) {
        let next = kept.saturating_add(1);
        return Some(format!(
            "The table keeps another row of this run, of attempt {kept}, and this end was not written there. Raise spec.attempt to {next} if \
             the submission is to go on. Correct the row by hand if this end is the one that counts."
        ));
    }
    let shown = draft.status.condition(conditions::RECORDED)?;
    (shown.reason == Reason::Superseded).then(|| shown.message.to_string())
}
