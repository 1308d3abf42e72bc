//! The endpoints a host's worker writes to.

use std::time::Duration;

use serde_json::json;

use super::Call;
use crate::app::now;
use crate::errors;
use crate::reply::{Answer, Reply};
use crate::update::{self, Door};
use crate::views;

/// PUT and PATCH of both endpoints for updates: rows are read at the start and saved whole at the end.
pub(super) async fn update(call: &Call, challenge: u64, door: Door) -> Answer {
    let user = call.user()?;
    let staff = door == Door::Update && user.staff;
    if !staff {
        call.host_of(challenge, &errors::NOT_HOST)?;
    }
    let form = call.form().await?;
    let put = call.method == "PUT";
    if put {
        let _turn = call.app.turn.lock().await;
        let turn = call.app.knobs().put_turn_ms;
        pause(turn).await;
    }
    let write = {
        let state = call.app.state();
        if put {
            update::prepare_put(&state, door, &form)?
        } else {
            update::prepare_patch(&state, door, &form, now())?
        }
    };
    let delay = {
        let knobs = call.app.knobs();
        if put { knobs.put_delay_ms } else { knobs.patch_delay_ms }
    };
    pause(delay).await;
    if put && write.is_end() {
        call.app.until(|| !call.app.knobs().put_held).await;
    }
    let progress = write.progress;
    let saved = update::commit(&mut call.app.state(), write, now());
    if progress {
        return call.submission(&saved);
    }
    Ok(Reply::ok(
        &json!({"success": "Submission result has been successfully updated"}),
    ))
}

/// The server works for so long; what others ask meanwhile comes in between.
async fn pause(millis: u64) {
    if millis == 0 {
        tokio::task::yield_now().await;
    } else {
        tokio::time::sleep(Duration::from_millis(millis)).await;
    }
}

/// Starts the clock of a submission again. Any user may.
pub(super) fn started_at(call: &Call, pk: u64) -> Answer {
    let row = {
        let mut state = call.app.state();
        let row = state.submissions.get(&pk).cloned();
        let mut row = row.ok_or_else(|| Reply::from(&errors::STARTED_AT_UNKNOWN))?;
        row.started_at = Some(now());
        state.save(row.clone());
        row
    };
    call.submission(&row)
}

/// A host's correction of a leaderboard row.
pub(super) async fn correct_row(call: &Call, pk: u64) -> Answer {
    let unknown = || Reply::from(&errors::ROW_NOT_FOUND);
    let split = call
        .app
        .state()
        .rows
        .get(&pk)
        .map(|row| row.split)
        .ok_or_else(unknown)?;
    let challenge = call.app.state().split(split).map_or(0, |(challenge, ..)| challenge.id);
    call.host_of(challenge, &errors::NOT_HOST)?;
    let form = call.form().await?;
    let mut state = call.app.state();
    let row = state.rows.get(&pk).ok_or_else(unknown)?;
    let (_, phase, board) = state.split(split).ok_or_else(unknown)?;
    let row = update::correct_row(row, board, &form)?;
    let team = state
        .submissions
        .get(&row.submission)
        .and_then(|submission| state.team(submission.participant_team));
    let view = json!({
        "id": row.id,
        "participant_team_name": team.map(|team| &team.name),
        "challenge_phase_split": row.split,
        "leaderboard_schema": views::split(phase, board)["leaderboard_schema"],
        "result": row.result,
        "error": null,
    });
    state.save_row(row);
    Ok(Reply::ok(&view))
}
