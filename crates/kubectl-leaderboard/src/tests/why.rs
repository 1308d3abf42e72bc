//! `why NAME`.

use serde_json::{Value, json};

use super::{
    assert_width, cancelled, condition, crashed, finished, leaderboard, named, node_lost, now, running, submission,
    waiting, with,
};
use crate::board::Sight;
use crate::why::explain;
use leaderboard_api::{Leaderboard, Submission, reasons};

const REASONS: &str = include_str!("../../../api/src/reasons.rs");

fn said(submission: &Submission, sight: Sight<'_>) -> String {
    let lines = explain(submission, sight, now());
    assert_width(&lines);
    lines.join("\n")
}

fn told(status: &Value) -> String {
    said(&submission(status), Sight::There(&leaderboard()))
}

fn changed(change: impl FnOnce(&mut Leaderboard)) -> Leaderboard {
    let mut leaderboard = leaderboard();
    change(&mut leaderboard);
    leaderboard
}

#[test]
fn one_in_line_says_its_place_and_estimate() {
    assert_eq!(
        told(&waiting()),
        "\
submission-42 is Pending since 2026-11-01 11:00:00 UTC (60 min ago).

Track:       sensors of Leaderboard carla-20, by Team Seven; submission 42 of phase 7 in EvalAI
Reason:      WaitingForSlot: As many run as concurrency.total and concurrency.perTeam allow. status.waiting
             has the place in line and an estimate.
Message:     All slots of the Leaderboard are in use; concurrency.total and concurrency.perTeam set their
             number.
In line:     place 3; it starts in about 20-35 min. 2 run, 4 wait, concurrency.total is 2.
Attempt:     1.

Next:        Wait, or raise the limits."
    );
}

#[test]
fn a_participants_failure_says_whose_it_is_and_where_the_log_is() {
    assert_eq!(
        told(&crashed()),
        "\
submission-42 is Failed since 2026-11-01 11:57:00 UTC (3 min ago).

Track:       sensors of Leaderboard carla-20; submission 42 of phase 7 in EvalAI
Reason:      AgentCrashed: An agent crashed as often as retries.perPair allows.
Message:     Agent 2 crashed 4 times. Look at agent/agent2/leaderboard.log of the results; the
             participant fixes the agent and submits again.
Failure:     AgentCrashed, the participant's, charged, in pair 2.
Attempt:     1.
Routes:      12/20 done, driving score ~41.20 so far.
Pair 2:      2 of 10 routes, crashed 4 times; the last end: exited (exit code 1), 5 min ago.
Results:     s3://results/v2/42
S3:          Stored: The final results are in S3.
EvalAI:      Waiting: EvalAI does not have the end yet. The last request failed: 503. Since
             2026-11-01 11:00:00 UTC (60 min ago).
DynamoDB:    Waiting: DynamoDB does not have the end yet. Since 2026-11-01 11:00:00 UTC (60 min
             ago).
Log:         the agent's of pair 2: the end of agent/agent2/leaderboard.log. For hosts alone, since
             it may show the routes:
             aws s3 cp s3://results/v2/42/evalai/environment_log.txt -

Next:        Look at agent/agent2/leaderboard.log of the results; the participant fixes the agent
             and submits again."
    );
}

#[test]
fn both_submissions_of_a_rerun_name_each_other() {
    let other = |name: &str| json!({"submissionName": name, "time": "2026-11-01T11:57:00Z"});
    let old = told(&with(finished(), &json!({"rerunAs": other("submission-99")})));
    let line = "Re-run:      as submission-99, 2026-11-01 11:57:00 UTC (3 min ago); EvalAI has cancelled this one.\n";
    assert!(old.contains(line), "{old}");
    let new = told(&with(waiting(), &json!({"rerunOf": other("submission-7")})));
    let line = "Re-run:      of submission-7, 2026-11-01 11:57:00 UTC (3 min ago).\n";
    assert!(new.contains(line), "{new}");
}

#[test]
fn an_infrastructures_failure_is_not_charged_and_is_resumed() {
    let words = told(&node_lost());
    for expected in [
        "Failure:     NodeLost, the infrastructure's, not charged.",
        "Attempt:     1; 2 of 2 retries after failures of the infrastructure, which cost nothing.",
        "EvalAI:      Published: EvalAI has the end.",
        "Log:         none explains it",
        "Next:        Look at the node, then resume.\n             kubectl leaderboard resume submission-42 -n carla",
    ] {
        assert!(words.contains(expected), "{expected}\n\n{words}");
    }
}

#[test]
fn the_next_step_of_a_failure_is_not_that_of_a_wait_for_the_same_reason() {
    let wait = |reason: &str| told(&json!({"state": "Pending", "reason": reason, "attempt": 1}));
    for (reason, waits) in [
        (
            reasons::NOT_ISOLATED,
            "Nothing for a moment after the Leaderboard was applied",
        ),
        (reasons::PHASE_DIFFERS, "Set the phase back in EvalAI: within the hour"),
    ] {
        assert!(wait(reason).contains(waits), "{}", wait(reason));
        let message = "It could not be. Correct that, then resume it.";
        let failure = json!({"class": "Infrastructure", "charged": false, "reason": reason, "message": message});
        let text = told(&with(
            node_lost(),
            &json!({"reason": reason, "message": message, "failure": failure}),
        ));
        assert!(!text.contains(waits), "{text}");
        assert!(
            text.contains("Next:        Do what the message says, then resume it."),
            "{text}"
        );
    }
}

#[test]
fn a_finished_one_has_its_score_and_results() {
    let words = told(&finished());
    for expected in [
        "submission-42 is Finished since 2026-11-01 11:57:00 UTC (3 min ago).",
        "Routes:      20/20 done, driving score 43.13.",
        "Results:     s3://results/v2/42",
        "S3:          Stored: The final results are in S3.",
        "DynamoDB:    Recorded: DynamoDB has the end.",
        "Next:        Nothing.",
    ] {
        assert!(words.contains(expected), "{expected}\n\n{words}");
    }
    assert!(!words.contains("Log:") && !words.contains("Failure:"), "{words}");
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
    for (sight, first, next) in [
        (
            Sight::Missing,
            "There is no Leaderboard carla-20 in this namespace",
            "Apply the Leaderboard; the submission goes on.",
        ),
        (
            Sight::There(&paused),
            "Leaderboard carla-20 is paused: nothing new starts",
            "Set paused: false.",
        ),
        (
            Sight::There(&refused),
            "Leaderboard carla-20 is not Ready (BucketUnreachable): The bucket results does not answer.",
            "Check storage, the operator's credentials and the network",
        ),
        (
            Sight::There(&unknown),
            "Leaderboard carla-20 may not be Ready (BucketUnreachable): ",
            "Check storage,",
        ),
        (
            Sight::There(&unseen),
            "The operator has not looked at Leaderboard carla-20 yet.",
            "Wait, or raise the limits.",
        ),
        (
            Sight::There(&deleted),
            "Leaderboard carla-20 is being deleted",
            "Wait, or cancel them.",
        ),
        (
            Sight::Unread,
            "You may not read Leaderboard carla-20",
            "Wait, or raise the limits.",
        ),
    ] {
        let words = said(&submission(&waiting()), sight);
        let flat = words.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(words.lines().nth(1).unwrap().starts_with(first), "{first}\n\n{words}");
        let (_, steps) = flat.split_once("Next:").unwrap();
        assert!(steps.contains(next), "{next}\n\n{words}");
    }
}

#[test]
fn what_lasts_or_is_wished_is_said() {
    let stopping = with(
        running(),
        &json!({"reason": "Stopping", "message": "It is being stopped as wished; what it has reached is kept.",
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
                "message": "Node gpu-3 was lost. It is tried again in 20 s; this costs no attempt."}),
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
            "Next try:    its next Job is made 2026-11-01 12:00:12 UTC (in 12 s).",
        ),
        (&between, "its Job was deleted by somebody else 2 times"),
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
        let words = told(status);
        let flat = words.split_whitespace().collect::<Vec<_>>().join(" ");
        let expected = expected.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(flat.contains(&expected), "{expected}\n\n{words}");
    }
    let mut higher = submission(&crashed());
    higher.spec.attempt = 2;
    let words = said(&higher, Sight::There(&leaderboard()));
    assert!(
        words.contains("attempt 2 is wished and begins when the operator takes it up"),
        "{words}"
    );
    assert!(!words.contains("Log:"), "the log is the old attempt's: {words}");
}

#[test]
fn one_that_nobody_has_looked_at_says_so() {
    let words = told(&Value::Null);
    assert!(
        words.starts_with("submission-42 is new, made 2026-11-01 10:00:00 UTC (2 h ago): the operator has not"),
        "{words}"
    );
    assert!(
        words.ends_with("Nothing; if it lasts for a minute, look whether the operator runs."),
        "{words}"
    );
}

#[test]
fn the_log_is_read_where_the_run_was_stored() {
    let storage =
        json!({"bucket": "results", "prefix": "v2/", "region": "eu-west-1", "endpoint": "http://127.0.0.1:4566"});
    let plan = json!({"runId": "42", "leaderboardVersion": "V2", "track": "sensors", "codename": "SENSORS", "slices": ["0-9"],
                      "routes": 10, "repetitions": 1, "storage": storage, "image": "a:1", "contentsImage": "c:1",
                      "simulatorImage": "s:1"});
    let status = with(crashed(), &json!({"plan": plan}));
    let lines = explain(&submission(&status), Sight::Unread, now());
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
    let constants = REASONS.lines().filter(|line| line.starts_with("pub const "));
    let reasons: Vec<&str> = constants.map(|line| line.split('"').nth(1).unwrap()).collect();
    assert!(reasons.len() > 50);
    for reason in reasons {
        for status in [waiting(), running(), crashed(), finished(), cancelled()] {
            let long = format!("{} {}", "word ".repeat(80), "x".repeat(300));
            let status = with(
                status,
                &json!({"reason": reason, "message": long, "team": {"name": "t".repeat(256)}}),
            );
            let object = named(&"n".repeat(40), &status);
            let words = said(&object, Sight::There(&leaderboard()));
            let (_, next) = words
                .split_once("\nNext:        ")
                .unwrap_or_else(|| panic!("{reason}: {words}"));
            assert!(next.trim().len() > 5, "{reason}: {words}");
        }
    }
}

#[test]
fn a_team_cannot_write_on_the_hosts_terminal() {
    let status = with(
        waiting(),
        &json!({"team": {"name": "Team\u{1b}]0;owned\u{7}"}, "message": "\u{1b}[2Jgone"}),
    );
    let words = told(&status);
    assert!(!words.contains(['\u{1b}', '\u{7}']), "{words:?}");
}
