//! The gates between acceptance and a Job: another program's run, a Leaderboard that is ready, its NetworkPolicy, a slot, the submitted file.

pub(super) mod input;
pub(super) mod slot;

use std::fmt;

use super::failure::infrastructure;
use super::plan::{Action, Question};
use super::status::PlanBuilder;
use super::waits::Wait;
use super::{end, run, stop};
use crate::ask::{Answered, Failure};
use crate::questions::{ForeignRun, Row};
use crate::view::{JobView, PodView};
use leaderboard_api::conditions::{self, Truth};
use leaderboard_api::text::{LONGEST_NAME, one_line, sentence};
use leaderboard_api::{PolicySource, Reason, names};
use leaderboard_contract::verdict::WorkspaceReason;

/// Faults of the Leaderboard with which no Job can be made, or none may. The others speak for themselves where they hurt.
pub(super) fn waits_for_leaderboard(draft: &mut PlanBuilder<'_>) -> bool {
    const BLOCKS: [Reason; 4] = [
        Reason::ClaimsNotServed,
        Reason::ClaimTemplateMissing,
        Reason::InvalidPod,
        Reason::PrefixConflict,
    ];
    let board = draft.view.leaderboard.as_ref();
    let ready = board.and_then(|board| board.condition(conditions::READY));
    let blocks = ready.filter(|c| c.status == "False" && c.reason.is_one_of(&BLOCKS));
    let Some(why) = blocks.map(|c| leaderboard_not_ready(draft, &c.reason, &c.message)) else {
        return false;
    };
    draft.refuse(Reason::LeaderboardNotReady, &why);
    true
}

pub(super) fn leaderboard_not_ready(draft: &PlanBuilder<'_>, reason: impl fmt::Display, why: &str) -> String {
    format!(
        "Leaderboard {} is not ready ({reason}): {} Fix it, and the submission goes on.",
        draft.spec().leaderboard_name,
        sentence(why)
    )
}

/// A Leaderboard and its first submission may come together: that the policy takes a moment then is no news.
pub(super) fn waits_for_policy(draft: &mut PlanBuilder<'_>) -> bool {
    let Some((missing, is_refused)) = missing_policy(draft) else {
        return false;
    };
    let created = draft.submission().metadata.creation_timestamp.as_ref();
    let until = Wait::POLICY.shown_at(created.map_or(draft.now(), |time| time.0));
    let reason = if !is_refused && draft.waits_until(until) {
        Reason::Preparing
    } else {
        Reason::NotIsolated
    };
    draft.refuse(reason, &missing);
    true
}

/// The message for a row of another phase than the Submission's: its run would count for neither.
fn foreign_phase(draft: &PlanBuilder<'_>) -> Option<String> {
    let evalai = draft.spec().evalai?;
    let (pk, ours) = (evalai.submission, evalai.phase);
    let theirs = draft.evalai_info()?.phase.filter(|theirs| *theirs != ours)?;
    Some(format!(
        "In EvalAI submission {pk} belongs to phase {theirs}, not to phase {ours} of this Submission, so it is not run."
    ))
}

/// True if the row is of another phase, and has to be of ours again. The object may have been applied with a wrong phase, so nothing
/// is reported at once; but the participant's submission does not wait for an end without limit.
pub(super) fn waits_for_phase(draft: &mut PlanBuilder<'_>) -> bool {
    let Some(what) = foreign_phase(draft) else {
        return false;
    };
    let message = format!(
        "{what} Set phase {} back in EvalAI, or delete this Submission and apply it with the right phase; after {} min it \
         fails, uncharged.",
        draft.spec().evalai.map_or(0, |evalai| evalai.phase),
        Wait::PHASE.longest / 60
    );
    let message = draft.stall(Reason::PhaseDiffers, &message);
    let since = draft.blocked_since(Reason::PhaseDiffers).unwrap_or(draft.now());
    let until = Wait::PHASE.over_at(since);
    if draft.waits_until(until) {
        draft.refuse(Reason::PhaseDiffers, &message);
    } else {
        end::failed(draft, infrastructure(Reason::PhaseDiffers, &what));
    }
    true
}

/// Why no Job may be made, if the policy is not in place. True if it could not be applied: waiting alone does not help then. It is restored by
/// the Leaderboard's reconcile, which wakes the submission.
fn missing_policy(draft: &PlanBuilder<'_>) -> Option<(String, bool)> {
    let leaderboard = draft.view.leaderboard.as_ref()?;
    let is_managed = leaderboard.spec.network.policy == PolicySource::Managed;
    if !is_managed || draft.view.is_policy_in_place {
        return None;
    }
    let name = &draft.spec().leaderboard_name;
    let isolated = leaderboard.condition(conditions::ISOLATED);
    let why = isolated.filter(|c| c.status == "False" && c.observed_generation == leaderboard.metadata.generation);
    let message = match why {
        Some(c) => format!(
            "The NetworkPolicy of Leaderboard {name} is not in place ({}): {} The submission goes on once it is.",
            c.reason,
            sentence(&c.message)
        ),
        None => format!(
            "The NetworkPolicy of Leaderboard {name} is not in place yet; the submission goes on once it is. If this lasts, look \
             at the Leaderboard's condition Isolated; `helm test` names a missing right."
        ),
    };
    Some((message, why.is_some()))
}

/// True if no Job may be made at the moment, because of its Leaderboard.
pub(super) fn is_held_up(draft: &mut PlanBuilder<'_>) -> bool {
    let (reason, why) = if draft.leaderboard().is_none() {
        (Reason::LeaderboardNotFound, draft.no_leaderboard())
    } else if let Some((missing, _)) = missing_policy(draft) {
        (Reason::NotIsolated, missing)
    } else {
        return false;
    };
    draft.stall_with(reason, &why);
    draft.show(reason, why);
    draft.look_again(Wait::SLOT);
    true
}

/// Why an end of what was held back is written to no other system.
pub(super) const NOT_WRITTEN: &str = "Nothing is written of this end, because another program may run the submission. If none does, \
                                      cancel it in EvalAI.";

/// True if the submission is held back, or that is not known yet.
pub(super) fn waits_for_other_program(draft: &mut PlanBuilder<'_>) -> bool {
    if draft.is_adopted() {
        return false;
    }
    if is_held_by_prefix(draft) {
        return true;
    }
    let Some(question) = question(draft) else {
        return false;
    };
    let view = draft.view;
    let answer = view.row.answer_to(&question);
    match answer.map(|answer| (answer, answer.result.as_ref())) {
        Some((answer, Ok(None))) => return awaits_evalai(draft, answer),
        Some((_, Ok(Some(run)))) => {
            draft.moves();
            draft.refuse(Reason::Foreign, &message_of(run));
        }
        Some((_, Err(failure))) => {
            let message = not_known(draft, failure);
            draft.refuse(Reason::Foreign, &message);
        }
        None => show_reading(draft),
    }
    draft.act(Action::Ask(Question::Row(Box::new(question))));
    true
}

/// Where another program's row would be. None: there is no table, no other program gets the submission, or a run of ours has begun.
fn question(draft: &PlanBuilder<'_>) -> Option<Row> {
    let team = &draft.evalai_info()?.team_id;
    let table = draft.leaderboard()?.dynamo_table()?;
    // One that observes runs what another program runs, on purpose, and writes nothing.
    let is_asked = draft.status.plan.is_none() && !draft.observes() && !team.is_empty();
    is_asked.then(|| Row {
        attempt: draft.status.attempt.unwrap_or_default(),
        table: table.clone(),
        team: team.clone(),
        run_id: draft.submission().run_id(),
    })
}

fn show_reading(draft: &mut PlanBuilder<'_>) {
    if draft.waits_quietly(Wait::ROW, draft.view.row.waited.unwrap_or_default()) {
        return;
    }
    let message = "The table is asked whether another program runs the submission, and has not answered yet.";
    draft.condition(conditions::ACCEPTED, Truth::Unknown, Reason::Foreign, message);
    draft.show(Reason::Foreign, message);
}

/// Another program ends its run in EvalAI first and in the row then: EvalAI decides by an answer that is newer than the row.
fn awaits_evalai(draft: &mut PlanBuilder<'_>, answer: &Answered<Row>) -> bool {
    let read_at = draft.view.evalai.as_ref().and_then(|evalai| evalai.read_at);
    let sent = draft.now().checked_sub(answer.sent_ago).unwrap_or(draft.now());
    if !draft.is_held() || read_at.is_some_and(|at| at >= sent) {
        return false;
    }
    draft.keeps_status();
    draft.act(Action::Ask(Question::EvalaiAnew));
    draft.look_again(Wait::ROW);
    true
}

/// While that cannot be known nothing starts: a second run would write over the results of the first.
fn not_known(draft: &mut PlanBuilder<'_>, failure: &Failure) -> String {
    let why = sentence(&failure.why);
    let message = format!(
        "The table does not show whether another program runs the submission: {why} It is read again every 30 s. To start the \
         submission all the same, {}",
        adoption()
    );
    if failure.is_refused {
        return draft.stall(Reason::Foreign, &message);
    }
    draft.moves();
    message
}

fn message_of(run: &ForeignRun) -> String {
    let since = run.since.as_ref().map(|since| one_line(since, LONGEST_NAME));
    let since = since.map(|since| format!(" since {since}")).unwrap_or_default();
    format!(
        "The table's row shows {}{since} and has no column attempt: another program runs the submission. It goes on when the row's \
         submission_status is FINISHED, FAILED or CANCELLED. If nothing runs it any more, set that to FAILED, or {}",
        run.status,
        adoption()
    )
}

/// How a person hands a submission over.
fn adoption() -> String {
    format!(
        "annotate the Submission with {}=true: it then takes up what is stored.",
        names::ANNOTATION_ADOPT
    )
}

/// True if a Pod of the submission found foreign results below the prefix, and no person has handed it over since.
fn is_held_by_prefix(draft: &PlanBuilder<'_>) -> bool {
    draft.status.plan.is_some() && draft.is_held()
}

/// The words of the Pod's `workspace`, if it has found results of something else below the prefix.
fn prefix_in_use(pod: &PodView) -> Option<&str> {
    let end = pod.container(names::CONTAINER_WORKSPACE)?.last.as_ref()?;
    let is_in_use = end.own_reason == Some(WorkspaceReason::PrefixInUse) && pod.agent_started.is_none();
    is_in_use.then(|| end.why.as_deref().unwrap_or_default())
}

/// Holds back a submission whose Pod has found the prefix in use, without an end, a retry or a write to EvalAI or table: its Job is
/// deleted. Returns whether it did.
pub(super) fn holds_back(draft: &mut PlanBuilder<'_>, job: &JobView) -> bool {
    if draft.is_to_stop() {
        return false;
    }
    if !is_held_by_prefix(draft) {
        let Some(found) = draft.view.pod.as_ref().and_then(prefix_in_use) else {
            return false;
        };
        let message = format!(
            "{} Nothing is run and nothing is written to EvalAI, table and bucket. Delete this Submission, or {}",
            sentence(found),
            adoption()
        );
        run::count_use(draft, draft.now());
        run::restart_clock(draft);
        draft.status.node_name = None;
        draft.condition(conditions::RUNNING, Truth::False, Reason::Foreign, "");
        draft.stall_with(Reason::Foreign, &message);
        draft.refuse(Reason::Foreign, &message);
    }
    // The next Job has the name of this one, so it waits until this one is gone.
    draft.status.job_name = None;
    if !job.deleting {
        draft.act(stop::delete(job, Wait::DELETION.longest));
    }
    draft.look_again(Wait::JOB);
    true
}

/// True until the pause after a failure that is not the participant's is over.
pub(super) fn waits_for_next_try(draft: &mut PlanBuilder<'_>) -> bool {
    let Some(at) = draft.status.next_retry_time.as_ref().map(|t| t.0) else {
        return false;
    };
    // A clock that was set back must not turn seconds into days.
    let latest = Wait::RETRY.over_at(draft.now());
    if at <= draft.now() || at > latest {
        return false;
    }
    if !draft.status.shows(Reason::Replacing) {
        let message = "The submission is tried again after a failure that is not the participant's.";
        draft.show(Reason::Replacing, message);
    }
    draft.requeue_at(at);
    true
}
