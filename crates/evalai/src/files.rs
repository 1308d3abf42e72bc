//! The files that participants upload: read without the token, since they may lie with a storage provider, and from the internet
//! alone, since what they lead to is not EvalAI's word. A file on EvalAI's own server is read wherever that server is. The transport
//! refuses the rest, at each redirect anew.

use std::sync::Arc;

use bytes::Bytes;
use http::header::LOCATION;
use http::{Request, Response, StatusCode};
use tokio::time::Instant;
use url::Url;

use super::answer::{About, Answer, Refusal};
use super::row::image;
use super::transport::{Body, Failure, Need, Timeouts, Transport, read, send, unsendable};
use super::types::ImageAnswer;

/// Largest file that is read, in bytes.
const LARGEST_UPLOAD: usize = 64 << 10;
/// How often a file may be somewhere else.
const REDIRECTS: usize = 5;

/// Reads uploaded files.
pub(super) struct Files {
    transport: Arc<dyn Transport>,
    timeouts: Timeouts,
}

impl Files {
    pub(super) fn new(transport: Arc<dyn Transport>, timeouts: Timeouts) -> Self {
        Self { transport, timeouts }
    }

    /// The image that an uploaded file names.
    pub(super) async fn image(&self, url: &str) -> Answer<ImageAnswer> {
        let end = Instant::now() + self.timeouts.read;
        match self.found(url, end).await {
            Ok(response) => content(response, end).await,
            Err(answer) => answer,
        }
    }

    /// The first answer that is no redirect.
    async fn found(&self, url: &str, end: Instant) -> Result<Response<Body>, Answer<ImageAnswer>> {
        let mut url = Url::parse(url).map_err(|_| refused("the address of the uploaded file is no URL"))?;
        for _ in 0..=REDIRECTS {
            let response = send(&*self.transport, get(&url)?, end).await.map_err(failed)?;
            match next(&url, &response) {
                Some(next) => url = next?,
                None => return Ok(response),
            }
        }
        Err(refused(&format!(
            "the uploaded file is more than {REDIRECTS} redirects away"
        )))
    }
}

fn get(url: &Url) -> Result<Request<Bytes>, Answer<ImageAnswer>> {
    if !["http", "https"].contains(&url.scheme()) {
        return Err(refused("the address of the uploaded file is neither http nor https"));
    }
    let request = Request::get(url.as_str()).body(Bytes::new());
    request.map_err(|error| Answer::Unanswered(unsendable(&error)))
}

/// Where a redirect leads; None: this is the answer.
fn next(url: &Url, response: &Response<Body>) -> Option<Result<Url, Answer<ImageAnswer>>> {
    let redirects = [
        StatusCode::MOVED_PERMANENTLY,
        StatusCode::FOUND,
        StatusCode::SEE_OTHER,
        StatusCode::TEMPORARY_REDIRECT,
        StatusCode::PERMANENT_REDIRECT,
    ];
    if !redirects.contains(&response.status()) {
        return None;
    }
    let location = response.headers().get(LOCATION)?.to_str().ok();
    let next = location.and_then(|location| url.join(location).ok());
    Some(next.ok_or_else(|| refused("the uploaded file is redirected to no URL")))
}

async fn content(response: Response<Body>, end: Instant) -> Answer<ImageAnswer> {
    match read(response, end, LARGEST_UPLOAD, Need::Body).await {
        // The file is there, and too large for what names an image.
        Answer::Refused(refusal) if (200..300).contains(&refusal.status) => {
            let why = format!("the uploaded file is larger than {LARGEST_UPLOAD} bytes");
            Answer::Done(ImageAnswer::NotAnImage(why))
        }
        other => other.and_then(|(_, body)| {
            // No JSON begins so: a login page, or the start page of a web application, stands in the file's place.
            if body.trim_ascii_start().starts_with(b"<") {
                return refused("the address of the uploaded file answers with a page and not with the file");
            }
            let named = image(&body).map(ImageAnswer::Named);
            Answer::Done(named.unwrap_or_else(ImageAnswer::NotAnImage))
        }),
    }
}

fn failed(failure: Failure) -> Answer<ImageAnswer> {
    match failure {
        Failure::Silent(silence) => Answer::Unanswered(silence),
        Failure::NotPublic(error) => refused(&format!(
            "the uploaded file is not read: {error}, and no part of evalai.apiServer"
        )),
    }
}

fn refused(why: &str) -> Answer<ImageAnswer> {
    Answer::Refused(Refusal {
        about: About::Request,
        status: 0,
        message: format!("{why}; check EvalAI's MEDIA_URL"),
    })
}

#[cfg(test)]
mod tests;
