//! A split's leaderboard, ranked as the server ranks it. Used by the API and the page; pure.

use std::cmp::Ordering;
use std::collections::BTreeSet;

use serde_json::{Value, json};

use crate::model::{LeaderboardRow, Split, Status, Submission};
use crate::reply::Reply;
use crate::state::State;
use crate::views;

/// The public entries of a split, best first, one a team: each as the API shows it. Missing metrics are `"#"`. The
/// server reads the metric that ranks as a number and raises on a bool, so one such row is a 500 for all readers.
pub(crate) fn entries(state: &State, split: u64, order_by: Option<&str>) -> Result<Vec<Value>, Reply> {
    let Some((_, _, board)) = state.split(split) else {
        return Ok(Vec::new());
    };
    let order = order_by.filter(|label| board.schema.labels.iter().any(|known| known == label));
    let order = order.unwrap_or(&board.schema.default_order_by);
    let score = |row: &LeaderboardRow| row.result.get(order).and_then(Value::as_f64).unwrap_or(0.0);
    // Newest first, as equal scores stay in the server.
    let rows = state.rows.values().rev().filter(|row| row.split == split);
    let with = rows.filter_map(|row| Some((row, state.submissions.get(&row.submission)?)));
    let mut found: Vec<_> = with
        .filter(|(_, submission)| is_shown(state, split, submission))
        .collect();
    if found
        .iter()
        .any(|(row, _)| row.result.get(order).is_some_and(Value::is_boolean))
    {
        return Err(Reply::server_error());
    }
    found.sort_by(|(a, _), (b, _)| {
        let by_score = score(a).partial_cmp(&score(b)).unwrap_or(Ordering::Equal);
        if is_descending(board, order) {
            by_score.reverse()
        } else {
            by_score
        }
    });
    let mut teams = BTreeSet::new();
    found.retain(|(_, submission)| submission.is_baseline || teams.insert(submission.participant_team));
    let entry = |(row, submission)| entry(state, board, row, submission, score(row));
    Ok(found.into_iter().map(entry).collect())
}

/// True if a higher value is better. The schema's word on a metric comes before the split's own order, and is ascending by default.
fn is_descending(board: &Split, metric: &str) -> bool {
    match board.schema.metadata.get(metric).filter(|about| !about.is_null()) {
        Some(about) => about.get("sort_ascending") == Some(&Value::Bool(false)),
        None => board.is_leaderboard_order_descending,
    }
}

fn is_shown(state: &State, split: u64, submission: &Submission) -> bool {
    let Some((challenge, phase, _)) = state.split(split) else {
        return false;
    };
    let status = submission.status == Status::Finished
        || submission.status == Status::PartiallyEvaluated && phase.is_partial_submission_evaluation_enabled;
    let of_host = phase.is_public && challenge.hosts.contains(&submission.created_by) && !submission.is_baseline;
    status && !submission.is_flagged && submission.is_public && !of_host
}

fn entry(state: &State, board: &Split, row: &LeaderboardRow, submission: &Submission, score: f64) -> Value {
    let metric = |label: &String| row.result.get(label).cloned().unwrap_or(json!("#"));
    json!({
        "id": row.id,
        "submission__participant_team": submission.participant_team,
        "submission__participant_team__team_name": state.team(submission.participant_team).map(|team| &team.name),
        "submission__participant_team__team_url": "",
        "submission__is_baseline": submission.is_baseline,
        "submission__is_public": submission.is_public,
        "challenge_phase_split": board.id,
        "result": board.schema.labels.iter().map(metric).collect::<Vec<_>>(),
        "error": null,
        "filtering_score": score,
        "filtering_error": 0,
        "leaderboard__schema": board.schema,
        "submission__submitted_at": views::time(submission.submitted_at),
        "submission__method_name": submission.method_name,
        "submission__id": submission.id,
        "submission__submission_metadata": submission.submission_metadata,
        "submission__is_verified_by_host": submission.is_verified_by_host,
    })
}
