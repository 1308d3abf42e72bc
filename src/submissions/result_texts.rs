//! The texts of a result: what EvalAI shows, and the row of the table. Pure: `payloads` reads what S3 holds of the first.

use serde_json::Value;

use super::failure_log::Tail;
use leaderboard_api::{FailureClass, LogTail, RunPlan, State, SubmissionStatus, effective};
use leaderboard_aws::table::Row;
use leaderboard_evalai::{Outline, Patience, StoredResult};
use leaderboard_evaluation::{number_text, of_plan};
use leaderboard_policy::report_digest::{ReportDigest, Split};
use leaderboard_policy::view::View;

/// Most columns of a result whose metrics its host names: DynamoDB takes an expression of 4 KB.
const MAX_COLUMNS: usize = 128;

/// Where the parts of the result come from; without stored results, none comes from a bucket. `so_far`: with the metrics of the units
/// done so far, else with the original's zeros.
pub(super) fn outline(view: &View, status: &SubmissionStatus, so_far: bool, patience: Patience) -> Outline {
    let stored = view
        .report
        .ours()
        .zip(status.plan.as_ref())
        .map(|(report, plan)| StoredResult {
            storage: plan.storage.s3.clone(),
            prefix: effective::key_prefix(&plan.storage.s3, &plan.run_id),
            report: report.id,
            done: report.done,
            so_far,
            patience,
        });
    Outline {
        phase: view.submission.spec.evalai.map_or(0, |evalai| evalai.phase),
        stored,
        ..Outline::default()
    }
}

/// A failure for the participant, in our own words: reason, class, and a sentence with a next step that a participant can do.
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

/// The people who may read the log of a failure.
pub(super) fn log_readers(view: &View) -> LogTail {
    let leaderboard = view.leaderboard.as_ref();
    let evalai = leaderboard.and_then(|l| l.spec.evalai.as_ref());
    evalai.map(|e| e.log_tail).unwrap_or_default()
}

/// Puts the log of a failure where those who may read it find it. Participants get no log but their own program's: the
/// others' are the host's.
pub(super) fn add_log(payload: &mut Outline, tail: Option<Tail>, readers: LogTail) {
    let Some(tail) = tail else { return };
    if readers == LogTail::Participants && tail.is_agents() {
        payload.stderr = format!("{}\n\n{}", payload.stderr, tail.for_participants());
    }
    payload.environment_log = tail.for_hosts();
}

/// The present row of a submission; None before it has a team. Only a finished one has metrics, those of its report, as in the
/// original's table. In every other row their columns are absent, also if an earlier operator has written them.
pub(super) fn row(report: Option<&ReportDigest>, status: &SubmissionStatus) -> Option<Row> {
    let team = status.team.as_ref()?;
    let plan = status.plan.as_ref()?;
    let text = |time: Option<&k8s_openapi::apimachinery::pkg::apis::meta::v1::Time>| {
        time.map_or_else(|| "-".to_owned(), |t| t.0.strftime("%Y-%m-%d %H:%M:%S UTC").to_string())
    };
    Some(Row {
        team_id: team.id.clone()?,
        run_id: plan.run_id.to_string(),
        attempt: attempt_of_run(status),
        team_name: team.name.clone().unwrap_or_default(),
        submission_status: table_status(status.state_of_conditions()).to_owned(),
        track_id: plan.phase.map(|p| p.to_string()).unwrap_or_default(),
        track_name: plan.carla().map_or(&plan.track, |carla| &carla.codename).to_string(),
        submitted_image_uri: plan.image.clone().unwrap_or_default(),
        submitted_time: text(status.times.submitted.as_ref()),
        start_time: text(status.times.started.as_ref()),
        end_time: text(status.times.finished.as_ref()),
        results: status.results_url.clone().unwrap_or_default(),
        progress: status.progress.as_ref().map(|p| p.text.clone()).unwrap_or_default(),
        gpu_seconds: gpu_seconds(status),
        metrics: columns(report, plan, status.state_of_conditions() == State::Finished),
    })
}

/// GPU seconds of a submission that has ended, as text; empty before, because each Job would cost a further write.
fn gpu_seconds(status: &SubmissionStatus) -> String {
    let has_ended = status.state_of_conditions().is_terminal();
    let used = status.usage.filter(|usage| has_ended && usage.gpu_seconds > 0);
    used.map(|usage| usage.gpu_seconds.to_string()).unwrap_or_default()
}

/// The attempt as the row counts it: also those of an earlier Submission of the same run, which is gone.
pub(super) fn attempt_of_run(status: &SubmissionStatus) -> i64 {
    let earlier = status.plan.as_ref().map_or(0, |plan| plan.earlier_attempts);
    status.attempt.unwrap_or_default().0.saturating_add(earlier)
}

fn table_status(state: State) -> &'static str {
    match state {
        State::Pending => "SUBMITTED",
        State::Running | State::Resumed => "RUNNING",
        State::Finished => "FINISHED",
        State::Failed => "FAILED",
        State::Cancelled => "CANCELLED",
    }
}

/// The metric columns, as text with the digits of results.json; those without a value, as all of a result that does not count, are to be
/// removed.
fn columns(report: Option<&ReportDigest>, plan: &RunPlan, counts: bool) -> Vec<(String, Option<String>)> {
    let splits = report.map_or(&[][..], |report| &report.splits);
    let text = |value: &Value| match value.as_f64().filter(|_| value.is_f64()) {
        Some(number) => number_text(number),
        None => value.to_string(),
    };
    let text = |value: &Value| counts.then(|| text(value));
    if let Some(container) = plan.container() {
        let of_split = |split: &Split| {
            let all = split.accuracies.iter();
            let named = all.map(|(label, value)| (container.score.name_of(&split.name, label), text(value)));
            named.collect::<Vec<_>>()
        };
        return splits.iter().flat_map(of_split).take(MAX_COLUMNS).collect();
    }
    let all = of_plan(plan).columns().into_iter().map(|column| {
        let value = splits.first().and_then(|split| split.accuracies.get(column.label));
        (column.name.to_owned(), value.and_then(text))
    });
    all.collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use leaderboard_api::Attempt;
    use serde_json::json;

    fn report(results: &str) -> ReportDigest {
        let report: leaderboard_contract::report::Report = serde_json::from_value(json!({
            "schema": 1, "submissionUid": "u", "attempt": 1, "podUid": "p", "round": 9, "done": 1, "total": 4, "unit": "routes", "workers": [],
            "final": true, "eligible": true, "outcome": "Finished", "results": results,
        }))
        .unwrap();
        ReportDigest::of(&report, leaderboard_contract::report::ContentId::default())
    }

    fn plan() -> Value {
        json!({
            "runId": "7",
                "carla": {"version": "V2", "codename": "SENSORS", "slices": [{"first": 0, "last": 3}],
                    "routes": 4, "repetitions": 1, "contentsImage": "c", "simulatorImage": "s"},
                "track": "sensors", "storage": {"s3": {"bucket": "b"}}, "image": "i",
        })
    }

    /// Columns of a result that counts.
    fn columns_of(results: &str, plan: Value) -> Vec<(String, Option<String>)> {
        columns(Some(&report(results)), &serde_json::from_value(plan).unwrap(), true)
    }

    #[test]
    fn columns_keep_the_digits_and_the_names_of_the_original() {
        let results = r#"[{"split": "leaderboard", "accuracies": {"Driving score": 43.125, "Off-road infractions": 0.0, "Agent blocked": 0}}]"#;
        let found = columns_of(results, plan());
        let get = |name: &str| found.iter().find(|(n, _)| n == name).and_then(|(_, v)| v.as_deref());
        assert_eq!(get("driving_score"), Some("43.125"));
        assert_eq!(get("off_road_infractions"), Some("0.0"));
        assert_eq!(get("agent_blocked"), Some("0"));
        assert_eq!(found.len(), 15);
    }

    fn of_container(split: Option<&str>) -> Value {
        let score = json!({"split": split, "metric": "accuracy", "order": "Descending"});
        json!({
            "runId": "7", "track": "sensors", "storage": {"s3": {"bucket": "b"}}, "image": "i",
            "container": {"mode": "Interactive", "workers": 1, "merge": "Mean", "score": score, "image": "e"},
        })
    }

    #[test]
    fn the_columns_of_a_hosts_evaluator_are_its_own_metrics_behind_the_split_where_the_score_names_one() {
        let one = r#"[{"split": "test", "show_to_participant": true, "accuracies": {"accuracy": 0.50, "games": 3}}]"#;
        let two = r#"[{"split": "dev", "accuracies": {"accuracy": 1e22}}, {"split": "test", "accuracies": {"accuracy": 0.1}}]"#;
        for (results, split, expected) in [
            (one, None, &[("accuracy", "0.5"), ("games", "3")][..]),
            (one, Some("test"), &[("test_accuracy", "0.5"), ("test_games", "3")]),
            (
                two,
                Some("test"),
                &[("dev_accuracy", "1e+22"), ("test_accuracy", "0.1")],
            ),
        ] {
            let found = columns_of(results, of_container(split));
            let found: Vec<_> = found
                .iter()
                .map(|(name, value)| (name.as_str(), value.as_deref().unwrap()))
                .collect();
            assert_eq!(found, expected);
        }
    }

    #[test]
    fn the_metrics_of_a_hosts_evaluator_are_removed_again_where_the_result_does_not_count() {
        let report = report(r#"[{"split": "test", "accuracies": {"accuracy": 0.5}}]"#);
        let condition = json!({"type": "Finished", "status": "True", "reason": "Cancelled", "message": "",
                               "lastTransitionTime": "2026-01-01T00:00:00Z"});
        let status = json!({"conditions": [condition], "team": {"id": "3"}, "plan": of_container(None)});
        let row = row(Some(&report), &serde_json::from_value(status).unwrap()).unwrap();
        assert_eq!(
            (row.track_name.as_str(), row.metrics),
            ("sensors", vec![("accuracy".to_owned(), None)])
        );
    }

    #[test]
    fn the_row_of_a_submitted_file_names_no_image() {
        let mut of_file = of_container(None);
        of_file.as_object_mut().unwrap().remove("image");
        for (plan, expected) in [(plan(), "i"), (of_file, "")] {
            let status = json!({"team": {"id": "3"}, "plan": plan});
            let row = row(None, &serde_json::from_value(status).unwrap()).unwrap();
            assert_eq!(row.submitted_image_uri, expected);
        }
    }

    #[test]
    fn the_row_of_an_ended_submission_has_what_it_used() {
        for (type_, reason, used, expected) in [
            ("Running", "Running", json!({"gpus": 4, "gpuSeconds": 7200}), ""),
            ("Finished", "Finished", json!({"gpus": 4, "gpuSeconds": 7200}), "7200"),
            (
                "Finished",
                "AgentCrashed",
                json!({"gpus": 4, "gpuSeconds": 7200}),
                "7200",
            ),
            ("Finished", "Finished", json!({"gpus": 0, "gpuSeconds": 0}), ""),
            ("Finished", "Finished", Value::Null, ""),
        ] {
            let condition = json!({"type": type_, "status": "True", "reason": reason, "message": "",
                                   "lastTransitionTime": "2026-01-01T00:00:00Z"});
            let status = json!({"conditions": [condition], "team": {"id": "3"}, "plan": plan(), "use": used});
            let row = row(None, &serde_json::from_value(status).unwrap()).unwrap();
            assert_eq!(row.gpu_seconds, expected, "{type_} {reason} {used}");
        }
    }

    #[test]
    fn only_the_row_of_a_finished_submission_has_metrics() {
        let report = report(r#"[{"split": "leaderboard", "accuracies": {"Driving score": 43.125}}]"#);
        let score = |type_: &str, reason: &str| {
            // The stored state decides nothing.
            let stored = if reason == "Finished" { "Failed" } else { "Finished" };
            let condition = json!({"type": type_, "status": "True", "reason": reason, "message": "",
                                   "lastTransitionTime": "2026-01-01T00:00:00Z"});
            let status = json!({"state": stored, "conditions": [condition], "team": {"id": "3"}, "plan": plan()});
            let row = row(Some(&report), &serde_json::from_value(status).unwrap()).unwrap();
            assert_eq!(row.metrics.len(), 15, "what is not there is removed");
            row.metrics[0].clone()
        };
        for (type_, reason) in [
            ("Accepted", "Accepted"),
            ("Running", "Running"),
            ("Finished", "AgentCrashed"),
            ("Finished", "Cancelled"),
        ] {
            let expected = ("driving_score".to_owned(), None);
            assert_eq!(score(type_, reason), expected, "{type_} {reason}");
        }
        assert_eq!(score("Finished", "Finished").1.as_deref(), Some("43.125"));
    }

    #[test]
    fn a_log_is_shown_to_hosts_alone_unless_they_want_it_otherwise() {
        let shown = |container: &str, readers| {
            let tail = Tail {
                container: container.into(),
                attempt: Attempt(1),
                key: Some("agent/agent1/leaderboard.log".into()),
                text: "route 7".into(),
            };
            let mut payload = Outline {
                stderr: "AgentCrashed (participant): it crashed.".into(),
                ..Outline::default()
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
            payload.stderr
        };
        for container in ["agent-1", "simulator-1", "contents"] {
            assert!(!shown(container, LogTail::Hosts).contains("route"), "{container}");
        }
        let text = "it crashed.\n\nThe end of agent-1's log in attempt 1:\nroute 7";
        assert!(shown("agent-1", LogTail::Participants).ends_with(text));
        for container in ["simulator-1", "contents", "workspace", "logcopy"] {
            assert!(
                !shown(container, LogTail::Participants).contains("route"),
                "{container}"
            );
        }
    }

    #[test]
    fn a_broken_report_has_no_columns() {
        let found = columns_of("not json", plan());
        assert!(found.iter().all(|(_, value)| value.is_none()));
    }
}
