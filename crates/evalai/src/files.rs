//! The files that participants upload: read without the token, since they may lie with a storage provider, and from the internet
//! alone, since what they lead to is not EvalAI's word. A file on EvalAI's own server is read wherever that server is. The transport
//! refuses the rest, at each redirect anew.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures::stream::{self, BoxStream, StreamExt, TryStreamExt};
use http::header::{CONTENT_LENGTH, CONTENT_TYPE, LOCATION};
use http::{Request, Response};
use tokio::time::{Instant, timeout};
use url::Url;

use super::answer::{About, Answer, Refusal, Silence};
use super::row::{FileUrl, image};
use super::transport::{Body, Failure, Timeouts, Transport, body, header, late, send, unsendable};
use super::types::{ImageAnswer, Key};

/// Largest file that is read for the image that it names, in bytes.
const LARGEST_UPLOAD: usize = 64 << 10;
/// How often a file may be somewhere else.
const REDIRECTS: usize = 5;
const READING: &str = "reading the uploaded file";
const PAGE: &str = "the address of the uploaded file answers with a page and not with the file";

/// Where the uploaded file of a submission is. Its `Debug` does not show the address.
#[derive(Clone, Debug)]
pub struct InputAddress {
    pub(super) key: Key,
    /// None: its row names no file.
    pub(super) url: Option<FileUrl>,
}

/// The content of an uploaded file, in chunks as they come. It is whole if the stream ends without an error.
pub type InputStream = BoxStream<'static, Result<Bytes, InputError>>;

/// Why an uploaded file was not read, in words that do not show its address.
#[derive(thiserror::Error, Clone, Debug, PartialEq, Eq)]
pub enum InputError {
    /// Its address gives it out no more, with this status: it was deleted, or a presigned address has expired.
    #[error("the address of the uploaded file answers {0}; check that EvalAI still serves the file")]
    Gone(u16),
    /// Its submission's row names no file.
    #[error("EvalAI's row of the submission names no file")]
    NoFile,
    /// Its address leads to where no file is read from, or to no file.
    #[error("{0}")]
    Refused(String),
    /// There was no answer, or not a whole one: a later try may get it.
    #[error("{0}")]
    Silent(String),
}

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
    pub(super) async fn image(&self, url: &FileUrl) -> Answer<ImageAnswer> {
        let read = async { body(self.open(url).await?, LARGEST_UPLOAD).await };
        let read = timeout(self.timeouts.read, read).await;
        match read.unwrap_or_else(|_| Err(InputError::Silent(late(READING).why))) {
            // No JSON begins so: a login page, or the start page of a web application, stands in the file's place.
            Ok(Some(file)) if file.trim_ascii_start().starts_with(b"<") => refused(check_media_url(PAGE)),
            Ok(Some(file)) => Answer::Done(image(&file).map_or_else(ImageAnswer::NotAnImage, ImageAnswer::Named)),
            Ok(None) => {
                let why = format!("the uploaded file is larger than {LARGEST_UPLOAD} bytes");
                Answer::Done(ImageAnswer::NotAnImage(why))
            }
            Err(InputError::Silent(why)) => Answer::Unanswered(Silence { sent: true, why }),
            Err(error) => refused(error.to_string()),
        }
    }

    /// The content of an uploaded file, whatever that is. Each chunk is waited for as long as the answer before; the caller limits the
    /// whole.
    pub(super) async fn open(&self, url: &FileUrl) -> Result<InputStream, InputError> {
        let end = Instant::now() + self.timeouts.read;
        let response = self.found(url, end).await?;
        let answers = |code: u16| format!("the address of the uploaded file answers {code}");
        match response.status().as_u16() {
            200 if is_page(url, &response) => Err(InputError::Refused(check_media_url(PAGE))),
            200 => Ok(chunks(response, self.timeouts.read)),
            code @ (400 | 401 | 403 | 404 | 410) => Err(InputError::Gone(code)),
            code @ (408 | 429 | 500..) => Err(InputError::Silent(answers(code))),
            code => Err(InputError::Refused(check_media_url(&answers(code)))),
        }
    }

    /// The first answer that is no redirect.
    async fn found(&self, url: &FileUrl, end: Instant) -> Result<Response<Body>, InputError> {
        let mut url = Url::parse(url.as_str()).map_err(|_| unfound("the address of the uploaded file is no URL"))?;
        for _ in 0..=REDIRECTS {
            let response = send(&*self.transport, get(&url)?, end).await.map_err(failed)?;
            match next(&url, &response) {
                Some(next) => url = next?,
                None => return Ok(response),
            }
        }
        Err(unfound(&format!(
            "the uploaded file is more than {REDIRECTS} redirects away"
        )))
    }
}

fn get(url: &Url) -> Result<Request<Bytes>, InputError> {
    if !["http", "https"].contains(&url.scheme()) {
        return Err(unfound("the address of the uploaded file is neither http nor https"));
    }
    let request = Request::get(url.as_str()).body(Bytes::new());
    request.map_err(|error| InputError::Silent(unsendable(&error).why))
}

/// Where a redirect leads; None: this is the answer.
fn next(url: &Url, response: &Response<Body>) -> Option<Result<Url, InputError>> {
    if !matches!(response.status().as_u16(), 301..=303 | 307 | 308) {
        return None;
    }
    let next = url.join(header(response, LOCATION)?);
    Some(next.map_err(|_| unfound("the uploaded file is redirected to no URL")))
}

/// True if a page of HTML stands in the place of a file with another name: a login page, or the start page of a web application.
fn is_page(url: &FileUrl, response: &Response<Body>) -> bool {
    let kind = header(response, CONTENT_TYPE).unwrap_or_default();
    let path = Url::parse(url.as_str()).map(|url| url.path().to_ascii_lowercase());
    let names_page = path.is_ok_and(|path| [".htm", ".html"].iter().any(|end| path.ends_with(end)));
    kind.to_ascii_lowercase().starts_with("text/html") && !names_page
}

/// The chunks of a body, which has to be as long as its header says.
fn chunks(response: Response<Body>, longest: Duration) -> InputStream {
    let length: Option<u64> = header(&response, CONTENT_LENGTH).and_then(|length| length.parse().ok());
    let begun = (response.into_body(), 0_u64);
    let chunks = stream::try_unfold(begun, move |(mut body, read)| async move {
        let next = timeout(longest, body.try_next()).await;
        let next = next.unwrap_or_else(|_| Err(late(READING)));
        match next.map_err(|silence| InputError::Silent(silence.why))? {
            Some(chunk) => {
                let read = read.saturating_add(chunk.len() as u64);
                Ok(Some((chunk, (body, read))))
            }
            None => match length.filter(|length| *length != read) {
                Some(length) => Err(InputError::Silent(format!(
                    "the uploaded file ended after {read} of {length} bytes"
                ))),
                None => Ok(None),
            },
        }
    });
    chunks.boxed()
}

fn failed(failure: Failure) -> InputError {
    match failure {
        Failure::Silent(silence) => InputError::Silent(silence.why),
        Failure::NotPublic(error) => unfound(&format!(
            "the uploaded file is not read: {error}, and no part of evalai.apiServer"
        )),
    }
}

fn unfound(why: &str) -> InputError {
    InputError::Refused(check_media_url(why))
}

fn check_media_url(why: &str) -> String {
    format!("{why}; check EvalAI's MEDIA_URL")
}

fn refused(message: String) -> Answer<ImageAnswer> {
    Answer::Refused(Refusal {
        about: About::Request,
        status: 0,
        message,
    })
}

#[cfg(test)]
mod tests;

#[cfg(test)]
mod input_tests;
