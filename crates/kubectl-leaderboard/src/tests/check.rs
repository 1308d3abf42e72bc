//! The table of a check: which part each end proves, breaks or leaves open.

use serde_json::{Value, json};

use super::{assert_width, condition, now, plan_with, with};
use crate::check::{Collector, Collectors, Mark, Outcome, Part, Patience, Readers, Seen, findings, lines};
use crate::text::WIDTH;
use leaderboard_api::{Leaderboard, State, Submission};

/// Nothing else stores the lines.
const NOBODY: Collectors = Collectors::Known {
    found: Vec::new(),
    node: None,
};

/// A Leaderboard of EvalAI with a queue, a table and a log group, that is Ready.
fn leaderboard(conditions: &Value) -> Leaderboard {
    let object = json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Leaderboard",
        "metadata": {"name": "carla-20", "namespace": "carla", "generation": 4},
        "spec": {
            "tracks": [{"name": "sensors", "codename": "SENSORS", "phase": 7}], "leaderboardVersion": "V2",
            "contents": {"image": "contents:1"}, "simulator": {"image": "simulator:1"},
            "check": {"image": "123456789012.dkr.ecr.us-east-1.amazonaws.com/carla/baseline:1"},
            "evalai": {"apiServer": "https://eval.ai", "challenge": 3, "token": {"secretKeyRef": {"name": "t", "key": "k"}}},
            "queue": {"url": "https://sqs.us-east-1.amazonaws.com/1/carla", "region": "us-east-1"},
            "storage": {"bucket": "results", "prefix": "v2/"}, "table": {"name": "submissions"}, "logGroup": {"name": "/carla"},
        },
        "status": {"conditions": conditions},
    });
    serde_json::from_value(object).unwrap()
}

pub(super) fn good_leaderboard() -> Leaderboard {
    leaderboard(&json!([
        condition("Ready", "True", "Ready", ""),
        condition(
            "Isolated",
            "True",
            "Enforced",
            "The Pod of check-carla-20-x7k2p could not reach 10.96.0.1:443."
        ),
    ]))
}

/// It is Ready with a note, and its Pods are not isolated.
pub(super) fn noted_leaderboard() -> Leaderboard {
    leaderboard(&json!([
        condition(
            "Ready",
            "True",
            "Ready",
            "Runs of the track sensors have no time limit."
        ),
        condition("Isolated", "False", "NotEnforced", "The Pod could reach 10.96.0.1:443."),
    ]))
}

pub(super) fn check(status: &Value) -> Submission {
    let object = json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Submission",
        "metadata": {"name": "check-carla-20-x7k2p", "namespace": "carla"},
        "spec": {"leaderboardName": "carla-20", "track": "sensors", "check": true,
                 "image": "123456789012.dkr.ecr.us-east-1.amazonaws.com/carla/baseline:1"},
        "status": status,
    });
    serde_json::from_value(object).unwrap()
}

/// Its route is driven and stored, and the table would take a row.
pub(super) fn passed() -> Value {
    json!({
        "attempt": 1, "reason": "Finished", "message": "1 of 1 routes, driving score 98.00.", "track": "sensors",
        "progress": {"done": 1, "total": 1, "text": "1/1"}, "score": {"driving": "98.00", "final": true, "text": "98.00"},
        "jobName": "check-carla-20-x7k2p-1", "nodeName": "gpu-3", "resultsURL": "s3://results/v2/check-carla-20-x7k2p",
        "image": {"digest": format!("sha256:{}", "4f".repeat(32))},
        "plan": with(plan_with("simulator:1"), &json!({"runId": "check-carla-20-x7k2p"})),
        "times": {"accepted": "2026-11-01T11:50:00Z", "scheduled": "2026-11-01T11:50:41Z", "started": "2026-11-01T11:54:02Z",
                  "finished": "2026-11-01T11:57:00Z"},
        "conditions": [
            condition("Accepted", "True", "Accepted", ""), condition("Finished", "True", "Finished", ""),
            condition("Archived", "True", "Stored", ""), condition("Published", "False", "NotRequired", ""),
            condition("Recorded", "True", "Recorded", "The table would take a row; a check writes none."),
            condition("Logged", "True", "LogsSent", ""),
        ],
    })
}

/// It failed before its agent ran.
pub(super) fn failed(class: &str, reason: &str, message: &str) -> Value {
    with(
        passed(),
        &json!({
            "reason": reason, "message": message, "progress": null, "score": null,
            "times": {"accepted": "2026-11-01T11:50:00Z", "scheduled": "2026-11-01T11:50:41Z", "finished": "2026-11-01T11:57:00Z"},
            "failure": {"class": class, "reason": reason, "message": message},
            "conditions": [
                condition("Accepted", "True", "Accepted", ""), condition("Finished", "True", reason, message),
                condition("Archived", "False", "NotStored", ""), condition("Recorded", "True", "Recorded", ""),
            ],
        }),
    )
}

fn printed(leaderboard: &Leaderboard, status: &Value, given_up: Option<&str>, readers: &Readers) -> (String, bool) {
    let (lines, has_passed) = table(leaderboard, status, given_up, readers, WIDTH);
    let bare: Vec<String> = lines.iter().filter(|line| !line.contains("  aws ")).cloned().collect();
    assert_width(&bare);
    (lines.join("\n"), has_passed)
}

pub(super) fn table(
    leaderboard: &Leaderboard,
    status: &Value,
    given_up: Option<&str>,
    readers: &Readers,
    width: usize,
) -> (Vec<String>, bool) {
    let submission = check(status);
    let found = findings(Seen {
        leaderboard,
        submission: Some(&submission),
        given_up,
        readers,
        collectors: &NOBODY,
    });
    let state = submission
        .status
        .as_ref()
        .map(leaderboard_api::SubmissionStatus::state_of_conditions);
    let outcome = Outcome::of(&found, state == Some(State::Finished));
    (lines(&found, outcome, width), outcome.has_passed)
}

const PASSED: &str = "\
✔ Leaderboard    Ready
✔ EvalAI         accepts the token; phases, split and labels fit
✔ Queue          answers
✔ Other readers  no running Pipe and no Lambda function reads the queue
✔ Registry       has the image, sha256:4f4f4f4f4f4f…
✔ Slot           granted
✔ Node           gpu-3, after 41 s
✔ Images         pulled, 201 s from the node to the agent
✔ Contents       copied
✔ Isolation      Enforced: The Pod of check-carla-20-x7k2p could not reach 10.96.0.1:443.
✔ Simulator      started, and the agent drove in it
✔ Agent          ran
✔ Bucket         has the results, s3://results/v2/check-carla-20-x7k2p
✔ Route          1/1 done, driving score 98.00
✔ Table          would take a row; a check writes none
✔ CloudWatch     takes the lines, /carla: check-carla-20-x7k2p/…
✔ Log collectors no DaemonSet collects the lines of containers

The check passed.";

#[test]
fn a_good_leaderboard_has_every_part_proved() {
    let (text, has_passed) = printed(&good_leaderboard(), &passed(), None, &Readers::Nobody);
    assert_eq!(text, PASSED);
    assert!(has_passed);
    let docs = include_str!("../../../../docs/check.md");
    assert!(
        docs.contains(PASSED),
        "docs/check.md shows another table than\n{PASSED}"
    );
}

/// The results of both are good.
#[test]
fn lines_that_cloudwatch_refuses_fail_the_check_and_silence_does_not() {
    let logged = |logged: Option<Value>| {
        let mut status = passed();
        let conditions = status["conditions"].as_array_mut().unwrap();
        conditions.retain(|condition| condition["type"] != "Logged");
        conditions.extend(logged);
        printed(&good_leaderboard(), &status, None, &Readers::Nobody)
    };
    let refused = "writing to /carla/check-carla-20-x7k2p/agent-1 in CloudWatch Logs: denied";
    let (text, has_passed) = logged(Some(condition("Logged", "False", "LogsRefused", refused)));
    assert!(!has_passed, "{text}");
    for part in [
        "✘ CloudWatch     writing to /carla/",
        "→ Check that `logGroup`",
        "✔ Route          1/1 done",
    ] {
        assert!(text.replace('`', "").contains(&part.replace('`', "")), "{text}");
    }
    let (text, has_passed) = logged(None);
    assert!(has_passed, "{text}");
    assert!(text.contains("– CloudWatch     not known:"), "{text}");
    let command =
        "aws logs describe-log-streams --log-group-name /carla --log-stream-name-prefix check-carla-20-x7k2p/";
    assert!(text.contains(command), "{text}");
}

#[test]
fn a_fault_marks_its_part_and_leaves_open_what_was_not_reached() {
    let pull = "The image of simulator-1 cannot be pulled: not found. It was tried for 60 s.";
    let (text, has_passed) = printed(
        &good_leaderboard(),
        &failed("Infrastructure", "ImagePull", pull),
        None,
        &Readers::Nobody,
    );
    let end = "\
✔ Node           gpu-3, after 41 s
✘ Images         ImagePull: The image of simulator-1 cannot be pulled: not found. It was tried for
                 60 s.
                 → Fix what this names, then run the check again.
– Contents       not reached
✔ Isolation      Enforced: The Pod of check-carla-20-x7k2p could not reach 10.96.0.1:443.
– Simulator      not reached
– Agent          not reached
– Bucket         not reached
– Route          not reached
✔ Table          would take a row; a check writes none
– CloudWatch     not reached
✔ Log collectors no DaemonSet collects the lines of containers

The check failed: 1 part is broken (✘). Parts that were not reached may be broken, too.";
    assert!(text.ends_with(end), "{text}");
    assert!(!has_passed);
}

/// The part that each failure breaks.
const BROKEN_BY: &[(&str, &str, Part)] = &[
    (
        "ImageNotFound",
        "The submitted image is not in its registry.",
        Part::Registry,
    ),
    (
        "ImageNotAllowed",
        "The image of the check is not named.",
        Part::Registry,
    ),
    (
        "ScheduleDeadline",
        "No node accepted the Pod within 60 s: exceeded quota.",
        Part::Node,
    ),
    (
        "ImagePull",
        "The image of agent-1 cannot be pulled: not found.",
        Part::Images,
    ),
    (
        "StartDeadline",
        "Contents fails: no such file. It was tried for 60 s.",
        Part::Contents,
    ),
    (
        "StartDeadline",
        "Workspace fails: the bucket refuses. It was tried for 60 s.",
        Part::Bucket,
    ),
    (
        "CannotStart",
        "Contents cannot be started: cp is missing.",
        Part::Contents,
    ),
    (
        "CannotStart",
        "Simulator-1 cannot be started: bash is missing.",
        Part::Simulator,
    ),
    (
        "CannotStart",
        "Agent-1 cannot be started: bash is missing.",
        Part::Agent,
    ),
    (
        "NodeCannotStart",
        "Simulator-1 cannot be started: too many open files in system.",
        Part::Node,
    ),
    ("NotIsolated", "The Pod could reach 10.96.0.1:443.", Part::Network),
    ("SimulationCrashed", "Simulator 1 crashed.", Part::Simulator),
    ("NoGPU", "Simulator 1 has no GPU.", Part::Simulator),
    (
        "GraphicsDriverMissing",
        "The node's driver has no Vulkan.",
        Part::Simulator,
    ),
    ("AgentCrashed", "Agent 1 crashed.", Part::Agent),
    ("InvalidResults", "A checkpoint was refused.", Part::Route),
    (
        "ResultsNotStored",
        "The Pod ended before its results were stored.",
        Part::Bucket,
    ),
    ("ReasonOfALaterVersion", "Something failed.", Part::Route),
];

#[test]
fn every_failure_has_its_part() {
    for (reason, message, expected) in BROKEN_BY {
        let submission = check(&failed("Infrastructure", reason, message));
        let found = findings(Seen {
            leaderboard: &good_leaderboard(),
            submission: Some(&submission),
            given_up: None,
            readers: &Readers::Nobody,
            collectors: &NOBODY,
        });
        let broken: Vec<Part> = found
            .iter()
            .filter(|f| f.mark == Mark::Broken)
            .map(|f| f.part)
            .collect();
        assert_eq!(broken, [*expected], "{reason}: {message}");
    }
}

#[test]
fn a_leaderboard_that_is_not_ready_fails_the_check_of_a_good_run() {
    let cases = [
        ("TokenRefused", "EvalAI", "Renew the token"),
        ("LabelsDiffer", "EvalAI", "Compare evalai.challenge"),
        ("BucketUnreachable", "Bucket", "Check storage"),
        ("TableUnreachable", "Table", "create the table"),
        ("QueueUnreachable", "Queue", "create the queue"),
        ("PhaseConflict", "Leaderboard", "Remove the phase"),
        ("InvalidPod", "Node", "Correct what the message names"),
    ];
    for (reason, part, step) in cases {
        let broken = leaderboard(&json!([condition("Ready", "False", reason, "It is broken")]));
        let (text, has_passed) = printed(&broken, &passed(), None, &Readers::Nobody);
        let line = format!("✘ {part:<15}{reason}: It is broken.");
        assert!(text.contains(&line) && text.contains(step), "{line}\n{text}");
        assert!(!has_passed, "{reason}");
        assert_eq!(text.matches('✘').count(), 2, "the part and the last line: {text}");
    }
}

#[test]
fn what_a_host_allows_is_a_note() {
    let noted = noted_leaderboard();
    let (text, has_passed) = printed(&noted, &passed(), None, &Readers::Nobody);
    assert!(
        text.contains("! Leaderboard    Ready. Runs of the track sensors have no time limit."),
        "{text}"
    );
    assert!(
        text.contains("! Isolation      NotEnforced: The Pod could reach 10.96.0.1:443."),
        "{text}"
    );
    assert!(
        text.contains("→ Use a network plugin that enforces policies."),
        "{text}"
    );
    assert!(
        text.ends_with("The check passed, with 2 notes (!).") && has_passed,
        "{text}"
    );
}

#[test]
fn one_that_is_given_up_shows_what_it_waited_for() {
    let waiting = json!({"attempt": 1, "reason": "Unschedulable", "message": "0/3 nodes are available: 3 Insufficient nvidia.com/gpu.",
                         "jobName": "check-carla-20-x7k2p-1", "conditions": [condition("Accepted", "True", "Accepted", "")]});
    let why = "The check did not end within 600 s (--timeout).";
    let (text, has_passed) = printed(&good_leaderboard(), &waiting, Some(why), &Readers::Nobody);
    let found = "✘ Node           The check did not end within 600 s (--timeout). Unschedulable: 0/3 nodes are";
    assert!(text.contains(found) && !has_passed, "{text}");
    let unseen = "The operator has not processed the check for 60 s.";
    let (text, _) = printed(&good_leaderboard(), &Value::Null, Some(unseen), &Readers::Nobody);
    assert!(
        text.contains("✘ Leaderboard    The operator has not processed the check for 60 s."),
        "{text}"
    );
}

#[test]
fn a_table_that_does_not_answer_is_waited_for_a_minute_after_the_end() {
    let later = |seconds| now().checked_add(jiff::SignedDuration::from_secs(seconds)).unwrap();
    let ended = |recorded: Value| {
        check(&json!({
            "attempt": 1, "reason": "Finished", "times": {"finished": "2026-11-01T11:00:00Z"},
            "conditions": [condition("Finished", "True", "Finished", ""), recorded],
        }))
    };
    let mut patience = Patience::new(now(), 900);
    patience.observe(&ended(condition("Recorded", "False", "Waiting", "")), now());
    patience.observe(
        &ended(condition("Recorded", "False", "Waiting", "No answer.")),
        later(30),
    );
    assert_eq!((patience.next(), patience.is_over(later(59))), (later(60), false));
    assert!(patience.is_over(later(60)) && patience.given_up(later(60)).is_none());
    patience.observe(&ended(condition("Recorded", "True", "Recorded", "")), later(40));
    assert!(patience.is_over(later(40)));
}

#[test]
fn only_what_a_person_has_to_change_is_given_up_after_a_minute() {
    let later = |seconds| now().checked_add(jiff::SignedDuration::from_secs(seconds)).unwrap();
    for (reason, seconds) in [
        (None, 60),
        (Some("LeaderboardNotReady"), 60),
        (Some("Unschedulable"), 900),
        (Some("WaitingForSlot"), 900),
        (Some("Preparing"), 900),
    ] {
        let mut patience = Patience::new(now(), 900);
        let status = reason.map_or(Value::Null, |reason| json!({"attempt": 1, "reason": reason}));
        patience.observe(&check(&status), now());
        assert_eq!(patience.next(), later(seconds), "{reason:?}");
        assert_eq!(patience.given_up(later(seconds - 1)), None, "{reason:?}");
        assert!(patience.given_up(later(seconds)).is_some(), "{reason:?}");
    }
}

/// The original's FluentD with the log group of its variables, or none of them.
fn fluentd(group: &str, is_on_node: Option<bool>) -> Collector {
    let set = json!({
        "metadata": {"name": "fluentd", "namespace": "kube-system", "uid": "u1"},
        "spec": {"selector": {}, "template": {"spec": {
            "containers": [{"name": "fluentd", "image": "fluent/fluentd-kubernetes-daemonset:v1.16.1-debian-cloudwatch-1.2",
                            "env": [{"name": "LOG_GROUP_NAME", "value": group}]}],
            "volumes": [{"name": "fluentd-config", "configMap": {"name": "fluentd-config"}}],
        }}},
    });
    let set = serde_json::from_value(set).unwrap();
    let of = leaderboard_api::log_collectors::find(&[set]).remove(0);
    Collector { of, is_on_node }
}

/// The lines about those who collect logs, and whether the check passed.
fn of_collectors(collectors: &Collectors, change: impl Fn(&mut Leaderboard)) -> (String, bool) {
    let mut board = good_leaderboard();
    change(&mut board);
    let submission = check(&passed());
    let mut found = findings(Seen {
        leaderboard: &board,
        submission: Some(&submission),
        given_up: None,
        readers: &Readers::Nobody,
        collectors,
    });
    let outcome = Outcome::of(&found, true);
    found.retain(|finding| finding.part == Part::Collectors);
    (lines(&found, outcome, WIDTH).join("\n"), outcome.has_passed)
}

#[test]
fn what_else_stores_the_lines_is_a_note_with_both_ways_out() {
    let known = |group: &str, is_on_node| Collectors::Known {
        found: vec![fluentd(group, is_on_node)],
        node: Some("gpu-3".to_owned()),
    };
    let (text, has_passed) = of_collectors(&known("/carla", Some(true)), |_| {});
    let expected = "\
! Log collectors FluentD (DaemonSet kube-system/fluentd), on gpu-3, has the log group /carla, too:
                 each line is stored twice
                 → Leave the namespace out of what it reads and restart it, or remove logGroup from
                 the Leaderboard (docs/migrate.md, Logs twice):
                   kubectl -n kube-system edit configmap fluentd-config # exclude_path [\"/var/log/containers/*_carla_*.log\"]
                   kubectl -n kube-system rollout restart daemonset fluentd
                   kubectl -n carla patch leaderboard carla-20 --type merge --patch '{\"spec\":{\"logGroup\":null}}'";
    assert!(text.starts_with(expected), "{text}");
    assert!(has_passed && text.ends_with("with 1 note (!)."), "{text}");
    let cases = [
        (
            known("/other", Some(true)),
            "! Log collectors FluentD",
            "each line may be stored twice",
        ),
        (
            known("/other", None),
            "! Log collectors FluentD",
            "may run on the nodes of the Pods",
        ),
        (
            known("/carla", Some(false)),
            "✔ Log collectors none on gpu-3; elsewhere FluentD",
            "",
        ),
        (NOBODY, "✔ Log collectors no DaemonSet", ""),
        (
            Collectors::Unknown("missing right: daemonsets.apps is forbidden".to_owned()),
            "– Log collectors not known: missing right: daemonsets.apps is forbidden",
            "kubectl get daemonsets --all-namespaces --output wide",
        ),
    ];
    for (collectors, start, part) in cases {
        let (text, has_passed) = of_collectors(&collectors, |_| {});
        let words = text.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(
            text.starts_with(start) && words.contains(part) && has_passed,
            "{part}: {text}"
        );
    }
    let (text, _) = of_collectors(&known("/carla", Some(true)), |board| board.spec.log_group = None);
    assert!(!text.contains("Log collectors"), "{text}");
}
