//! Connections to EvalAI and to participants' files: their limits, and the classes of their errors.

use std::time::Duration;

use reqwest::header::RETRY_AFTER;
use reqwest::{RequestBuilder, Response};

use super::answer::{Answer, Silence, classify};

/// How long an answer is waited for.
#[derive(Clone, Copy, Debug)]
pub struct Timeouts {
    pub connect: Duration,
    pub read: Duration,
    /// Longer than the server itself may work on a request.
    pub write: Duration,
}

impl Default for Timeouts {
    fn default() -> Self {
        Self {
            connect: Duration::from_secs(5),
            read: Duration::from_secs(30),
            write: Duration::from_secs(65),
        }
    }
}

/// Why there is no client.
#[derive(thiserror::Error, Debug)]
#[error("no HTTP client could be made: {0}; check the machine's trusted certificates")]
pub struct ClientError(String);

/// Builder with the settings of all clients.
pub(super) fn builder(timeouts: Timeouts) -> reqwest::ClientBuilder {
    // A program that has installed one already keeps it.
    let _ = rustls::crypto::ring::default_provider().install_default();
    reqwest::Client::builder()
        .connect_timeout(timeouts.connect)
        .user_agent(concat!("leaderboard-operator/", env!("CARGO_PKG_VERSION")))
        .retry(reqwest::retry::never())
        // A server closes idle connections when it likes. A write that is sent on one in that moment has no answer, and
        // may have been served: nothing is written for over a minute. At some 54 requests a minute nothing is kept open.
        .pool_max_idle_per_host(0)
}

pub(super) fn made(builder: reqwest::ClientBuilder) -> Result<reqwest::Client, ClientError> {
    builder
        .build()
        .map_err(|e| ClientError(leaderboard_api::text::chain(&e)))
}

/// Part of an answer that is needed.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Need {
    /// A read is nothing without its body.
    Body,
    /// The status line shows that a write was done, also without the rest.
    Status,
}

pub(super) async fn answer(request: RequestBuilder, largest: usize, need: Need) -> Answer<(u16, Vec<u8>)> {
    match request.send().await {
        Ok(response) => read(response, largest, need).await,
        Err(error) => Answer::Unanswered(silence(error)),
    }
}

pub(super) async fn read(response: Response, largest: usize, need: Need) -> Answer<(u16, Vec<u8>)> {
    let status = response.status();
    let code = status.as_u16();
    let retry_after = response
        .headers()
        .get(RETRY_AFTER)
        .and_then(|value| value.to_str().ok())
        .map(str::to_owned);
    let body = match body(response, largest).await {
        Ok(body) => body,
        Err(_) if need == Need::Status && status.is_success() => Vec::new(),
        Err(Unread::TooLarge) => return Answer::unusable(code, "more than is read of an answer"),
        Err(Unread::Broken(error)) => return Answer::Unanswered(silence(error)),
    };
    classify(code, retry_after.as_deref(), &body).and_then(|()| Answer::Done((code, body)))
}

enum Unread {
    TooLarge,
    Broken(reqwest::Error),
}

async fn body(mut response: Response, largest: usize) -> Result<Vec<u8>, Unread> {
    let mut body = Vec::new();
    while let Some(chunk) = response.chunk().await.map_err(Unread::Broken)? {
        if body.len() + chunk.len() > largest {
            return Err(Unread::TooLarge);
        }
        body.extend_from_slice(&chunk);
    }
    Ok(body)
}

pub(super) fn silence(error: reqwest::Error) -> Silence {
    let error = error.without_url();
    let what = match () {
        () if error.is_timeout() => "EvalAI did not answer in time",
        () if error.is_connect() => "EvalAI could not be reached",
        () => "EvalAI's answer broke off",
    };
    Silence {
        sent: !error.is_connect() && !error.is_builder() && !is_canceled(&error),
        why: format!("{what} ({})", leaderboard_api::text::chain(&error)),
    }
}

/// True if the connection was closed before a byte of the request was sent on it.
pub(super) fn is_canceled(error: &(dyn std::error::Error + 'static)) -> bool {
    let mut causes = std::iter::successors(Some(error), |error| error.source());
    causes.any(|cause| {
        cause
            .downcast_ref::<hyper::Error>()
            .is_some_and(hyper::Error::is_canceled)
    })
}
