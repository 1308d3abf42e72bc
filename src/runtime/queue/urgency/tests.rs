use serde_json::{Value, json};

use super::*;
use leaderboard_api::{Attempt, JobNumber};
use leaderboard_policy::submissions::StatusWrite;
use leaderboard_policy::view::ReportDemand;

fn submission(change: &Value) -> Submission {
    let mut object = json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Submission",
        "metadata": {"name": "s", "namespace": "one"},
        "spec": {"leaderboardName": "l", "track": "t", "image": "i"},
    });
    for (part, fields) in change.as_object().unwrap() {
        let object = object.as_object_mut().unwrap();
        let part = object.entry(part).or_insert_with(|| json!({})).as_object_mut().unwrap();
        part.extend(fields.as_object().unwrap().clone());
    }
    serde_json::from_value(object).unwrap()
}

fn finished() -> Value {
    ended("Finished")
}

fn ended(reason: &str) -> Value {
    let time = "2026-01-01T00:00:00Z";
    json!([{"type": "Finished", "status": "True", "reason": reason, "message": "", "lastTransitionTime": time}])
}

/// Each case has a name, a change, and the urgency of that change, of an answer, and of news of EvalAI.
fn assert_urgency<const N: usize>(cases: [(&str, Value, [Class; 3]); N]) {
    for (what, change, expected) in cases {
        let object = submission(&change);
        let found = [of_submission(&object), of_answer(&object), of_evalai(&object)];
        assert_eq!(found, expected, "{what}");
    }
}

#[test]
fn a_live_submission_is_as_urgent_as_what_it_shows() {
    use Class::{New, Refresh, Urgent};
    let time = "2026-01-01T00:00:00Z";
    let failure = json!({"class": "Participant", "reason": "AgentCrashed", "message": "m"});
    assert_urgency([
        ("just created", json!({}), [New, New, New]),
        ("accepted", json!({"status": {"attempt": 1}}), [New, New, New]),
        (
            "with a Job",
            json!({"status": {"attempt": 1, "jobName": "j"}}),
            [Refresh, Refresh, Urgent],
        ),
        (
            "restarted",
            json!({"spec": {"attempt": 2}, "status": {"attempt": 1, "jobName": "j"}}),
            [Urgent; 3],
        ),
        ("cancelled", json!({"spec": {"cancel": true}}), [Urgent; 3]),
        (
            "cancelled with a Job",
            json!({"spec": {"cancel": true}, "status": {"jobName": "j"}}),
            [Urgent; 3],
        ),
        ("deleted", json!({"metadata": {"deletionTimestamp": time}}), [Urgent; 3]),
        (
            "stopping",
            json!({"status": {"jobName": "j", "times": {"stopping": time}}}),
            [Urgent; 3],
        ),
        (
            "failing",
            json!({"status": {"jobName": "j", "failure": failure}}),
            [Urgent; 3],
        ),
    ]);
}

#[test]
fn the_answers_about_an_end_are_urgent() {
    use Class::{New, Refresh, Urgent};
    assert_urgency([
        (
            "ended",
            json!({"status": {"attempt": 1, "jobName": "j", "conditions": finished()}}),
            [Refresh, Urgent, Urgent],
        ),
        (
            "ended and cancelled",
            json!({"spec": {"cancel": true}, "status": {"attempt": 1, "conditions": finished()}}),
            [Refresh, Urgent, Urgent],
        ),
        (
            "ended, with a further attempt",
            json!({"spec": {"attempt": 2}, "status": {"attempt": 1, "jobName": "j", "conditions": ended("Cancelled")}}),
            [New, Urgent, New],
        ),
        (
            "finished, whatever attempt was asked for before",
            json!({"spec": {"attempt": 2}, "status": {"attempt": 1, "jobName": "j", "conditions": finished()}}),
            [Refresh, Urgent, Urgent],
        ),
    ]);
}

#[test]
fn the_end_of_a_job_is_urgent() {
    let condition = |type_: &str, status: &str| json!({"status": {"conditions": [{"type": type_, "status": status}]}});
    for (what, job, is_gone, expected) in [
        ("made", json!({}), false, Class::Refresh),
        ("suspended", condition("Suspended", "True"), false, Class::Refresh),
        ("not complete", condition("Complete", "False"), false, Class::Refresh),
        ("complete", condition("Complete", "True"), false, Class::Urgent),
        (
            "about to fail",
            condition("FailureTarget", "True"),
            false,
            Class::Urgent,
        ),
        (
            "being deleted",
            json!({"metadata": {"deletionTimestamp": "2026-01-01T00:00:00Z"}}),
            false,
            Class::Urgent,
        ),
        ("gone", json!({}), true, Class::Urgent),
    ] {
        let job: Job = serde_json::from_value(job).unwrap();
        assert_eq!(of_job(&job, is_gone), expected, "{what}");
    }
}

#[test]
fn the_end_of_all_its_containers_is_urgent() {
    let (ended, runs) = (json!({"terminated": {"exitCode": 1}}), json!({"running": {}}));
    let container = |state: &Value| json!({"name": "c", "image": "", "imageID": "", "ready": false, "restartCount": 0, "state": state});
    let pod = |containers: &[&Value]| {
        let containers: Vec<_> = containers.iter().map(|state| container(state)).collect();
        json!({"status": {"phase": "Running", "containerStatuses": containers}})
    };
    for (what, pod, is_gone, expected) in [
        ("no container yet", pod(&[]), false, Class::Refresh),
        ("one still runs", pod(&[&ended, &runs]), false, Class::Refresh),
        ("all have ended", pod(&[&ended, &ended]), false, Class::Urgent),
        (
            "failed as a whole",
            json!({"status": {"phase": "Failed"}}),
            false,
            Class::Urgent,
        ),
        (
            "being deleted",
            json!({"metadata": {"deletionTimestamp": "2026-01-01T00:00:00Z"}}),
            false,
            Class::Urgent,
        ),
        ("gone", pod(&[&runs]), true, Class::Urgent),
    ] {
        let pod: Pod = serde_json::from_value(pod).unwrap();
        assert_eq!(of_pod(&pod, is_gone), expected, "{what}");
    }
}

#[test]
fn what_follows_is_urgent_while_the_report_of_an_end_is_awaited() {
    let object = submission(&json!({"status": {"attempt": 1, "jobName": "j"}}));
    let status = object.status.clone().unwrap();
    for (stage, expected) in [
        (None, Class::Refresh),
        (Some(Stage::Live), Class::Refresh),
        (Some(Stage::RunEnded), Class::Urgent),
        (Some(Stage::JobEnded), Class::Urgent),
    ] {
        let report = stage.map(|stage| ReportDemand {
            job: JobNumber::first(Attempt(1)),
            pod: None,
            stage,
            period: std::time::Duration::from_secs(10),
        });
        let plan = Plan {
            status: status.clone(),
            write: StatusWrite::Now,
            actions: Vec::new(),
            events: Vec::new(),
            report,
            requeue: None,
        };
        assert_eq!(after(&object, &plan), expected, "{stage:?}");
    }
}
