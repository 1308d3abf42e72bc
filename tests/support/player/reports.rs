//! The script of a run that goes well: a report with a route more in every round, until the curtain falls or a stop comes.

use std::collections::BTreeMap;
use std::sync::{Arc, LazyLock};
use std::time::Duration;

use evalai_stand_in::Config;
use futures::FutureExt;
use futures::future::BoxFuture;
use kube::ResourceExt;
use kube::runtime::wait::await_condition;
use leaderboard_api::{Attempt, Metric, State, Submission, WorkerState, names};
use leaderboard_aws::archive::Archive;
use leaderboard_contract::report::{Outcome, REPORT_KEY, Report, ReportWorker, SCHEMA};
use serde_json::json;
use tokio::time::{Instant, interval_at};

use super::{Part, agent_first, played, status};

/// Routes of every run.
pub const ROUTES: u32 = 1000;

/// Plays Jobs whose reports go to this bucket, one in each period.
pub fn reports(
    period: Duration,
    s3: aws_sdk_s3::Client,
    bucket: &str,
) -> impl Fn(Part) -> BoxFuture<'static, ()> + Send + Sync + use<> {
    reports_as(period, s3, bucket, |report| report)
}

/// The same with each report changed.
pub fn reports_as(
    period: Duration,
    s3: aws_sdk_s3::Client,
    bucket: &str,
    change: fn(Report) -> Report,
) -> impl Fn(Part) -> BoxFuture<'static, ()> + Send + Sync + use<> {
    let place: Arc<(aws_sdk_s3::Client, String)> = Arc::new((s3, bucket.to_owned()));
    move |part| {
        let run = &part.job.labels()[names::LABEL_RUN];
        let archive = Archive::new(place.0.clone(), &place.1, format!("{run}/"));
        play(part, archive, period, change).boxed()
    }
}

async fn play(mut part: Part, archive: Archive, period: Duration, change: fn(Report) -> Report) {
    let dressed = |phase: &str, state| status(&part.pod, phase, digest, &state);
    let name = part.pod.name_any();
    let running = dressed("Running", played::running());
    let first = agent_first(&part.pod, digest);
    part.cluster.set_pod(&name, first.as_ref().unwrap_or(&running)).await;
    part.cluster.set_job(&part.job, &played::job_started()).await;
    if first.is_some() {
        let submission = &part.job.labels()[names::LABEL_SUBMISSION];
        await_condition(part.cluster.api(), submission, runs).await.unwrap();
        part.cluster.set_pod(&name, &running).await;
    }
    let (submission, pod) = (part.job.owner_references()[0].uid.clone(), part.pod.uid().unwrap());
    let report = |round: u32, done| Report {
        round: round.into(),
        ..change(report(submission.clone(), pod.clone(), done))
    };
    // Not all at the same moment, as Pods are not.
    let first = Instant::now() + period.mul_f64(fastrand::f64());
    let mut tick = interval_at(first, period);
    let mut round = 0;
    let stopped = loop {
        tokio::select! {
            biased;
            stopped = part.cue.comes() => break stopped,
            _ = tick.tick() => {}
        }
        round += 1;
        put(&archive, &report(round, round.min(ROUTES - 1))).await;
    };
    let done = if stopped.is_some() {
        round.min(ROUTES - 1)
    } else {
        ROUTES
    };
    let last = Report {
        is_final: true,
        stopped,
        ..report(round + 1, done)
    };
    put(&archive, &last).await;
    part.cluster
        .set_pod(&name, &dressed("Succeeded", played::ended(0, "")))
        .await;
    part.cluster.set_job(&part.job, &played::job_complete()).await;
    part.has_ended();
}

/// The controller has seen that the agent runs.
fn runs(submission: Option<&Submission>) -> bool {
    let status = submission.and_then(|submission| submission.status.as_ref());
    status.is_some_and(|status| status.state_of_conditions() == State::Running)
}

/// Name of an image by its digest, as a registry gives it to a node.
fn digest(image: &str) -> String {
    let repository = image.split(['@', ':']).next().unwrap_or_default();
    format!("{repository}@sha256:{}", "a".repeat(64))
}

async fn put(archive: &Archive, report: &Report) {
    archive
        .put(REPORT_KEY, serde_json::to_vec(report).unwrap())
        .await
        .unwrap();
}

/// Metrics of a result in the first challenge of EvalAI's stand-in.
static LABELS: LazyLock<Vec<String>> = LazyLock::new(|| {
    let (config, _) = Config::in_memory().unwrap();
    config.seed.challenges[0].phases[0].splits[0].schema.labels.clone()
});

/// Report of the first attempt with so many routes done; the last one of a run if that is all of them.
pub fn report(submission_uid: String, pod_uid: String, done: u32) -> Report {
    let score = f64::from(done) * 100.0 / f64::from(ROUTES);
    let accuracies: BTreeMap<_, _> = LABELS.iter().map(|label| (label.clone(), score)).collect();
    let is_last = done == ROUTES;
    Report {
        schema: SCHEMA,
        submission_uid,
        attempt: Attempt(1),
        pod_uid,
        round: done.into(),
        done,
        total: ROUTES,
        unit: "routes".into(),
        workers: vec![ReportWorker {
            id: 1,
            done,
            total: ROUTES,
            crashes: 0,
            state: WorkerState::Running,
            names_crash: false,
        }],
        merger: None,
        score: Some(Metric::new("Driving score", score, 2)),
        metrics: Vec::new(),
        is_final: is_last,
        eligible: is_last,
        outcome: if is_last { Outcome::Finished } else { Outcome::Running },
        stopped: None,
        refused: None,
        unusable: None,
        warnings: Vec::new(),
        logs: None,
        results: json!([{"split": "leaderboard", "show_to_participant": true, "accuracies": accuracies}]).to_string(),
        partial_results: None,
        agents_fill_disk: false,
        files: BTreeMap::new(),
    }
}
