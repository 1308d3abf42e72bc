//! Rules for every reconcile in every world.

use std::collections::HashSet;

use crate::submissions::{Action, EvalaiUpdate, Plan, Question, decide, job_name};
use crate::view::{ObservedJob, ObservedNode, Standing, View};
use leaderboard_api::Reason;
use leaderboard_api::conditions::{self, FINISHED, PUBLISHED, RECORDED};
use leaderboard_api::reasons::Class;
use leaderboard_api::{FailureClass, PolicySource, ReasonName, State, SubmissionStatus};

/// Reconciles after which nothing may change any more in a world that stands still.
const SETTLED_AFTER: usize = 5;

/// Checks one reconcile, and that the world comes to rest after it.
pub fn check(view: &View, plan: &Plan) {
    terminal_states_stay(view, plan);
    one_job(view, plan);
    updates_fit(view, plan);
    logs_come_first(plan);
    only_what_every_system_has_is_deleted(view, plan);
    a_reporting_node_has_its_grace(view, plan);
    status_is_whole(plan);
    reasons_are_of_the_table(plan);
    conditions_are_conventional(plan);
    live_ones_are_looked_at_again(plan);
    a_wait_hears_evalai(view, plan);
    the_state_is_for_people(view, plan);
    comes_to_rest(view, plan);
}

/// No decision depends on the state that is stored.
fn the_state_is_for_people(view: &View, plan: &Plan) {
    let mut view = view.clone();
    if let Some(status) = &mut std::sync::Arc::make_mut(&mut view.submission).status {
        status.state = None;
    }
    // A new state replaces the stored one.
    let decided = decide(&view);
    let (write, requeue) = (plan.write, plan.requeue);
    let decided = Plan {
        write,
        requeue,
        ..decided
    };
    assert_eq!(decided, *plan);
}

fn is_finished(status: &SubmissionStatus) -> bool {
    conditions::is_true(&status.conditions, FINISHED)
}

fn terminal_states_stay(view: &View, plan: &Plan) {
    let Some(before) = view.submission.status.as_ref().filter(|s| is_finished(s)) else {
        return;
    };
    let after = &plan.status;
    let is_resumed = before.state != Some(State::Finished) && Some(view.submission.spec.attempt) > before.attempt;
    if is_resumed {
        assert_eq!(after.attempt, Some(view.submission.spec.attempt));
        assert_eq!(after.state, Some(State::Pending));
        assert!(!is_finished(after));
        return;
    }
    assert!(is_finished(after), "left a terminal state: {after:?}");
    assert_eq!(after.attempt, before.attempt);
    let may_amend = !conditions::is_true(&before.conditions, PUBLISHED) && after.state == Some(State::Cancelled);
    assert!(
        after.state == before.state || may_amend,
        "{:?} -> {:?}",
        before.state,
        after.state
    );
}

fn one_job(view: &View, plan: &Plan) {
    let created = plan.actions.iter().filter_map(|a| match a {
        Action::CreateJob(number) => Some(*number),
        _ => None,
    });
    let created: Vec<_> = created.collect();
    assert!(created.len() <= 1, "two Jobs in one pass");
    if let Some(number) = created.first() {
        assert!(
            !matches!(view.job, ObservedJob::Ours(_) | ObservedJob::Created),
            "a second Job next to the present one"
        );
        assert!(!is_finished(&plan.status));
        assert_eq!(plan.status.job_number(), *number);
        assert_eq!(plan.status.job_name, Some(job_name("sub", &plan.status)));
        assert!(plan.status.plan.is_some(), "a Job without a plan");
        let leaderboard = view.leaderboard.as_ref().expect("a Job without a Leaderboard");
        let is_external = leaderboard.spec.network.policy == PolicySource::External;
        assert!(
            is_external || view.is_policy_in_place,
            "a Job without its NetworkPolicy"
        );
    }
    for action in &plan.actions {
        if let Action::DeleteJob { name, uid, .. } = action {
            let is_seen = matches!(&view.job, ObservedJob::Ours(job) if job.name == *name && job.uid == *uid);
            assert!(is_seen, "deletes a Job it does not see");
        }
    }
}

/// The log of a failure is kept before anything takes it away, and before the end is sent to EvalAI.
fn logs_come_first(plan: &Plan) {
    let place = plan.actions.iter().position(|a| matches!(a, Action::KeepLog { .. }));
    let Some(place) = place else { return };
    assert!(plan.status.failure.is_some(), "the log of no failure");
    let takes_it_away = |a: &Action| {
        matches!(
            a,
            Action::DeleteJob { .. } | Action::DeletePod { .. } | Action::UpdateEvalai(_) | Action::Forget
        )
    };
    let first = plan.actions.iter().position(takes_it_away);
    // A Job that shows up after the end is not the failed one.
    let is_over = is_finished(&plan.status);
    assert!(is_over || first.is_none_or(|first| place < first), "{:?}", plan.actions);
    let told = plan
        .actions
        .iter()
        .position(|a| matches!(a, Action::UpdateEvalai(_) | Action::Forget));
    assert!(told.is_none_or(|told| place < told), "{:?}", plan.actions);
}

/// A Submission is deleted only as it is stored: ended, known to every system that has to know it, and without a Job that runs.
fn only_what_every_system_has_is_deleted(view: &View, plan: &Plan) {
    let is_deletion = |action: &Action| matches!(action, Action::DeleteSubmission { .. });
    if !plan.actions.iter().any(is_deletion) {
        return;
    }
    let stored = view.submission.status.as_ref().expect("a status");
    assert_eq!(*stored, plan.status, "something is still to be stored");
    assert!(is_finished(stored));
    for system in [PUBLISHED, RECORDED] {
        let condition = conditions::get(&stored.conditions, system).expect("a condition");
        let has_it =
            condition.status == "True" || condition.reason.is_one_of(&[Reason::NotRequired, Reason::Superseded]);
        assert!(has_it, "{condition:?}");
    }
    let runs = matches!(&view.job, ObservedJob::Ours(job) if job.end.is_none());
    assert!(!runs, "its Job runs");
}

/// As long as its kubelet reports, a Pod that the operator does not stop has the whole of its grace.
fn a_reporting_node_has_its_grace(view: &View, plan: &Plan) {
    let before = view.submission.status.clone().unwrap_or_default();
    let is_live = !is_finished(&before) && before.failure.is_none();
    let is_lost = plan
        .status
        .failure
        .as_ref()
        .is_some_and(|f| f.reason == Reason::NodeLost);
    if let (true, true, Some(pod)) = (is_live, is_lost, &view.pod) {
        let by = pod.delete_by.expect("only a Pod that is being deleted is given up");
        assert!(
            view.node.state != ObservedNode::Reports || view.now > by,
            "given up within its grace"
        );
    }
}

fn updates_fit(view: &View, plan: &Plan) {
    let before = view.submission.status.as_ref();
    let is_new_attempt = before.is_some_and(|s| s.attempt.is_some() && s.attempt != plan.status.attempt);
    for action in &plan.actions {
        let Action::UpdateEvalai(update) = action else { continue };
        assert!(
            view.submission.spec.evalai.is_some(),
            "updates EvalAI for a local submission"
        );
        assert!(!is_new_attempt, "what was seen is the old attempt's");
        let state = plan.status.state;
        let fits = match update {
            EvalaiUpdate::Queued => state == Some(State::Pending),
            EvalaiUpdate::Running | EvalaiUpdate::Partial { .. } => {
                matches!(state, Some(State::Running | State::Resumed))
            }
            EvalaiUpdate::Finished => state == Some(State::Finished),
            EvalaiUpdate::Failed => state == Some(State::Failed),
            EvalaiUpdate::Cancelled => state == Some(State::Cancelled),
        };
        assert!(fits, "{update:?} in {state:?}");
    }
}

fn status_is_whole(plan: &Plan) {
    let status = &plan.status;
    let waits = |action: &Action| {
        matches!(
            action,
            Action::JoinLine(_) | Action::Ask(Question::Evalai | Question::Row(_))
        )
    };
    if *status == SubmissionStatus::default() && plan.actions.iter().any(waits) {
        // Nothing was written of it yet, and its place, or an answer of EvalAI or the table comes first.
        return;
    }
    let state = status.state.expect("a state");
    assert_eq!(
        state.is_terminal(),
        is_finished(status),
        "the state is computed from the conditions"
    );
    assert!(status.present_reason().is_some());
    assert_ne!(status.reason.as_ref().map(ReasonName::as_str), Some(state.as_str()));
    assert!(status.waiting.is_none() || state == State::Pending);
    let failure = status.failure.as_ref();
    let succeeded = status.condition(conditions::SUCCEEDED).map(|c| c.status.as_str());
    match state {
        State::Finished => assert_eq!(succeeded, Some("True")),
        State::Failed | State::Cancelled => assert_eq!(succeeded, Some("False")),
        _ => assert!(matches!(succeeded, None | Some("Unknown")), "{succeeded:?}"),
    }
    match state {
        State::Failed => assert!(failure.is_some(), "Failed without a failure"),
        State::Finished | State::Cancelled => assert_eq!(failure, None),
        _ => {}
    }
    if let Some(failure) = failure {
        let has_next_step = failure.message.contains(". ");
        assert!(
            !state.is_terminal() || has_next_step,
            "no next step: {}",
            failure.message
        );
    }
    if let Some(message) = &status.message {
        assert!(message.ends_with(['.', '…']), "no sentence: {message}");
        assert!(!message.contains(".."), "{message}");
    }
}

/// Each reason has a meaning and a next step, and that of a failure has its class.
fn reasons_are_of_the_table(plan: &Plan) {
    let status = &plan.status;
    let conditions = status.conditions.iter().map(|condition| &condition.reason);
    let events = plan.events.iter().map(|event| &event.reason);
    for reason in status.reason.iter().chain(conditions).chain(events) {
        assert!(reason.known().is_some(), "{reason} is not in the table of reasons");
    }
    if let Some(failure) = &status.failure {
        let known = failure.reason.known().expect("a reason of the table");
        let class = match failure.class {
            FailureClass::Participant => Class::Participant,
            FailureClass::Infrastructure => Class::Infrastructure,
        };
        let is_of_either = known.after_failure() != known.next_step();
        assert!(is_of_either || known.class() == class, "{failure:?}");
    }
}

fn conditions_are_conventional(plan: &Plan) {
    let mut seen = HashSet::new();
    for condition in &plan.status.conditions {
        assert!(seen.insert(&condition.type_), "{} twice", condition.type_);
        assert!(["True", "False", "Unknown"].contains(&condition.status.as_str()));
    }
}

fn live_ones_are_looked_at_again(plan: &Plan) {
    if !is_finished(&plan.status) {
        assert!(plan.requeue.is_some(), "forgotten while {:?}", plan.status.reason);
    }
}

/// A submission that EvalAI lets run ends when EvalAI ends it, at any wait: each reconcile looks for that end.
fn a_wait_hears_evalai(view: &View, plan: &Plan) {
    let Some(evalai) = view.evalai.as_ref().filter(|evalai| !evalai.cancelled) else {
        return;
    };
    let may_run = evalai
        .info
        .as_ref()
        .is_some_and(|info| info.standing != Standing::Ended);
    let (spec, status) = (&view.submission.spec, &plan.status);
    let is_to_stop = spec.cancel
        || view.submission.metadata.deletion_timestamp.is_some()
        || status.failure.is_some()
        || status.is_followed_by(spec.attempt)
        || status.times.stopping.is_some();
    // The next reconcile looks at an attempt that has just begun.
    let is_seen = plan.requeue != Some(std::time::Duration::ZERO);
    let is_asked = status.times.submitted.is_some();
    if may_run && is_asked && is_seen && !is_to_stop && !is_finished(status) {
        let follows = |a: &Action| {
            matches!(
                a,
                Action::Ask(Question::EvalaisEnd) | Action::UpdateEvalai(EvalaiUpdate::Queued | EvalaiUpdate::Running)
            )
        };
        assert!(
            plan.actions.iter().any(follows),
            "EvalAI's end is not looked for: {:?}",
            plan.actions
        );
    }
}

/// A status that is decided again in the same world changes no more, and publishes no more events.
fn comes_to_rest(view: &View, plan: &Plan) {
    let mut view = view.clone();
    let mut last = plan.clone();
    for _ in 0..SETTLED_AFTER {
        std::sync::Arc::make_mut(&mut view.submission).status = Some(last.status);
        last = decide(&view);
    }
    std::sync::Arc::make_mut(&mut view.submission).status = Some(last.status.clone());
    let again = decide(&view);
    assert_eq!(again.status, last.status, "a write each pass");
    // The reconcile that releases a deleted object is its last.
    if !again.actions.contains(&Action::SetFinalizer(false)) {
        assert_eq!(again.events, Vec::new(), "an event each pass");
    }
    assert_eq!(again.actions, last.actions);
}
