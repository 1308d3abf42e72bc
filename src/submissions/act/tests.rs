//! The log lines of a status that was written.

use std::sync::Arc;

use tracing::Instrument;

use super::*;
use crate::fixtures::{Cluster, Surroundings, leaderboard, surroundings, with_job};
use crate::observability::logging::tests::Lines;
use crate::runtime::objects::span_of;
use crate::submissions::observe::observe;
use leaderboard_api::Attempt;
use leaderboard_policy::submissions::{Plan, StatusWrite};
use leaderboard_policy::view::ObservedJob;

/// A submission whose Job was made, as one reconcile has read it.
async fn bench() -> (Surroundings, View) {
    let board = leaderboard("board", "http://127.0.0.1:9");
    let (submission, job) = with_job("first", &board);
    let cluster = Cluster {
        leaderboards: vec![board],
        submissions: vec![submission.clone()],
        jobs: vec![job],
        ..Cluster::default()
    };
    let around = surroundings(cluster, "http://127.0.0.1:9").await;
    let view = observe(around.context.for_observe(), Arc::new(submission), |_| true);
    (around, view)
}

/// Carries out a plan that is a status and nothing else.
async fn write(around: &Surroundings, view: &View, status: SubmissionStatus) {
    let plan = Plan {
        status,
        write: StatusWrite::Now,
        actions: Vec::new(),
        events: Vec::new(),
        report: None,
        requeue: None,
    };
    let span = span_of(&view.submission);
    act(around.context.for_act(), view, plan)
        .instrument(span)
        .await
        .unwrap();
}

/// The metrics after this status was written; the view has it then.
async fn metrics_after(around: &Surroundings, view: &mut View, status: SubmissionStatus) -> String {
    write(around, view, status.clone()).await;
    Arc::make_mut(&mut view.submission).status = Some(status);
    around.context.metrics.text().unwrap()
}

#[tokio::test(start_paused = true)]
async fn a_job_that_is_refused_keeps_nothing_else_from_being_done_and_is_known_to_the_next_reconcile() {
    let board = leaderboard("board", "http://127.0.0.1:9");
    let (submission, _) = with_job("first", &board);
    let cluster = Cluster {
        leaderboards: vec![board],
        submissions: vec![submission.clone()],
        no_jobs: Some("exceeded quota: q"),
        ..Cluster::default()
    };
    let around = surroundings(cluster, "http://127.0.0.1:9").await;
    let uses = || around.context.for_observe();
    let view = observe(uses(), Arc::new(submission.clone()), |_| true);
    assert_eq!(view.job, ObservedJob::Absent { refused: None });
    let status = submission.status.clone().unwrap();
    let plan = Plan {
        actions: vec![Action::CreateJob(status.job_number()), Action::Ask(Question::Evalai)],
        status,
        write: StatusWrite::Now,
        events: Vec::new(),
        report: None,
        requeue: None,
    };
    let failed = act(around.context.for_act(), &view, plan).await;
    assert!(failed.is_err(), "it is tried again");
    tokio::time::advance(Duration::from_secs(1)).await;
    let seen = observe(uses(), Arc::new(submission), |_| true);
    let refused = Some("exceeded quota: q".to_owned());
    assert_eq!(seen.job, ObservedJob::Absent { refused });
    let waited = uses().memory.evalai_waited(&seen.submission);
    assert!(waited >= Duration::from_secs(1), "it was asked");
}

#[tokio::test(start_paused = true)]
async fn each_transition_is_one_line_with_all_that_identifies_it() {
    let (around, view) = bench().await;
    let old = view.submission.status.clone().unwrap();
    let lines = Lines::default();
    let _guard = lines.collect();
    let write = async |status| write(&around, &view, status).await;

    write(old.clone()).await;
    assert_eq!(lines.take(), "", "nothing was written");
    let scheduled = SubmissionStatus {
        node_name: Some("node-1".into()),
        ..old.clone()
    };
    write(scheduled.clone()).await;
    let progress = json!({"done": 1, "total": 4, "unit": "routes", "text": "1/4"});
    write(SubmissionStatus {
        progress: serde_json::from_value(progress).unwrap(),
        ..scheduled.clone()
    })
    .await;
    assert_eq!(lines.take(), "", "neither the node nor the progress is a transition");

    let condition = json!({"type": "Running", "status": "True", "reason": "Running", "message": "",
                           "lastTransitionTime": "2026-01-01T00:00:00Z"});
    let condition = serde_json::from_value(condition).unwrap();
    let running = SubmissionStatus {
        conditions: vec![condition],
        reason: Some("AgentRunning".into()),
        message: Some("Agents run.".into()),
        ..scheduled
    };
    write(running).await;
    let text = lines.take();
    let line: serde_json::Value = serde_json::from_str(text.trim_end()).expect("one line");
    for (field, value) in [
        ("level", json!("INFO")),
        ("submission", json!("one/first")),
        ("leaderboard", json!("board")),
        ("attempt", json!(1)),
        ("from", json!("Pending")),
        ("to", json!("Running")),
        ("reason", json!("AgentRunning")),
        ("message", json!("Agents run.")),
    ] {
        assert_eq!(line[field], value, "{field} of {text}");
    }
}

#[tokio::test(start_paused = true)]
async fn gpu_seconds_are_counted_when_they_are_stored_and_once() {
    let (around, mut view) = bench().await;
    let old = view.submission.status.clone().unwrap();
    for (gpu_seconds, sum) in [(400, "400"), (400, "400"), (1000, "1000")] {
        let status = SubmissionStatus {
            usage: Some(leaderboard_api::Use { gpus: 4, gpu_seconds }),
            track: Some("sensors".into()),
            ..old.clone()
        };
        let text = metrics_after(&around, &mut view, status).await;
        for line in [
            format!("leaderboard_gpu_seconds_total{{leaderboard=\"one/board\",track=\"sensors\"}} {sum}"),
            format!("leaderboard_team_gpu_seconds_total{{leaderboard=\"one/board\",team=\"t1\"}} {sum}"),
        ] {
            assert!(text.lines().any(|found| found == line), "{line} is missing in\n{text}");
        }
    }
}

#[tokio::test(start_paused = true)]
async fn a_failed_attempt_is_counted_once_when_it_is_stored() {
    let (around, mut view) = bench().await;
    let old = view.submission.status.clone().unwrap();
    let finished = json!({"type": "Finished", "status": "True", "reason": "AgentCrashed", "message": "",
                          "lastTransitionTime": "2026-01-01T00:00:00Z"});
    let failure = json!({"class": "Participant", "reason": "AgentCrashed", "message": "It crashed."});
    let failed = SubmissionStatus {
        conditions: vec![serde_json::from_value(finished).unwrap()],
        failure: Some(serde_json::from_value(failure).unwrap()),
        ..old.clone()
    };
    let published = SubmissionStatus {
        message: Some("It is published.".into()),
        ..failed.clone()
    };
    let resumed = SubmissionStatus {
        attempt: old.attempt.map(Attempt::next),
        ..failed.clone()
    };
    let family = "leaderboard_submission_failures_total{";
    for (status, count) in [
        (old, None),
        (failed, Some("1")),
        (published, Some("1")),
        (resumed, Some("2")),
    ] {
        let text = metrics_after(&around, &mut view, status).await;
        let labels = "leaderboard=\"one/board\",class=\"Participant\",reason=\"AgentCrashed\"";
        let found = text.lines().find(|line| line.starts_with(family));
        assert_eq!(
            found,
            count.map(|count| format!("{family}{labels}}} {count}")).as_deref()
        );
    }
}
