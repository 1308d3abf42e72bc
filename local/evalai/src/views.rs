//! Rows as the API shows them. Pure; `base` is the scheme and host the client used, as the server builds file links.

use jiff::Timestamp;
use jiff::civil::DateTime;
use jiff::tz::TimeZone;
use serde_json::{Value, json};

use crate::model::{Challenge, Phase, Split, Submission, User};
use crate::state::State;

/// A time as Django REST framework writes it.
pub fn time(at: Timestamp) -> String {
    let format = if at.subsec_nanosecond() == 0 {
        "%Y-%m-%dT%H:%M:%SZ"
    } else {
        "%Y-%m-%dT%H:%M:%S.%6fZ"
    };
    at.strftime(format).to_string()
}

/// Why a text is no time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BadTime {
    /// It has not the form of one.
    Shape,
    /// It has the form of one, and there is no such day or hour.
    Value,
}

/// A time as Django reads it: `YYYY-MM-DDTHH:MM[:SS[.ffffff]]` with `Z`, an offset or, meaning UTC, nothing.
pub fn parse_time(text: &str) -> Result<Timestamp, BadTime> {
    let shape = text.len() >= 16
        && text
            .bytes()
            .zip(*b"0000-00-00T00:00")
            .all(|(byte, wanted)| match wanted {
                b'0' => byte.is_ascii_digit(),
                b'T' => matches!(byte, b'T' | b' '),
                _ => byte == wanted,
            });
    if !shape {
        return Err(BadTime::Shape);
    }
    if let Ok(at) = text.parse() {
        return Ok(at);
    }
    let civil: Option<DateTime> = text.parse().ok();
    let at = civil
        .and_then(|civil| civil.to_zoned(TimeZone::UTC).ok())
        .map(|zoned| zoned.timestamp());
    at.ok_or(BadTime::Value)
}

/// A submission, as `viewer` may see it: only hosts see the environment's log.
pub fn submission(state: &State, row: &Submission, viewer: &User, base: &str) -> Value {
    let file = |path: &Option<String>| path.as_ref().map(|path| format!("{base}/media/{path}"));
    let signature = state.signature.map(|signature| format!("?signature={signature}"));
    let input_file = file(&row.input_file).map(|url| url + signature.as_deref().unwrap_or_default());
    let execution_time = match (row.started_at, row.completed_at) {
        (Some(started), Some(completed)) => Value::from(completed.duration_since(started).as_secs_f64()),
        _ => Value::from("None"),
    };
    let mut view = json!({
        "id": row.id,
        "participant_team": row.participant_team,
        "participant_team_name": state.team(row.participant_team).map(|team| &team.name),
        "execution_time": execution_time,
        "challenge_phase": row.challenge_phase,
        "created_by": row.created_by,
        "status": row.status,
        "input_file": input_file,
        "submission_input_file": file(&row.submission_input_file),
        "stdout_file": file(&row.stdout_file),
        "stderr_file": file(&row.stderr_file),
        "started_at": row.started_at.map(time),
        "completed_at": row.completed_at.map(time),
        "submitted_at": time(row.submitted_at),
        "rerun_resumed_at": row.rerun_resumed_at.map(time),
        "method_name": row.method_name,
        "method_description": row.method_description,
        "project_url": row.project_url,
        "publication_url": row.publication_url,
        "is_public": row.is_public,
        "is_flagged": row.is_flagged,
        "ignore_submission": row.ignore_submission,
        "submission_result_file": file(&row.submission_result_file),
        "when_made_public": row.when_made_public.map(time),
        "is_baseline": row.is_baseline,
        "job_name": row.job_name,
        "submission_metadata": row.submission_metadata,
        "is_verified_by_host": row.is_verified_by_host,
    });
    if state
        .challenge_of(row)
        .is_some_and(|challenge| challenge.hosts.contains(&viewer.id))
    {
        view["environment_log_file"] = json!(file(&row.environment_log_file));
    }
    view
}

/// A challenge, as far as workers read it.
pub fn challenge(row: &Challenge) -> Value {
    json!({
        "id": row.id,
        "title": row.title,
        "start_date": "2020-01-01T00:00:00Z",
        "end_date": "2099-12-31T23:59:59Z",
        "submission_time_limit": 86_400,
        "remote_evaluation": row.remote_evaluation,
        "is_docker_based": row.is_docker_based,
        "is_static_dataset_code_upload": row.is_static_dataset_code_upload,
        "is_active": row.is_active,
        "allow_resuming_submissions": row.allow_resuming_submissions,
        "allow_host_cancel_submissions": row.allow_host_cancel_submissions,
        "allow_cancel_running_submissions": row.allow_cancel_running_submissions,
        "allow_participants_resubmissions": row.allow_participants_resubmissions,
        "cpu_only_jobs": false,
        "job_cpu_cores": "2000m",
        "job_memory": "8Gi",
        "sqs_retention_period": 345_600,
        "use_fifo_sqs": is_fifo(&row.queue),
    })
}

/// Is a queue of this name a FIFO queue?
pub fn is_fifo(queue: &str) -> bool {
    std::path::Path::new(queue)
        .extension()
        .is_some_and(|extension| extension == "fifo")
}

/// A phase; hosts see more of it.
pub fn phase(challenge: &Challenge, row: &Phase, host: bool) -> Value {
    let title = challenge.title.split(' ').next().unwrap_or_default().to_lowercase();
    let mut view = json!({
        "id": row.id,
        "name": row.name,
        "description": row.name,
        "leaderboard_public": true,
        "start_date": "2020-01-01T00:00:00Z",
        "end_date": "2099-12-31T23:59:59Z",
        "challenge": challenge.id,
        "max_submissions_per_day": 100_000,
        "max_submissions_per_month": 100_000,
        "max_submissions": 100_000,
        "submission_artifact_retention_policy": "keep_forever",
        "is_public": row.is_public,
        "is_active": row.is_active,
        "codename": row.codename,
        "slug": format!("{title}-{}-{}", row.codename.replace(' ', "-").to_lowercase(), challenge.id),
        "max_concurrent_submissions_allowed": row.max_concurrent_submissions_allowed,
        "is_restricted_to_select_one_submission": false,
        "submission_meta_attributes": null,
        "is_partial_submission_evaluation_enabled": row.is_partial_submission_evaluation_enabled,
        "allowed_submission_file_types": ".json, .zip, .txt, .tsv, .gz, .csv, .h5, .npy",
        "default_submission_meta_attributes": null,
        "allowed_email_ids": [],
        "is_submission_public": true,
        "disable_logs": false,
        "is_submission_paused": false,
    });
    if host {
        for name in ["environment_image", "test_annotation", "config_id"] {
            view[name] = Value::Null;
        }
        view["annotations_uploaded_using_cli"] = json!(false);
    }
    view
}

/// A phase split. The codename of its dataset split is not in it.
pub fn split(phase: &Phase, row: &Split) -> Value {
    json!({
        "id": row.id,
        "dataset_split": row.dataset_split.id,
        "dataset_split_name": row.dataset_split.name,
        "challenge_phase": phase.id,
        "challenge_phase_name": phase.name,
        "visibility": if row.public { 3 } else { 1 },
        "show_leaderboard_by_latest_submission": false,
        "show_execution_time": false,
        "show_scores_on_leaderboard": true,
        "leaderboard_schema": row.schema,
        "is_multi_metric_leaderboard": true,
    })
}

/// The settings of a split with the fields that only its own request shows.
pub fn split_settings(phase: &Phase, row: &Split) -> Value {
    json!({
        "id": row.id,
        "challenge_phase": phase.id,
        "dataset_split": row.dataset_split.id,
        "leaderboard": row.leaderboard,
        "visibility": if row.public { 3 } else { 1 },
        "leaderboard_decimal_precision": 2,
        "is_leaderboard_order_descending": row.is_leaderboard_order_descending,
        "show_leaderboard_by_latest_submission": false,
        "show_execution_time": false,
        "show_scores_on_leaderboard": true,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_djangos() {
        for (at, text) in [
            ("2026-11-21T10:09:08.123456Z", "2026-11-21T10:09:08.123456Z"),
            ("2026-11-21T10:09:08.000001Z", "2026-11-21T10:09:08.000001Z"),
            ("2026-11-21T10:09:08Z", "2026-11-21T10:09:08Z"),
        ] {
            assert_eq!(time(at.parse().unwrap()), text);
        }
    }
}
