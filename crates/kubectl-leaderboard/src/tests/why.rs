//! `why NAME`.

use serde_json::{Value, json};

use super::{
    assert_width, cancelled, condition, crashed, finished, frame, leaderboard, named, node_lost, plan_with, running,
    submission, waiting, with,
};
use crate::board::Observed;
use crate::why::explain;
use leaderboard_api::{Attempt, Leaderboard, Submission, reasons};

fn printed(submission: &Submission, leaderboard: Observed<'_>) -> String {
    let lines = explain(submission, leaderboard, frame());
    assert_width(&lines);
    lines.join("\n")
}

fn explained(status: &Value) -> String {
    printed(&submission(status), Observed::Found(&leaderboard()))
}

fn changed(change: impl FnOnce(&mut Leaderboard)) -> Leaderboard {
    let mut leaderboard = leaderboard();
    change(&mut leaderboard);
    leaderboard
}

#[test]
fn one_in_line_has_its_position_and_an_estimate() {
    assert_eq!(
        explained(&waiting()),
        "\
submission-42 is Pending since 2026-11-01 11:00:00 UTC (60 min ago).

Track:       sensors of Leaderboard carla-20, by Team Seven; EvalAI submission 42, phase 7
Reason:      WaitingForSlot: All slots that concurrency.total and concurrency.perTeam allow are in
             use. status.waiting has the position in the line and an estimate.
Message:     All slots of the Leaderboard are in use; concurrency.total and concurrency.perTeam set
             their number.
In line:     position 3; starts in about 20-35 min. concurrency.total is 2.
Attempt:     1.

Next:        Wait, or raise the limits."
    );
}

#[test]
fn a_participant_failure_has_its_class_and_where_the_log_is() {
    assert_eq!(
        explained(&crashed()),
        "\
submission-42 is Failed since 2026-11-01 11:57:00 UTC (3 min ago).

Track:       sensors of Leaderboard carla-20; EvalAI submission 42, phase 7
Reason:      AgentCrashed: An agent crashed more often than retries.perWorker allows.
Message:     Agent 2 crashed 4 times. Look at agent/agent2/leaderboard.log of the results; the
             participant fixes the agent and submits again.
Failure:     AgentCrashed in worker 2: participant failure, counts as an attempt.
Attempt:     1.
Progress:    12/20 routes done, Driving score ~41.20 so far.
Worker 2:    2 of 10 done; last end: Exited (exit code 1), 5 min ago.
Results:     s3://results/v2/42
S3:          Stored: The final results are in S3.
EvalAI:      Waiting: EvalAI does not have the result yet. The last request failed: 503. Since
             2026-11-01 11:00:00 UTC (60 min ago).
DynamoDB:    Waiting: DynamoDB does not have the result yet. Since 2026-11-01 11:00:00 UTC (60 min
             ago).
Log:         the last 10,000 characters of the log of agent 2, agent/agent2/leaderboard.log. Hosts
             only: it may reveal private routes.
             aws s3 cp s3://results/v2/42/evalai/environment_log.txt -

Next:        Look at agent/agent2/leaderboard.log of the results; the participant fixes the agent
             and submits again."
    );
}

/// The containers of a failed worker may end again until its Job is gone, and that end may have no known cause.
#[test]
fn the_crashes_of_the_failed_worker_are_counted_once() {
    let message = "Agent 2 crashed once. Fix the agent.";
    let workers = json!([
        {"id": 1, "done": 1, "total": 10, "crashes": 3, "state": "Crashed"},
        {"id": 2, "done": 2, "total": 10, "crashes": 2, "state": "Crashed", "last": {"reason": "unseen"}},
    ]);
    let failure = json!({"class": "Participant", "worker": 2, "reason": "CannotStart", "message": message});
    let text = explained(&with(
        crashed(),
        &json!({"message": message, "failure": failure, "workers": workers}),
    ));
    assert!(
        text.contains("Message:     Agent 2 crashed once. Fix the agent."),
        "{text}"
    );
    assert!(text.contains("Worker 1:    1 of 10 done, crashed 3 times."), "{text}");
    assert!(text.contains("Worker 2:    2 of 10 done."), "{text}");
}

#[test]
fn an_infrastructure_failure_does_not_count_and_is_resumed() {
    let text = explained(&node_lost());
    for expected in [
        "Failure:     NodeLost: infrastructure failure, does not count as an attempt.",
        "Attempt:     1; 2 of 2 retries after infrastructure failures, which do not count as",
        "EvalAI:      Published: EvalAI has the result.",
        "Log:         no log explains it",
        "Next:        Look at the node, then resume the submission.\n             kubectl leaderboard resume submission-42 -n carla",
    ] {
        assert!(text.contains(expected), "{expected}\n\n{text}");
    }
}

#[test]
fn the_next_step_of_a_failure_is_not_that_of_a_wait_for_the_same_reason() {
    let wait = |reason: &str| explained(&json!({"state": "Pending", "reason": reason, "attempt": 1}));
    for (reason, waits) in [
        (
            reasons::NOT_ISOLATED,
            "Nothing for a moment after the Leaderboard was applied",
        ),
        (reasons::PHASE_DIFFERS, "Set the phase back in EvalAI: within the hour"),
    ] {
        assert!(wait(reason).contains(waits), "{}", wait(reason));
        let message = "Something failed. Correct that.";
        let failure = json!({"class": "Infrastructure", "reason": reason, "message": message});
        let text = explained(&with(
            node_lost(),
            &json!({"reason": reason, "message": message, "failure": failure}),
        ));
        assert!(!text.contains(waits), "{text}");
        assert!(text.contains("then resume the submission."), "{text}");
    }
}

#[test]
fn a_finished_one_has_its_score_and_results() {
    let text = explained(&finished());
    for expected in [
        "submission-42 is Finished since 2026-11-01 11:57:00 UTC (3 min ago).",
        "Progress:    20/20 routes done, Driving score 43.13.",
        "Results:     s3://results/v2/42",
        "S3:          Stored: The final results are in S3.",
        "DynamoDB:    Recorded: DynamoDB has the result.",
        "Next:        Nothing.",
    ] {
        assert!(text.contains(expected), "{expected}\n\n{text}");
    }
    assert!(!text.contains("Log:") && !text.contains("Failure:"), "{text}");
}

#[test]
fn a_leaderboard_that_keeps_it_waiting_is_named_first() {
    let paused = changed(|l| l.spec.paused = true);
    let not_ready = |truth: &str| {
        let fault = condition(
            "Ready",
            truth,
            "BucketUnreachable",
            "The bucket results does not answer",
        );
        changed(|l| l.status.as_mut().unwrap().conditions = vec![serde_json::from_value(fault).unwrap()])
    };
    let (refused, unknown) = (not_ready("False"), not_ready("Unknown"));
    let unseen = changed(|l| l.status = None);
    let deleted = changed(|l| {
        l.metadata.deletion_timestamp = l.status.as_ref().map(|s| s.conditions[0].last_transition_time.clone());
    });
    for (observed, first, next) in [
        (
            Observed::Missing,
            "There is no Leaderboard carla-20 in this namespace",
            "Apply the Leaderboard; the submission then continues.",
        ),
        (
            Observed::Found(&paused),
            "Leaderboard carla-20 is paused: nothing new starts",
            "Set paused: false.",
        ),
        (
            Observed::Found(&refused),
            "Leaderboard carla-20 is not Ready (BucketUnreachable): The bucket results does not answer.",
            "Check storage, the operator's credentials and the network",
        ),
        (
            Observed::Found(&unknown),
            "Leaderboard carla-20 may not be Ready (BucketUnreachable): ",
            "Check storage,",
        ),
        (
            Observed::Found(&unseen),
            "The operator has not processed Leaderboard carla-20 yet.",
            "Wait, or raise the limits.",
        ),
        (
            Observed::Found(&deleted),
            "Leaderboard carla-20 is being deleted",
            "Wait, or cancel these submissions.",
        ),
        (
            Observed::Forbidden,
            "You have no right to read Leaderboard carla-20",
            "Wait, or raise the limits.",
        ),
    ] {
        let text = printed(&submission(&waiting()), observed);
        let flat = text.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(text.lines().nth(1).unwrap().starts_with(first), "{first}\n\n{text}");
        let (_, steps) = flat.split_once("Next:").unwrap();
        assert!(steps.contains(next), "{next}\n\n{text}");
    }
}

#[test]
fn what_lasts_or_is_requested_is_shown() {
    let stopping = with(
        running(),
        &json!({"reason": "Stopping", "message": "Stopping as requested; completed routes are kept.",
                "times": {"started": "2026-11-01T11:00:00Z", "stopping": "2026-11-01T11:59:00Z"}}),
    );
    let pulls = with(
        waiting(),
        &json!({"reason": "ImagePull", "message": "The image of agent-1 cannot be pulled: not found.", "waiting": null,
                "conditions": [condition("Stalled", "True", "ImagePull", "The image of agent-1 cannot be pulled.")]}),
    );
    let between = with(
        waiting(),
        &json!({"reason": "Replacing", "retry": 1, "recreated": 2, "nextRetryTime": "2026-11-01T12:00:12Z", "waiting": null,
                "message": "Node gpu-3 was lost. Retrying in 20 s. This does not count as an attempt."}),
    );
    let doubtful = with(
        finished(),
        &json!({"conditions": [
            condition("Finished", "True", "Finished", ""),
            condition("Plausible", "False", "UnexplainedScores", "Scores do not follow from the infractions: pair 1"),
        ]}),
    );
    for (status, expected) in [
        (&stopping, "is Running since 2026-11-01 11:59:00 UTC (60 s ago)."),
        (&running(), "Job:         submission-42-1 on node gpu-3"),
        (&pulls, "Since 2026-11-01 11:00:00 UTC (60 min ago)."),
        (
            &between,
            "Next try:    the next Job is created 2026-11-01 12:00:12 UTC (in 12 s).",
        ),
        (&between, "somebody else deleted its Job 2 times"),
        (
            &doubtful,
            "Scores:      UnexplainedScores: Scores do not follow from the infractions: pair 1.",
        ),
        (
            &doubtful,
            "             Look at the checkpoint before you trust the score",
        ),
        (&cancelled(), "kubectl leaderboard resume submission-42 -n carla"),
        (
            &with(waiting(), &json!({"reason": "ImageMissing"})),
            "kubectl leaderboard cancel submission-42 -n carla",
        ),
    ] {
        let text = explained(status);
        let flat = text.split_whitespace().collect::<Vec<_>>().join(" ");
        let expected = expected.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(flat.contains(&expected), "{expected}\n\n{text}");
    }
    let mut higher = submission(&crashed());
    higher.spec.attempt = Attempt(2);
    let text = printed(&higher, Observed::Found(&leaderboard()));
    assert!(text.contains("attempt 2 is requested and follows it"), "{text}");
    assert!(!text.contains("Log:"), "the log is the old attempt's: {text}");
}

#[test]
fn one_that_is_not_processed_yet_is_called_new() {
    let text = explained(&Value::Null);
    assert!(
        text.starts_with("submission-42 is new, created 2026-11-01 10:00:00 UTC (2 h ago): the operator has not"),
        "{text}"
    );
    assert!(
        text.ends_with("Nothing. If it lasts for a minute, check that the operator runs."),
        "{text}"
    );
}

#[test]
fn the_log_is_read_where_the_run_was_stored() {
    let storage =
        json!({"bucket": "results", "prefix": "v2/", "region": "eu-west-1", "endpoint": "http://127.0.0.1:4566"});
    let plan = with(plan_with("simulator:1"), &json!({"storage": storage}));
    let status = with(crashed(), &json!({"plan": plan}));
    let lines = explain(&submission(&status), Observed::Forbidden, frame());
    let command = "             aws s3 cp s3://results/v2/42/evalai/environment_log.txt - --region eu-west-1 \
                   --endpoint-url http://127.0.0.1:4566";
    assert!(
        lines.iter().any(|line| line == command),
        "in one line, to be copied: {lines:#?}"
    );
}

/// Each reason in each state: there is a next step, and no line is too long (but for a command with a name of 52 letters).
#[test]
fn every_reason_has_a_next_step_within_the_width() {
    for reason in reasons::all().map(|reason| reason.name) {
        for status in [waiting(), running(), crashed(), finished(), cancelled()] {
            let long = format!("{} {}", "word ".repeat(80), "x".repeat(300));
            let status = with(
                status,
                &json!({"reason": reason, "message": long, "team": {"name": "t".repeat(256)}}),
            );
            let object = named(&"n".repeat(40), &status);
            let text = printed(&object, Observed::Found(&leaderboard()));
            let (_, next) = text
                .split_once("\nNext:        ")
                .unwrap_or_else(|| panic!("{reason}: {text}"));
            assert!(next.trim().len() > 5, "{reason}: {text}");
        }
    }
}

#[test]
fn a_team_cannot_write_on_the_hosts_terminal() {
    let status = with(
        waiting(),
        &json!({"team": {"name": "Team\u{1b}]0;owned\u{7}"}, "message": "\u{1b}[2Jgone"}),
    );
    let text = explained(&status);
    assert!(!text.contains(['\u{1b}', '\u{7}']), "{text:?}");
}

#[test]
fn a_stored_state_that_somebody_has_edited_changes_nothing() {
    for status in [waiting(), running(), crashed(), finished(), cancelled()] {
        let edited = with(status.clone(), &json!({"state": "Resumed"}));
        assert_eq!(explained(&edited), explained(&status));
    }
}
