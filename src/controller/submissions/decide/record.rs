//! The row of an end in the table, which follows EvalAI's word.

use super::gates;
use super::plan::{Action, TableUpdate};
use super::publish::{Delivery, cannot_be_read, without_leaderboard};
use super::run::{self, Reading};
use super::status::PlanBuilder;
use leaderboard_api::conditions::{self, Truth};
use leaderboard_api::reasons;
use leaderboard_api::text::sentence;

/// How the message begins of an end that is settled without a row: another try would be refused again.
const SUPERSEDED: &str = "The table keeps another row of this run";
/// Shown while the row may still turn out otherwise.
const FOLLOWS_EVALAI: &str = "The table's row is written when EvalAI has answered, since EvalAI may still have cancelled the submission. The \
                              condition Published shows what EvalAI is waited for.";
/// Shown while the row is on its way.
const IN_LINE: &str = "The row waits for the table, which takes one row after the other.";

/// Writes the row of an end on which EvalAI has had its word. `is_shown`: the status shows that word. Until then its text about the row stays,
/// which saves a write.
pub(super) fn decide(draft: &mut PlanBuilder<'_>, is_shown: bool) -> Delivery {
    if draft.status.is_true(conditions::RECORDED) {
        return Delivery::Done;
    }
    if draft.leaderboard().is_none() {
        return without_leaderboard(draft, conditions::RECORDED);
    }
    if let Some(message) = why_without_row(draft) {
        draft.condition(conditions::RECORDED, Truth::False, reasons::NOT_REQUIRED, &message);
        return Delivery::Done;
    }
    let view = draft.view.record.clone().unwrap_or_default();
    if view.end_written {
        draft.condition(conditions::RECORDED, Truth::True, reasons::RECORDED, "");
        return Delivery::Done;
    }
    let mut unread = None;
    match row_of_end(draft) {
        Reading::Waits(why) => unread = why.map(|why| cannot_be_read(draft, conditions::RECORDED, &why)),
        Reading::Done => record_end(draft),
    }
    let (reason, message) = match view.error {
        Some(error) => (
            reasons::REFUSED,
            format!(
                "The last write failed: {} It is tried again; look at the table and the operator's rights.",
                sentence(&error)
            ),
        ),
        None => (
            reasons::WAITING,
            unread.unwrap_or_else(|| (if is_shown { IN_LINE } else { FOLLOWS_EVALAI }).to_owned()),
        ),
    };
    draft.condition(conditions::RECORDED, Truth::False, reason, &message);
    Delivery::Waiting
}

/// Why the end has no row of its own; none if it has one, or will.
fn why_without_row(draft: &PlanBuilder<'_>) -> Option<String> {
    if draft.view.record.is_none() {
        Some(String::new())
    } else if gates::is_held(draft) {
        Some(gates::NOT_WRITTEN.to_owned())
    } else if draft.status.plan.is_none() {
        Some("The submission was never accepted, so the table has no row for it.".to_owned())
    } else if !has_row(draft) {
        Some(
            "The row needs a team: give spec.team.id to a submission that is not EvalAI's. A check has none."
                .to_owned(),
        )
    } else {
        superseded(draft)
    }
}

/// Whether the table has a row for it: without a team's id, as a check has none, there is no key.
pub(super) fn has_row(draft: &PlanBuilder<'_>) -> bool {
    let team = draft.status.team.as_ref();
    draft.view.record.is_some() && team.is_some_and(|team| team.id.is_some())
}

pub(super) fn record_end(draft: &mut PlanBuilder<'_>) {
    draft.act(Action::Record(TableUpdate::End));
}

/// Whether all that the row shows is there: only that of a finished submission has metrics.
fn row_of_end(draft: &mut PlanBuilder<'_>) -> Reading {
    if draft.is_successful() {
        run::report_of_end(draft)
    } else {
        Reading::Done
    }
}

/// Shows that the row waits for EvalAI, where there will be one.
pub(super) fn follow_evalai(draft: &mut PlanBuilder<'_>) {
    let known = draft.status.condition(conditions::RECORDED);
    let is_waiting = known.is_some_and(|known| known.reason == reasons::WAITING);
    if is_waiting && draft.leaderboard().is_some() && why_without_row(draft).is_none() {
        draft.condition(conditions::RECORDED, Truth::False, reasons::WAITING, FOLLOWS_EVALAI);
    }
}

/// Shows that the table keeps another row than that of this end: the recorder knows until it has forgotten the end, then the status.
pub(super) fn superseded(draft: &PlanBuilder<'_>) -> Option<String> {
    if let Some(kept) = draft.view.record.as_ref().and_then(|row| row.superseded_by) {
        let next = kept.saturating_add(1);
        return Some(format!(
            "{SUPERSEDED}, of attempt {kept}, and this end was not written there. Raise spec.attempt to {next} if the submission is to \
             go on. Correct the row by hand if this end is the one that counts."
        ));
    }
    let shown = draft.status.condition(conditions::RECORDED)?;
    let is_shown = shown.reason == reasons::NOT_REQUIRED && shown.message.starts_with(SUPERSEDED);
    is_shown.then(|| shown.message.to_string())
}
