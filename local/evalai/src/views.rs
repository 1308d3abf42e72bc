//! Rows as the API shows them. Pure; `base` is the scheme and host the client used, as the server builds file links.

use jiff::Timestamp;
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

/// A submission, as `viewer` may see it: only hosts see the environment's log.
pub fn submission(state: &State, row: &Submission, viewer: &User, base: &str) -> Value {
    let file = |path: &Option<String>| path.as_ref().map(|path| format!("{base}/media/{path}"));
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
        "input_file": file(&row.input_file),
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

/// A challenge, as a worker learns of it by its queue.
pub fn challenge(row: &Challenge) -> Value {
    json!({
        "id": row.id,
        "title": row.title,
        "start_date": "2020-01-01T00:00:00Z",
        "end_date": "2099-12-31T23:59:59Z",
        "submission_time_limit": 86_400,
        "remote_evaluation": row.remote_evaluation,
        "is_docker_based": row.is_docker_based,
        "is_static_dataset_code_upload": false,
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

/// A phase.
pub fn phase(challenge: &Challenge, row: &Phase) -> Value {
    json!({
        "id": row.id,
        "name": row.name,
        "codename": row.codename,
        "slug": format!("{}-{}", row.codename.to_lowercase(), row.id),
        "challenge": challenge.id,
        "environment_image": null,
        "is_active": row.is_active,
        "is_public": row.is_public,
        "is_submission_public": true,
        "is_submission_paused": false,
        "disable_logs": false,
        "leaderboard_public": true,
        "max_concurrent_submissions_allowed": row.max_concurrent_submissions_allowed,
        "is_partial_submission_evaluation_enabled": row.is_partial_submission_evaluation_enabled,
    })
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
