//! The endpoints that only read: lists, phases, splits, leaderboards.

use std::collections::BTreeMap;
use std::time::Duration;

use jiff::Timestamp;
use serde_json::{Value, json};

use super::Call;
use crate::errors;
use crate::leaderboards;
use crate::model::Status;
use crate::reply::{Answer, Reply};
use crate::views::{self, BadTime};

/// The submissions of a challenge, unpaginated and in no order. Read first, answered late, for each row costs queries of
/// its own: a long list is stale.
pub(super) async fn list(call: &Call, challenge: u64) -> Answer {
    let user = call.user()?;
    let rows: Vec<_> = {
        let state = call.app.state();
        let unknown = || Reply::error(&errors::CHALLENGE_NOT_FOUND, &[&challenge.to_string()]);
        state.challenge(challenge).ok_or_else(unknown)?;
        if !user.staff && !state.is_host(user, challenge) {
            return Err((&errors::NOT_HOST).into());
        }
        let status = call.asked("status").map(listable).transpose()?;
        let after = call
            .asked("submitted_after")
            .map(|text| date("submitted_after", text))
            .transpose()?;
        let before = call
            .asked("submitted_before")
            .map(|text| date("submitted_before", text))
            .transpose()?;
        let rows = state.table().into_iter().filter(|row| {
            status.is_none_or(|status| row.status == status)
                && after.is_none_or(|after| row.submitted_at > after)
                && before.is_none_or(|before| row.submitted_at < before)
                && state.challenge_of(row).is_some_and(|of| of.id == challenge)
        });
        rows.map(|row| views::submission(&state, row, user, &call.base))
            .collect()
    };
    let delay = {
        let knobs = call.app.knobs();
        knobs.list_delay_ms + knobs.list_row_ms * rows.len() as u64
    };
    if delay > 0 {
        tokio::time::sleep(Duration::from_millis(delay)).await;
    }
    Ok(Reply::ok(&Value::Array(rows)))
}

fn listable(text: &str) -> Result<Status, Reply> {
    let status = Status::parse(text).filter(|s| !matches!(s, Status::Archived | Status::PartiallyEvaluated));
    status.ok_or_else(|| Reply::error(&errors::LIST_STATUS, &[text]))
}

/// A bound of a list. A text in the shape of a date that is no date raises in the server.
fn date(name: &str, text: &str) -> Result<Timestamp, Reply> {
    views::parse_time(text).map_err(|error| match error {
        BadTime::Shape => Reply::error(&errors::LIST_DATE, &[name]),
        BadTime::Value => Reply::server_error(),
    })
}

/// The user's refresh token, as the profile page shows it.
pub(super) fn auth_token(call: &Call) -> Answer {
    let state = call.app.state();
    let token = state.refresh_token(call.user()?).ok_or_else(Reply::server_error)?;
    Ok(Reply::ok(
        &json!({"token": token, "expires_at": "2099-12-31T23:59:59Z"}),
    ))
}

/// The profile page's button for a new token.
pub(super) fn renew_token(call: &Call) -> Answer {
    let token = call.app.state().renew_token(call.user()?);
    Ok(Reply::ok(&json!({ "token": token })))
}

/// How many submissions of a phase have which status.
pub(super) fn count_by_status(call: &Call, phase: u64) -> Answer {
    let challenge = call.app.state().phase(phase).map(|(challenge, _)| challenge.id);
    let challenge = challenge.ok_or_else(|| Reply::error(&errors::PHASE_NOT_FOUND, &[&phase.to_string()]))?;
    call.host_of(challenge, &errors::NOT_HOST_OF_PHASE)?;
    let state = call.app.state();
    let mut counts: BTreeMap<&str, u64> = BTreeMap::new();
    for row in state.submissions.values().filter(|row| row.challenge_phase == phase) {
        *counts.entry(row.status.as_str()).or_default() += 1;
    }
    let counts: Vec<_> = counts
        .iter()
        .map(|(status, count)| json!({"status": status, "count": count}))
        .collect();
    Ok(Reply::ok(&json!({ "status": counts })))
}

/// A split's leaderboard, best first.
pub(super) fn leaderboard(call: &Call, split: u64) -> Answer {
    let entries = {
        let state = call.app.state();
        let unknown = || Reply::error(&errors::PHASE_SPLIT_NOT_FOUND, &[&split.to_string()]);
        let (challenge, _, board) = state.split(split).ok_or_else(unknown)?;
        let insider = call
            .user
            .as_ref()
            .is_some_and(|user| user.staff || challenge.hosts.contains(&user.id));
        if !board.public && !insider {
            return Err((&errors::LEADERBOARD_PRIVATE).into());
        }
        leaderboards::entries(&state, split, call.asked("order_by"))?
    };
    call.page(entries)
}

/// One challenge.
pub(super) fn challenge(call: &Call, challenge: u64) -> Answer {
    let state = call.app.state();
    let row = state.challenge(challenge).ok_or(&errors::UNKNOWN_CHALLENGE)?;
    Ok(Reply::ok(&views::challenge(row)))
}

/// One phase.
pub(super) fn phase(call: &Call, challenge: u64, phase: u64) -> Answer {
    let state = call.app.state();
    let row = state.challenge(challenge).ok_or(&errors::NO_CHALLENGE)?;
    let found = row.phases.iter().find(|row| row.id == phase);
    let values = [phase.to_string(), challenge.to_string()];
    let unknown = || Reply::error(&errors::NO_PHASE_OF_CHALLENGE, &[&values[0], &values[1]]);
    let host = call.user.as_ref().is_some_and(|user| row.hosts.contains(&user.id));
    Ok(Reply::ok(&views::phase(row, found.ok_or_else(unknown)?, host)))
}

/// All phases of a challenge.
pub(super) fn phases(call: &Call, challenge: u64) -> Answer {
    let unknown = || Reply::error(&errors::CHALLENGE_NOT_FOUND, &[&challenge.to_string()]);
    call.app.state().challenge(challenge).ok_or_else(unknown)?;
    call.host_of(challenge, &errors::PHASES_FORBIDDEN)?;
    let state = call.app.state();
    let row = state.challenge(challenge).ok_or_else(unknown)?;
    Ok(Reply::ok(&Value::Array(
        row.phases.iter().map(|phase| views::phase(row, phase, true)).collect(),
    )))
}

/// The phase splits of a challenge; private ones for hosts and staff only.
pub(super) fn splits(call: &Call, challenge: u64) -> Answer {
    let state = call.app.state();
    let row = state.challenge(challenge).ok_or(&errors::NO_CHALLENGE)?;
    let insider = call
        .user
        .as_ref()
        .is_some_and(|user| user.staff || row.hosts.contains(&user.id));
    let splits = row
        .phases
        .iter()
        .flat_map(|phase| phase.splits.iter().map(move |split| (phase, split)));
    let splits = splits.filter(|(_, split)| insider || split.public);
    Ok(Reply::ok(&Value::Array(
        splits.map(|(phase, split)| views::split(phase, split)).collect(),
    )))
}

/// A dataset split: where the codename is.
pub(super) fn dataset_split(call: &Call, pk: u64) -> Answer {
    let state = call.app.state();
    let mut splits = state
        .seed
        .challenges
        .iter()
        .flat_map(|c| &c.phases)
        .flat_map(|phase| &phase.splits);
    let found = splits
        .find(|split| split.dataset_split.id == pk)
        .map(|split| &split.dataset_split);
    let row = found.ok_or_else(|| Reply::error(&errors::DATASET_SPLIT_NOT_FOUND, &[&pk.to_string()]))?;
    Ok(Reply::ok(
        &json!({"id": row.id, "name": row.name, "codename": row.codename, "config_id": null}),
    ))
}

/// A phase split: where the order of its leaderboard is.
pub(super) fn phase_split(call: &Call, pk: u64) -> Answer {
    let state = call.app.state();
    let unknown = || Reply::error(&errors::PHASE_SPLIT_NOT_FOUND, &[&pk.to_string()]);
    let (_, phase, split) = state.split(pk).ok_or_else(unknown)?;
    Ok(Reply::ok(&views::split_settings(phase, split)))
}
