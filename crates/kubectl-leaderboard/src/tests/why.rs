//! `why NAME`.

use serde_json::{Value, json};

use super::golden::assert_texts;
use super::{
    assert_width, cancelled, condition, crashed, finished, frame, leaderboard, named, node_lost, plan_with, running,
    submission, waiting, with,
};
use crate::board::Observed;
use crate::why::explain;
use leaderboard_api::{Attempt, Leaderboard, Reason, Submission};

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
    assert_texts(
        "why-crashes",
        &[("the failed worker crashed once by its message", text)],
    );
}

#[test]
fn a_cancelled_run_says_who_cancelled_it_next_to_its_progress() {
    let progress = json!({"progress": {"done": 3, "total": 20, "unit": "routes", "text": "3/20"}, "reason": null});
    let text = explained(&with(cancelled(), &progress));
    for part in ["Reason:      The submission was cancelled", "3/20 routes done"] {
        assert!(text.contains(part), "{text}");
    }
    let text = explained(&with(running(), &json!({"reason": null})));
    assert!(
        !text.contains("Reason:") && text.contains("Progress:    12/20"),
        "{text}"
    );
}

/// The text after `Next:`.
fn next_of(page: &str) -> &str {
    let (_, next) = page.split_once("\nNext:").unwrap_or_else(|| panic!("{page}"));
    next
}

#[test]
fn the_next_step_of_a_failure_is_not_that_of_a_wait_for_the_same_reason() {
    for reason in [Reason::NotIsolated, Reason::PhaseDiffers] {
        let wait = explained(&json!({"state": "Pending", "reason": reason, "attempt": 1}));
        let message = "Something failed. Correct that.";
        let failure = json!({"class": "Infrastructure", "reason": reason, "message": message});
        let text = explained(&with(
            node_lost(),
            &json!({"reason": reason, "message": message, "failure": failure}),
        ));
        assert_ne!(next_of(&text), next_of(&wait), "{reason}");
        assert!(next_of(&text).contains("kubectl leaderboard resume"), "{text}");
    }
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
    let pages = [
        ("missing", Observed::Missing),
        ("paused", Observed::Found(&paused)),
        ("not ready", Observed::Found(&refused)),
        ("perhaps not ready", Observed::Found(&unknown)),
        ("not processed", Observed::Found(&unseen)),
        ("deleted", Observed::Found(&deleted)),
        ("no right to it", Observed::Forbidden),
    ];
    let pages = pages.map(|(what, observed)| (what, printed(&submission(&waiting()), observed)));
    for (what, page) in &pages {
        let first = page.lines().nth(1).unwrap();
        assert!(first.contains("Leaderboard carla-20"), "{what}: {page}");
    }
    assert_texts("why-boards", &pages);
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
    let missing = with(waiting(), &json!({"reason": "ImageMissing"}));
    let statuses = [
        ("stopping", &stopping),
        ("pulls an image", &pulls),
        ("between two tries", &between),
        ("doubtful scores", &doubtful),
        ("without an image", &missing),
        ("not processed", &Value::Null),
    ];
    assert_texts("why-lasting", &statuses.map(|(what, status)| (what, explained(status))));
    let mut higher = submission(&crashed());
    higher.spec.attempt = Attempt(2);
    let text = printed(&higher, Observed::Found(&leaderboard()));
    assert!(!text.contains("Log:"), "the log is the old attempt's: {text}");
    assert_texts("why-resumed", &[("attempt 2 is requested", text)]);
}

#[test]
fn the_log_is_read_where_the_run_was_stored() {
    let storage =
        json!({"bucket": "results", "prefix": "v2/", "region": "eu-west-1", "endpoint": "http://127.0.0.1:4566"});
    let plan = with(plan_with("simulator:1"), &json!({"storage": {"s3": storage}}));
    let status = with(crashed(), &json!({"plan": plan}));
    let lines = explain(&submission(&status), Observed::Forbidden, frame());
    let command = "             aws s3 cp s3://results/v2/42/evalai/environment_log.txt - --region eu-west-1 \
                   --endpoint-url http://127.0.0.1:4566";
    assert!(
        lines.iter().any(|line| line == command),
        "in one line, to be copied: {lines:#?}"
    );
}

/// Each reason in each state has a next step, and no line is too long. A command with a name of 52 letters may be.
#[test]
fn every_reason_has_a_next_step_within_the_width() {
    for reason in Reason::ALL {
        for status in [waiting(), running(), crashed(), finished(), cancelled()] {
            let long = format!("{} {}", "word ".repeat(80), "x".repeat(300));
            let status = with(
                status,
                &json!({"reason": reason, "message": long, "team": {"name": "t".repeat(256)}}),
            );
            let object = named(&"n".repeat(40), &status);
            let text = printed(&object, Observed::Found(&leaderboard()));
            assert!(next_of(&text).trim().len() > 5, "{reason}: {text}");
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
