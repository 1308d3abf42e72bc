//! The texts of a result: what EvalAI shows, and the row of the table. Numbers come from the report alone, never printed
//! again; texts from S3 count only with the digest that the report names.

use std::time::Duration;

use jiff::SignedDuration;
use leaderboard_results::{Format, metrics, number_text};
use serde_json::Value;
use sha2::{Digest, Sha256};

use super::bucket::BucketError;
use super::context::Context;
use super::failure_log::Tail;
use super::sync::END_WAITS;
use super::view::View;
use crate::pod::report::Report;
use crate::pod::upload::hex;
use crate::services::evalai::Payload;
use crate::services::table::Row;
use leaderboard_api::{FailureClass, LeaderboardVersion, LogTail, State, SubmissionStatus};

/// Largest text that is passed on to EvalAI, in bytes.
const MAX_TEXT: u64 = 16 << 20;
/// Time a text may take to be read.
const TEXT_TIMEOUT: Duration = Duration::from_secs(20);
/// Where logcopy puts the texts, below the run's prefix.
const STDOUT_KEY: &str = "evalai/stdout.txt";
const METADATA_KEY: &str = "evalai/metadata.json";

/// Why there is no text of a result.
#[derive(thiserror::Error, Debug)]
pub(super) enum TextError {
    /// It may come.
    #[error(transparent)]
    Unread(#[from] BucketError),
    /// What is stored is not what the report names: the Pod ended between the two. It will hardly change.
    #[error("{key} {problem}")]
    Unfit {
        /// Below the run's prefix.
        key: &'static str,
        problem: &'static str,
    },
}

impl TextError {
    /// How long an end waits for its texts.
    pub(super) fn patience(&self) -> SignedDuration {
        match self {
            Self::Unread(_) => END_WAITS,
            Self::Unfit { .. } => SignedDuration::from_mins(10),
        }
    }
}

/// The payload of a final result.
pub(super) async fn payload(context: &Context, view: &View, report: &Report) -> Result<Payload, TextError> {
    let text = |key| stored(context, view, report, key);
    let (stdout, metadata) = futures::future::try_join(text(STDOUT_KEY), text(METADATA_KEY)).await?;
    Ok(Payload {
        stdout,
        metadata,
        ..without_texts(view, report)
    })
}

/// The payload of a partial result. `is_shown` says that its phase's leaderboard shows it.
pub(super) async fn partial_payload(
    context: &Context,
    view: &View,
    report: &Report,
    is_shown: bool,
) -> Result<Payload, TextError> {
    let payload = payload(context, view, report).await?;
    Ok(Payload {
        result: partial_results(report, is_shown).to_owned(),
        ..payload
    })
}

/// The metrics over the routes so far where people see them, else the original's zeros: EvalAI keeps them, and would show them as
/// final of a row that its participant calls finished.
fn partial_results(report: &Report, is_shown: bool) -> &str {
    let so_far = report.partial_results.as_ref().filter(|_| is_shown);
    so_far.unwrap_or(&report.results)
}

/// The numbers alone.
pub(super) fn without_texts(view: &View, report: &Report) -> Payload {
    Payload {
        phase: phase(view),
        result: report.results.clone(),
        ..Payload::default()
    }
}

/// Phase whose leaderboard gets the result.
pub(super) fn phase(view: &View) -> i64 {
    view.submission.spec.evalai.map_or(0, |e| e.phase)
}

/// What the participant reads of a failure: class, sentence and a next step that a participant can do, in our words only.
pub(super) fn stderr(status: &SubmissionStatus) -> String {
    let Some(failure) = &status.failure else {
        return String::new();
    };
    let class = match failure.class {
        FailureClass::Participant => "participant",
        FailureClass::Infrastructure => "infrastructure, not charged",
    };
    let text = failure.participant_message.as_ref().unwrap_or(&failure.message);
    format!("{} ({class}): {text}", failure.reason)
}

/// Who may read the log of a failure.
pub(super) fn log_readers(view: &View) -> LogTail {
    let leaderboard = view.leaderboard.as_ref();
    let evalai = leaderboard.and_then(|l| l.spec.evalai.as_ref());
    evalai.map(|e| e.log_tail).unwrap_or_default()
}

/// Puts the log of a failure where those who may read it find it. Participants get no log but their own program's: the
/// others' are the host's.
pub(super) fn add_log(payload: &mut Payload, tail: Option<Tail>, readers: LogTail) {
    let Some(tail) = tail else { return };
    if readers == LogTail::Participants && tail.is_agents() {
        payload.stderr = format!("{}\n\n{}", payload.stderr, tail.for_participants());
    }
    payload.environment_log = tail.for_hosts();
}

async fn stored(context: &Context, view: &View, report: &Report, key: &'static str) -> Result<String, TextError> {
    let unfit = |problem| TextError::Unfit { key, problem };
    let Some(expected) = report.files.get(key) else {
        return Ok(String::new());
    };
    let status = view.submission.status.as_ref();
    let Some(plan) = status.and_then(|s| s.plan.as_ref()) else {
        return Ok(String::new());
    };
    let archive = context.archive(&plan.storage, &plan.run_id);
    let read = archive.get(key, MAX_TEXT);
    let object = context.buckets.call_large(&plan.storage, TEXT_TIMEOUT, read).await;
    let missing = || unfit("is missing although the report names it");
    let bytes = object?.ok_or_else(missing)?.bytes;
    if hex(&Sha256::digest(&bytes)) != expected.sha256 {
        return Err(unfit("is of another round than the report"));
    }
    String::from_utf8(bytes).map_err(|_| unfit("is not text"))
}

/// The row of a submission as it stands; none before it has a team. Only a finished one has metrics, those of its report, as in
/// the original's table: of every other the columns are absent, whatever an earlier operator has written there.
pub(super) fn row(report: Option<&Report>, status: &SubmissionStatus) -> Option<Row> {
    let team = status.team.as_ref()?;
    let plan = status.plan.as_ref()?;
    let text = |time: Option<&k8s_openapi::apimachinery::pkg::apis::meta::v1::Time>| {
        time.map_or_else(|| "-".to_owned(), |t| t.0.strftime("%Y-%m-%d %H:%M:%S UTC").to_string())
    };
    Some(Row {
        team_id: team.id.clone()?,
        run_id: plan.run_id.clone(),
        attempt: status.attempt.unwrap_or(1),
        team_name: team.name.clone().unwrap_or_default(),
        submission_status: table_status(status.state).to_owned(),
        track_id: plan.phase.map(|p| p.to_string()).unwrap_or_default(),
        track_name: plan.codename.clone(),
        submitted_image_uri: plan.image.clone(),
        submitted_time: text(status.times.submitted.as_ref()),
        start_time: text(status.times.started.as_ref()),
        end_time: text(status.times.finished.as_ref()),
        results: status.results_url.clone().unwrap_or_default(),
        progress: status.progress.as_ref().map(|p| p.text.clone()).unwrap_or_default(),
        rerun_as: status
            .rerun_as
            .as_ref()
            .map(|r| r.submission_name.clone())
            .unwrap_or_default(),
        metrics: columns(report.filter(|_| is_finished(status)), plan.leaderboard_version),
    })
}

/// Whether its results count.
pub(super) fn is_finished(status: &SubmissionStatus) -> bool {
    status.state == Some(State::Finished)
}

fn table_status(state: Option<State>) -> &'static str {
    match state {
        None | Some(State::Pending) => "SUBMITTED",
        Some(State::Running | State::Resumed) => "RUNNING",
        Some(State::Finished) => "FINISHED",
        Some(State::Failed) => "FAILED",
        Some(State::Cancelled) => "CANCELLED",
    }
}

/// The metric columns, as text with the digits of results.json; those without a value are to be removed.
fn columns(report: Option<&Report>, format: LeaderboardVersion) -> Vec<(String, Option<String>)> {
    let format = match format {
        LeaderboardVersion::V1 => Format::V1,
        LeaderboardVersion::V2 => Format::V2,
    };
    let parsed: Value = report
        .and_then(|report| serde_json::from_str(&report.results).ok())
        .unwrap_or_default();
    let accuracies = &parsed[0]["accuracies"];
    let text = |value: &Value| match value.as_f64().filter(|_| value.is_f64()) {
        Some(number) => number_text(number),
        None => value.to_string(),
    };
    let all = metrics(format)
        .iter()
        .map(|metric| (metric.column.to_owned(), accuracies.get(metric.name).map(text)));
    all.collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn report(results: &str) -> Report {
        serde_json::from_value(json!({
            "schema": 1, "submissionUid": "u", "attempt": 1, "podUid": "p", "round": 9, "done": 1, "total": 4, "pairs": [],
            "final": false, "eligible": false, "entryStatus": "Started", "results": results, "partialResults": "so far",
        }))
        .unwrap()
    }

    fn plan() -> Value {
        json!({
            "runId": "7", "leaderboardVersion": "V2", "track": "sensors", "codename": "SENSORS", "slices": ["0-3"], "routes": 4,
            "repetitions": 1, "storage": {"bucket": "b"}, "image": "i", "contentsImage": "c", "simulatorImage": "s",
        })
    }

    #[test]
    fn columns_keep_the_digits_and_the_names_of_the_original() {
        let results = r#"[{"split": "leaderboard", "accuracies": {"Driving score": 43.125, "Off-road infractions": 0.0, "Agent blocked": 0}}]"#;
        let found = columns(Some(&report(results)), LeaderboardVersion::V2);
        let get = |name: &str| found.iter().find(|(n, _)| n == name).and_then(|(_, v)| v.as_deref());
        assert_eq!(get("driving_score"), Some("43.125"));
        assert_eq!(get("off_road_infractions"), Some("0.0"));
        assert_eq!(get("agent_blocked"), Some("0"));
        assert_eq!(found.len(), 15);
    }

    #[test]
    fn only_the_row_of_a_finished_submission_has_metrics() {
        let report = report(r#"[{"split": "leaderboard", "accuracies": {"Driving score": 43.125}}]"#);
        let score = |state: &str| {
            let status = json!({"state": state, "team": {"id": "3"}, "plan": plan()});
            let row = row(Some(&report), &serde_json::from_value(status).unwrap()).unwrap();
            assert_eq!(row.metrics.len(), 15, "what is not there is removed");
            row.metrics[0].clone()
        };
        for state in ["Pending", "Running", "Resumed", "Failed", "Cancelled"] {
            assert_eq!(score(state), ("driving_score".to_owned(), None), "{state}");
        }
        assert_eq!(score("Finished").1.as_deref(), Some("43.125"));
    }

    #[test]
    fn a_log_is_shown_to_hosts_alone_unless_they_say_otherwise() {
        let shown = |container: &str, readers| {
            let tail = Tail {
                container: container.into(),
                attempt: 1,
                key: Some("agent/agent1/leaderboard.log".into()),
                text: "route 7".into(),
            };
            let mut payload = Payload {
                stderr: "AgentCrashed (participant): it crashed.".into(),
                ..Payload::default()
            };
            add_log(&mut payload, Some(tail), readers);
            assert!(
                payload
                    .environment_log
                    .ends_with("in agent/agent1/leaderboard.log.\nroute 7")
            );
            assert!(
                !payload.stderr.contains("leaderboard.log"),
                "no file that only hosts can read"
            );
            assert!(!payload.stdout.contains("route") && !payload.metadata.contains("route"));
            payload.stderr
        };
        for container in ["agent-1", "simulator-1", "contents"] {
            assert!(!shown(container, LogTail::Hosts).contains("route"), "{container}");
        }
        let told = "it crashed.\n\nThe end of agent-1's log in attempt 1:\nroute 7";
        assert!(shown("agent-1", LogTail::Participants).ends_with(told));
        for container in ["simulator-1", "contents", "workspace", "logcopy"] {
            assert!(
                !shown(container, LogTail::Participants).contains("route"),
                "{container}"
            );
        }
    }

    #[test]
    fn a_partial_result_has_the_metrics_so_far_where_a_report_has_them() {
        let mut report = report("zeros");
        assert_eq!(partial_results(&report, true), "so far");
        assert_eq!(
            partial_results(&report, false),
            "zeros",
            "nobody is to see them before the end"
        );
        report.partial_results = None;
        assert_eq!(partial_results(&report, true), "zeros", "of an older operator's Pod");
    }

    #[test]
    fn a_broken_report_has_no_columns() {
        let found = columns(Some(&report("not json")), LeaderboardVersion::V2);
        assert!(found.iter().all(|(_, value)| value.is_none()));
    }
}
