//! The challenge's queue over REST, for workers that may not read SQS.

use serde_json::{Value, json};

use super::Call;
use crate::errors::{self, ErrorText};
use crate::reply::{Answer, Reply};
use crate::views;

fn check(call: &Call, queue: &str, unknown: &ErrorText, forbidden: &ErrorText) -> Result<Value, Reply> {
    let user = call.user()?;
    let state = call.app.state();
    let challenge = state
        .challenge_of_queue(queue, user)
        .ok_or_else(|| Reply::error(unknown, &[queue]))?;
    if !challenge.hosts.contains(&user.id) {
        return Err(forbidden.into());
    }
    Ok(views::challenge(challenge))
}

/// One message without waiting, and what deletes it.
pub(super) async fn receive(call: &Call, queue: &str) -> Answer {
    check(call, queue, &errors::QUEUE_UNKNOWN, &errors::QUEUE_FORBIDDEN)?;
    if call.app.knobs().queue_down {
        return Err(Reply::server_error());
    }
    // An error of SQS can't be put into the server's own answer: it ends as an exception.
    let received = call
        .app
        .queues
        .receive(queue)
        .await
        .map_err(|_| Reply::server_error())?;
    let Some(received) = received else {
        return Ok(Reply::ok(&json!({"body": null, "receipt_handle": null})));
    };
    let body: Value = serde_json::from_str(&received.body).map_err(|_| Reply::server_error())?;
    Ok(Reply::ok(
        &json!({"body": body, "receipt_handle": received.receipt_handle}),
    ))
}

/// Deletes a message. The body is checked before the user is.
pub(super) async fn delete(call: &Call, queue: &str) -> Answer {
    let user = call.user()?;
    if call.app.state().challenge_of_queue(queue, user).is_none() {
        return Err(Reply::error(&errors::QUEUE_UNKNOWN_DELETE, &[queue]));
    }
    let form = call.form().await?;
    let handle = match form.fields.get("receipt_handle") {
        None => return Err(Reply::server_error()),
        Some(Value::String(handle)) if !handle.is_empty() => handle.clone(),
        Some(_) => return Err((&errors::RECEIPT_HANDLE_EMPTY).into()),
    };
    check(call, queue, &errors::QUEUE_UNKNOWN_DELETE, &errors::QUEUE_FORBIDDEN)?;
    if call.app.knobs().queue_down {
        return Err(Reply::server_error());
    }
    call.app
        .queues
        .delete(queue, &handle)
        .await
        .map_err(|_| Reply::server_error())?;
    Ok(Reply::ok(
        &json!({"success": format!("Message deleted successfully from the queue: {queue}")}),
    ))
}

/// The challenge behind a queue's name.
pub(super) fn challenge(call: &Call, queue: &str) -> Answer {
    let view = check(call, queue, &errors::QUEUE_UNKNOWN, &errors::QUEUE_CHALLENGE_FORBIDDEN)?;
    Ok(Reply::ok(&view))
}
