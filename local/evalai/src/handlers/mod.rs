//! The answers of each endpoint of the API. `server` calls them once a request has passed path, signing in, throttle and method. They
//! read and write the state under its lock and never wait while they hold it.

mod context;
mod evaluation;
mod people;
mod queues;

use std::sync::Arc;

use axum::body::Bytes;
use serde_json::{Value, json};

use crate::app::{App, now};
use crate::body::{self, Form};
use crate::errors;
use crate::model::{Submission, User};
use crate::queue::{Message, uuid};
use crate::reply::{Answer, Reply};
use crate::routes::Endpoint;
use crate::state::Published;
use crate::views;

/// A request that has been let in.
pub(crate) struct Call {
    pub(crate) app: Arc<App>,
    /// None only at public endpoints.
    pub(crate) user: Option<User>,
    pub(crate) path: String,
    /// Scheme and host the client used.
    pub(crate) base: String,
    pub(crate) query: Vec<(String, String)>,
    pub(crate) content_type: Option<String>,
    pub(crate) method: String,
    pub(crate) body: Bytes,
}

impl Call {
    fn user(&self) -> Result<&User, Reply> {
        self.user.as_ref().ok_or_else(|| (&errors::NO_CREDENTIALS).into())
    }

    async fn form(&self) -> Result<Form, Reply> {
        body::parse(self.content_type.as_deref(), self.body.clone()).await
    }

    /// A value of the query; empty counts as absent.
    fn asked(&self, name: &str) -> Option<&str> {
        self.query
            .iter()
            .find(|(key, value)| key == name && !value.is_empty())
            .map(|(_, value)| value.as_str())
    }

    /// Refuses anyone who is not a host of the challenge, with the given error.
    fn host_of(&self, challenge: u64, refusal: &errors::ErrorText) -> Result<(), Reply> {
        if self.app.state().is_host(self.user()?, challenge) {
            Ok(())
        } else {
            Err(refusal.into())
        }
    }

    fn submission(&self, row: &Submission) -> Answer {
        Ok(Reply::ok(&views::submission(
            &self.app.state(),
            row,
            self.user()?,
            &self.base,
        )))
    }

    /// A page of a list, as the server's paginator cuts it.
    fn page(&self, items: Vec<Value>) -> Answer {
        let size = self
            .asked("page_size")
            .and_then(|size| size.parse().ok())
            .filter(|size| *size > 0);
        let size = size.unwrap_or(150).min(1_000);
        let page: usize = self
            .asked("page")
            .unwrap_or("1")
            .parse()
            .map_err(|_| Reply::from(&errors::INVALID_PAGE))?;
        let pages = items.len().div_ceil(size).max(1);
        if page == 0 || page > pages {
            return Err((&errors::INVALID_PAGE).into());
        }
        let link = |there: bool, page: usize| {
            there.then(|| format!("{}{}?page={page}&page_size={size}", self.base, self.path))
        };
        let (count, next, previous) = (items.len(), link(page < pages, page + 1), link(page > 1, page - 1));
        let results: Vec<_> = items.into_iter().skip((page - 1) * size).take(size).collect();
        Ok(Reply::ok(
            &json!({"count": count, "next": next, "previous": previous, "results": results}),
        ))
    }
}

/// Answers a request.
pub(crate) async fn answer(call: Call, endpoint: Endpoint) -> Answer {
    let post = call.method == "POST";
    match endpoint {
        Endpoint::Update(challenge) => evaluation::update(&call, challenge, crate::update::Door::Update).await,
        Endpoint::Partial(challenge) => evaluation::update(&call, challenge, crate::update::Door::Partial).await,
        Endpoint::Row(row) => evaluation::correct_row(&call, row).await,
        Endpoint::StartedAt(pk) => evaluation::started_at(&call, pk),
        Endpoint::Submission(pk) => people::submission(&call, pk),
        Endpoint::Submit(challenge, phase) if post => people::submit(&call, challenge, phase).await,
        Endpoint::Submit(challenge, phase) => people::own(&call, challenge, phase),
        Endpoint::Meta(challenge, pk) => people::edit(&call, challenge, pk).await,
        Endpoint::Rerun(pk) => people::rerun(&call, pk).await,
        Endpoint::Resume(pk) => people::resume(&call, pk).await,
        Endpoint::QueueReceive(queue) => queues::receive(&call, &queue).await,
        Endpoint::QueueDelete(queue) => queues::delete(&call, &queue).await,
        Endpoint::ChallengeOfQueue(queue) => queues::challenge(&call, &queue),
        Endpoint::List(challenge) => context::list(&call, challenge).await,
        Endpoint::AuthToken => context::auth_token(&call),
        Endpoint::RenewToken => context::renew_token(&call),
        Endpoint::CountByStatus(phase) => context::count_by_status(&call, phase),
        Endpoint::Leaderboard(split) => context::leaderboard(&call, split),
        Endpoint::Challenge(challenge) => context::challenge(&call, challenge),
        Endpoint::Phase(challenge, phase) => context::phase(&call, challenge, phase),
        Endpoint::Phases(challenge) => context::phases(&call, challenge),
        Endpoint::Splits(challenge) => context::splits(&call, challenge),
        Endpoint::DatasetSplit(pk) => context::dataset_split(&call, pk),
        Endpoint::PhaseSplit(pk) => context::phase_split(&call, pk),
    }
}

/// Sends a submission's message into its challenge's queue. Fails as the server does: with the page for an exception,
/// after everything has been saved.
pub(crate) async fn publish(app: &App, submission: u64, body: Value) -> Result<(), Reply> {
    let (queue, message) = {
        let state = app.state();
        let row = state.submissions.get(&submission).ok_or_else(Reply::server_error)?;
        let queue = state
            .challenge_of(row)
            .map(|challenge| challenge.queue.clone())
            .ok_or_else(Reply::server_error)?;
        let fifo = views::is_fifo(&queue);
        let group = fifo.then(|| format!("{}-{}", row.challenge_phase, row.participant_team));
        (
            queue,
            Message {
                body,
                group,
                dedup: fifo.then(|| format!("{submission}-{}", uuid())),
            },
        )
    };
    if app.knobs().queue_down {
        return Err(Reply::server_error());
    }
    if let Err(error) = app.queues.send(&queue, &message).await {
        tracing::warn!(submission, %error, "the message was not published");
        return Err(Reply::server_error());
    }
    let Message { body, group, dedup } = message;
    app.state().published.push(Published {
        at: now(),
        queue,
        body,
        group,
        dedup,
    });
    Ok(())
}
