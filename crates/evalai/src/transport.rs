//! The way to EvalAI and to participants' files: who carries requests, how long an answer is waited for, how much of it is read.
//!
//! [`Transport`] is the border of this crate. `network` is the one that connects; a test hands in one that holds its answers in memory.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures::future::BoxFuture;
use futures::stream::{BoxStream, TryStreamExt};
use http::header::{HeaderName, RETRY_AFTER};
use http::{Request, Response};
use tokio::time::{Instant, timeout_at};

use super::answer::{Answer, Silence, classify};
use super::reach::NotPublic;

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
pub struct ClientError(pub(super) String);

/// The body of an answer, in chunks as they come. It is whole if it ends without an error.
pub type Body = BoxStream<'static, Result<Bytes, Silence>>;

/// Carries requests to one server of EvalAI, and to wherever the files of its participants are.
pub trait Transport: Send + Sync {
    /// Sends a request once, and follows no redirect. Neither the answer nor its body need ever end: the caller limits both.
    fn send(&self, request: Request<Bytes>) -> BoxFuture<'static, Result<Response<Body>, Failure>>;
}

/// Makes the transport to a server of EvalAI, which is named by its root.
pub type Connect = Arc<dyn Fn(&str, Timeouts) -> Result<Arc<dyn Transport>, ClientError> + Send + Sync>;

/// Why a request has no answer.
#[derive(Debug)]
pub enum Failure {
    /// EvalAI did not answer, or could not be asked.
    Silent(Silence),
    /// The request would have left EvalAI's server for an address that participants may not name.
    NotPublic(NotPublic),
}

impl From<Failure> for Silence {
    fn from(failure: Failure) -> Self {
        match failure {
            Failure::Silent(silence) => silence,
            Failure::NotPublic(error) => Self {
                sent: false,
                why: format!("EvalAI could not be reached ({error})"),
            },
        }
    }
}

/// Part of an answer that is needed.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Need {
    /// A read is nothing without its body.
    Body,
    /// The status line shows that a write was done, also without the rest.
    Status,
}

/// Sends a request, if there is one, and reads its answer: until `end`, and `largest` bytes of its body at most.
pub(super) async fn answer(
    transport: &dyn Transport,
    request: Result<Request<Bytes>, Silence>,
    end: Instant,
    largest: usize,
    need: Need,
) -> Answer<(u16, Vec<u8>)> {
    let begun = async { send(transport, request?, end).await.map_err(Silence::from) };
    match begun.await {
        Ok(response) => read(response, end, largest, need).await,
        Err(silence) => Answer::Unanswered(silence),
    }
}

/// Sends a request, and waits for the head of its answer.
pub(super) async fn send(
    transport: &dyn Transport,
    request: Request<Bytes>,
    end: Instant,
) -> Result<Response<Body>, Failure> {
    let response = timeout_at(end, transport.send(request)).await;
    response.unwrap_or_else(|_| Err(Failure::Silent(late("error sending request"))))
}

async fn read(response: Response<Body>, end: Instant, largest: usize, need: Need) -> Answer<(u16, Vec<u8>)> {
    let status = response.status();
    let code = status.as_u16();
    let retry_after = header(&response, RETRY_AFTER).map(str::to_owned);
    let body = timeout_at(end, body(response.into_body(), largest)).await;
    let body = match body.unwrap_or_else(|_| Err(late("error decoding response body"))) {
        Ok(Some(body)) => body,
        Ok(None) | Err(_) if need == Need::Status && status.is_success() => Vec::new(),
        Ok(None) => return Answer::unusable(code, "more than is read of an answer"),
        Err(silence) => return Answer::Unanswered(silence),
    };
    classify(code, retry_after.as_deref(), &body).map(|()| (code, body))
}

/// The text of a header.
pub(super) fn header(response: &Response<Body>, name: HeaderName) -> Option<&str> {
    response.headers().get(name)?.to_str().ok()
}

/// All that comes; none if that is more than `largest` bytes.
pub(super) async fn body<E>(
    mut chunks: BoxStream<'static, Result<Bytes, E>>,
    largest: usize,
) -> Result<Option<Vec<u8>>, E> {
    let mut body = Vec::new();
    while let Some(chunk) = chunks.try_next().await? {
        if body.len() + chunk.len() > largest {
            return Ok(None);
        }
        body.extend_from_slice(&chunk);
    }
    Ok(Some(body))
}

/// Why there is no answer that was waited for long enough.
pub(super) fn late(during: &str) -> Silence {
    Silence {
        sent: true,
        why: format!("EvalAI did not answer in time ({during}: operation timed out)"),
    }
}

/// Why a request was not sent that cannot be written.
pub(super) fn unsendable(error: &dyn std::error::Error) -> Silence {
    Silence {
        sent: false,
        why: format!("EvalAI's answer broke off (builder error: {error})"),
    }
}

#[cfg(test)]
pub(crate) mod tests;
