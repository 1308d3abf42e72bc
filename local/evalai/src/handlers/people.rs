//! The endpoints behind the web pages and the command line of participants and hosts.

use serde_json::{Map, Value, json};

use super::{Call, publish};
use crate::app::now;
use crate::body::Form;
use crate::edit;
use crate::errors;
use crate::model::FileState;
use crate::reply::{Answer, Reply};
use crate::submissions::{self, NewSubmission, Upload};
use crate::views;

/// GET shows a submission to its submitter and its hosts, DELETE hides it.
pub(super) fn submission(call: &Call, pk: u64) -> Answer {
    let user = call.user()?;
    let row = {
        let mut state = call.app.state();
        // As the path has it: the database looks for a number of any length.
        let asked = call.path.rsplit('/').next().unwrap_or_default();
        let unknown = || Reply::error(&errors::NO_SUCH_SUBMISSION, &[asked]);
        let mut row = state.submissions.get(&pk).ok_or_else(unknown)?.clone();
        let host = state
            .challenge_of(&row)
            .is_some_and(|challenge| challenge.hosts.contains(&user.id));
        if !host && row.created_by != user.id {
            return Err((&errors::SUBMISSION_FORBIDDEN).into());
        }
        if call.method == "DELETE" {
            row.ignore_submission = true;
            state.save(row.clone());
        }
        row
    };
    call.submission(&row)
}

/// A participant's push.
pub(super) async fn submit(call: &Call, challenge: u64, phase: u64) -> Answer {
    let user = call.user()?.clone();
    let form = call.form().await?;
    let (new, docker) = {
        let state = call.app.state();
        let (challenge, phase) = submissions::check_new(&state, &user, challenge, phase)?;
        let team = state.team_of(&user).ok_or(&errors::SUBMIT_NO_TEAM)?;
        submissions::check_concurrent(&state, team.id, phase)?;
        let new = NewSubmission {
            team: team.id,
            phase: phase.id,
            user: user.id,
            input: Vec::new(),
            fields: Map::new(),
        };
        (new, challenge.is_docker_based)
    };
    let Some(input) = form.files.get("input_file").cloned() else {
        return submit_url(call, &form, new).await;
    };
    let image = if docker {
        Some(submissions::image_of(&input)?)
    } else {
        None
    };
    let new = NewSubmission {
        input,
        fields: form.fields,
        ..new
    };
    let (row, message) = {
        let mut state = call.app.state();
        let id = submissions::create(&mut state, new, FileState::Stored, now());
        let row = state.submissions.get(&id).ok_or_else(Reply::server_error)?.clone();
        let message = submissions::first_message(&state, &row, Upload::Normal, image.as_deref());
        (row, message)
    };
    publish(&call.app, row.id, message).await?;
    Ok(Reply {
        status: 201,
        ..call.submission(&row)?
    })
}

/// A push by URL. Only files this server serves can be fetched.
async fn submit_url(call: &Call, form: &Form, new: NewSubmission) -> Answer {
    let url = match form.value("file_url") {
        Value::Null => return Err((&errors::SUBMIT_NO_FILE).into()),
        value => value.as_str().unwrap_or_default(),
    };
    let path = url.split_once("/media/").map(|(_, path)| path).unwrap_or_default();
    let path = path.split('?').next().unwrap_or_default();
    let input = call
        .app
        .state()
        .files
        .get(path)
        .cloned()
        .ok_or(&errors::SUBMIT_BAD_URL)?;
    let (id, message) = {
        let mut state = call.app.state();
        let new = NewSubmission {
            input,
            fields: form.fields.clone(),
            ..new
        };
        let id = submissions::create(&mut state, new, FileState::Stored, now());
        let row = state.submissions.get(&id).ok_or_else(Reply::server_error)?;
        (id, submissions::first_message(&state, row, Upload::FileUrl, None))
    };
    // A background job of the server sends this one: the client learns nothing of its failure.
    if publish(&call.app, id, message).await.is_err() {
        tracing::warn!(submission = id, "submitted by URL, and no message went out");
    }
    Ok(Reply::ok(
        &json!({"message": "Please wait while your submission being evaluated!"}),
    ))
}

/// A participant's own submissions in a phase, newest first.
pub(super) fn own(call: &Call, challenge: u64, phase: u64) -> Answer {
    let user = call.user()?;
    let items = {
        let state = call.app.state();
        let challenge = state.challenge(challenge).ok_or(&errors::SUBMIT_NO_CHALLENGE)?;
        challenge
            .phases
            .iter()
            .find(|row| row.id == phase)
            .ok_or(&errors::SUBMIT_NO_PHASE)?;
        let team = state.team_of(user).ok_or(&errors::SUBMIT_NO_TEAM)?.id;
        let rows = state.submissions.values().rev();
        let rows = rows.filter(|row| row.participant_team == team && row.challenge_phase == phase);
        let rows = rows.filter(|row| !row.ignore_submission);
        rows.map(|row| views::submission(&state, row, user, &call.base))
            .collect()
    };
    call.page(items)
}

/// `update_submission_meta`: how hosts and participants cancel. Nothing is published.
pub(super) async fn edit(call: &Call, challenge: u64, pk: u64) -> Answer {
    let user = call.user()?;
    let form = call.form().await?;
    let row = {
        let mut state = call.app.state();
        let key = pk.to_string();
        let row = if state.is_host(user, challenge) {
            state
                .submissions
                .get(&pk)
                .ok_or_else(|| Reply::error(&errors::SUBMISSION_NOT_FOUND, &[&key]))?
        } else {
            let team = state
                .team_of(user)
                .ok_or_else(|| Reply::error(&errors::TEAM_NOT_FOUND, &["None"]))?
                .id;
            let own = state.submissions.get(&pk).filter(|row| row.participant_team == team);
            own.ok_or_else(|| Reply::error(&errors::NO_SUCH_SUBMISSION, &[&key]))?
        };
        let mut row = row.clone();
        edit::edit(&mut state, &mut row, &form)?;
        state.save(row.clone());
        row
    };
    call.submission(&row)
}

/// Cancels a submission and makes a new one of it.
pub(super) async fn rerun(call: &Call, pk: u64) -> Answer {
    let (id, message) = {
        let mut state = call.app.state();
        let id = submissions::rerun(&mut state, call.user()?, pk, now())?;
        (id, submissions::again_message(&state, id))
    };
    publish(&call.app, id, message.ok_or_else(Reply::server_error)?).await?;
    Ok(Reply::ok(
        &json!({"success": "Submission is successfully submitted for re-running"}),
    ))
}

/// Continues a failed submission under its own key.
pub(super) async fn resume(call: &Call, pk: u64) -> Answer {
    let message = {
        let mut state = call.app.state();
        submissions::resume(&mut state, call.user()?, pk, now())?;
        submissions::again_message(&state, pk)
    };
    publish(&call.app, pk, message.ok_or_else(Reply::server_error)?).await?;
    Ok(Reply::ok(&json!({"success": "Submission is successfully resumed"})))
}
