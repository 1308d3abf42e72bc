//! The endpoints that only read: lists, phases, splits, leaderboards.

use std::collections::BTreeMap;
use std::time::Duration;

use jiff::Timestamp;
use jiff::civil::DateTime;
use jiff::tz::TimeZone;
use serde_json::{Value, json};

use super::Call;
use crate::errors;
use crate::leaderboards;
use crate::model::{Status, TokenKind};
use crate::reply::{Answer, Reply};
use crate::views;

/// The submissions of a challenge, unpaginated. Read first, answered late: what the delay knob shows is stale.
pub(super) async fn list(call: &Call, challenge: u64) -> Answer {
    let user = call.user()?;
    let body = {
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
        let rows = state.submissions.values().filter(|row| {
            status.is_none_or(|status| row.status == status)
                && after.is_none_or(|after| row.submitted_at > after)
                && before.is_none_or(|before| row.submitted_at < before)
                && state.challenge_of(row).is_some_and(|of| of.id == challenge)
        });
        Value::Array(
            rows.map(|row| views::submission(&state, row, user, &call.base))
                .collect(),
        )
    };
    let delay = Duration::from_millis(call.app.knobs().list_delay_ms);
    if !delay.is_zero() {
        tokio::time::sleep(delay).await;
    }
    Ok(Reply::ok(&body))
}

fn listable(text: &str) -> Result<Status, Reply> {
    let status = Status::parse(text).filter(|s| !matches!(s, Status::Archived | Status::PartiallyEvaluated));
    status.ok_or_else(|| Reply::error(&errors::LIST_STATUS, &[text]))
}

/// A date as Django reads it: `YYYY-MM-DDTHH:MM[:SS[.ffffff]]` with `Z`, an offset or, meaning UTC, nothing. What has
/// the shape and is no date raises in the server.
fn date(name: &str, text: &str) -> Result<Timestamp, Reply> {
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
        return Err(Reply::error(&errors::LIST_DATE, &[name]));
    }
    if let Ok(at) = text.parse() {
        return Ok(at);
    }
    let civil: Option<DateTime> = text.parse().ok();
    let at = civil
        .and_then(|civil| civil.to_zoned(TimeZone::UTC).ok())
        .map(|zoned| zoned.timestamp());
    at.ok_or_else(Reply::server_error)
}

/// The user's refresh token, as the profile page shows it.
pub(super) fn auth_token(call: &Call) -> Answer {
    let token = call
        .user()?
        .tokens
        .iter()
        .find(|token| token.kind == TokenKind::Refresh && !token.expired);
    let token = token.ok_or_else(Reply::server_error)?;
    Ok(Reply::ok(
        &json!({"token": token.value, "expires_at": "2099-12-31T23:59:59Z"}),
    ))
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
        leaderboards::entries(&state, split, call.asked("order_by"))
    };
    call.page(entries)
}

/// One phase.
pub(super) fn phase(call: &Call, challenge: u64, phase: u64) -> Answer {
    let state = call.app.state();
    let row = state.challenge(challenge).ok_or(&errors::NO_CHALLENGE)?;
    let found = row.phases.iter().find(|row| row.id == phase);
    let values = [phase.to_string(), challenge.to_string()];
    let unknown = || Reply::error(&errors::NO_PHASE_OF_CHALLENGE, &[&values[0], &values[1]]);
    Ok(Reply::ok(&views::phase(row, found.ok_or_else(unknown)?)))
}

/// All phases of a challenge.
pub(super) fn phases(call: &Call, challenge: u64) -> Answer {
    let unknown = || Reply::error(&errors::CHALLENGE_NOT_FOUND, &[&challenge.to_string()]);
    call.app.state().challenge(challenge).ok_or_else(unknown)?;
    call.host_of(challenge, &errors::PHASES_FORBIDDEN)?;
    let state = call.app.state();
    let row = state.challenge(challenge).ok_or_else(unknown)?;
    Ok(Reply::ok(&Value::Array(
        row.phases.iter().map(|phase| views::phase(row, phase)).collect(),
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
