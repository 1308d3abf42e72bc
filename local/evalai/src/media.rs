//! Uploaded and stored files below `/media/`. Links need no signing in. Called by `server`; knows no network.

use std::convert::Infallible;
use std::future;
use std::path::Path;

use axum::body::{Body, Bytes};
use axum::http::{HeaderValue, header};
use axum::response::Response;
use futures::stream::{self, StreamExt};

use crate::errors;
use crate::model::{FileState, Submission};
use crate::reply::Reply;
use crate::server::{Closed, Outcome};
use crate::state::State;

/// A chunk of a file of zeros.
static ZEROS: [u8; 1 << 16] = [0; 1 << 16];
/// The answer of a storage provider to an address that is no longer good.
const EXPIRED: &str = "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<Error><Code>AccessDenied</Code><Message>Request has expired</Message></Error>";

/// The file at a path below `/media/`.
pub(crate) fn serve(state: &State, path: &str, query: &[(String, String)]) -> Outcome {
    let is_input = |row: &&Submission| row.input_file.as_deref() == Some(path);
    let input = state.submissions.values().find(is_input);
    let signed = query.iter().find(|(name, _)| name == "signature");
    let signed = signed.map(|(_, signature)| signature.as_str());
    let wanted = state.signature.filter(|_| input.is_some());
    if wanted.is_some_and(|wanted| signed != Some(wanted.to_string().as_str())) {
        return Outcome::Reply(Reply::of(403, "application/xml", EXPIRED));
    }
    match (input.map(|row| row.file_state), state.files.get(path)) {
        (Some(FileState::Unreachable), _) => Outcome::Close,
        (Some(FileState::Silent), _) => Outcome::Hang,
        (Some(FileState::Zeros(size)), _) => Outcome::Stream(zeros(size)),
        (Some(FileState::Gone), _) => Outcome::Reply(Reply::html(410, "<h1>410 Gone</h1>")),
        (Some(FileState::Missing), _) | (_, None) => Outcome::Reply(Reply::error(&errors::PAGE_NOT_FOUND, &[])),
        (Some(FileState::Cut), Some(content)) => Outcome::Stream(half(content)),
        (Some(FileState::Stored) | None, Some(content)) => {
            let is_json = Path::new(path).extension().is_some_and(|extension| extension == "json");
            let content_type = if is_json { "application/json" } else { "text/plain" };
            Outcome::Reply(Reply::of(200, content_type, content.clone()))
        }
    }
}

fn zeros(size: u64) -> Response<Body> {
    let chunks = stream::unfold(size, |left| {
        let length = usize::try_from(left).unwrap_or(usize::MAX).min(ZEROS.len());
        let chunk = ZEROS.get(..length).filter(|chunk| !chunk.is_empty());
        let left = left - length as u64;
        future::ready(chunk.map(|chunk| (Ok::<_, Infallible>(Bytes::from_static(chunk)), left)))
    });
    of_length(size, Body::from_stream(chunks))
}

/// The first half of a file, after which the connection is closed.
fn half(content: &[u8]) -> Response<Body> {
    let first = content.get(..content.len() / 2).unwrap_or_default();
    let first = Ok(Bytes::copy_from_slice(first));
    let end = async {
        // What was begun is sent first.
        tokio::task::yield_now().await;
        Err(Closed)
    };
    let chunks = stream::iter([first]).chain(stream::once(end));
    of_length(content.len() as u64, Body::from_stream(chunks))
}

fn of_length(size: u64, body: Body) -> Response<Body> {
    let mut response = Response::new(body);
    let length = HeaderValue::from(size);
    response.headers_mut().insert(header::CONTENT_LENGTH, length);
    response
}
