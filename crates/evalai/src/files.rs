//! The files that participants upload: read without the token, since they may lie with a storage provider, and from the internet
//! alone, since what they lead to is not EvalAI's word. A file on EvalAI's own server is read wherever that server is.

use reqwest::header::LOCATION;
use reqwest::{Response, StatusCode, Url};
use tokio::time::Instant;

use super::answer::{About, Answer, Refusal};
use super::http::{ClientError, Need, Timeouts, builder, made, read, silence};
use super::row::image;
use super::types::ImageAnswer;
use crate::reach as public;
use crate::reach::{NotPublic, Reach};

/// Largest file that is read, in bytes.
const LARGEST_UPLOAD: usize = 64 << 10;
/// How often a file may be somewhere else.
const REDIRECTS: usize = 5;

/// Reads uploaded files.
#[derive(Clone, Debug)]
pub(super) struct Files {
    /// For EvalAI's own server.
    own: reqwest::Client,
    /// For every other one.
    other: reqwest::Client,
    reach: Reach,
    server: Option<Url>,
    timeouts: Timeouts,
}

impl Files {
    pub(super) fn new(api_server: &str, timeouts: Timeouts, reach: Reach) -> Result<Self, ClientError> {
        Ok(Self {
            own: made(builder(timeouts).redirect(reqwest::redirect::Policy::none()))?,
            other: made(reach.limit(builder(timeouts)))?,
            reach,
            server: Url::parse(api_server).ok(),
            timeouts,
        })
    }

    /// The image that an uploaded file names.
    pub(super) async fn image(&self, url: &str) -> Answer<ImageAnswer> {
        match self.found(url).await {
            Ok(response) => content(response).await,
            Err(answer) => answer,
        }
    }

    /// The first answer that is no redirect.
    async fn found(&self, url: &str) -> Result<Response, Answer<ImageAnswer>> {
        let end = Instant::now() + self.timeouts.read;
        let mut url = Url::parse(url).map_err(|_| refused("the address of the uploaded file is no URL"))?;
        for _ in 0..=REDIRECTS {
            let left = end.saturating_duration_since(Instant::now());
            let request = self.client(&url)?.get(url.clone()).timeout(left);
            let response = request.send().await.map_err(failed)?;
            match next(&url, &response) {
                Some(next) => url = next?,
                None => return Ok(response),
            }
        }
        Err(refused(&format!(
            "the uploaded file is more than {REDIRECTS} redirects away"
        )))
    }

    /// Client that may read this address; an error if none may.
    fn client(&self, url: &Url) -> Result<&reqwest::Client, Answer<ImageAnswer>> {
        if !["http", "https"].contains(&url.scheme()) {
            return Err(refused("the address of the uploaded file is neither http nor https"));
        }
        if self
            .server
            .as_ref()
            .is_some_and(|server| server.origin() == url.origin())
        {
            return Ok(&self.own);
        }
        self.reach.check(url).map_err(|error| elsewhere(&error))?;
        Ok(&self.other)
    }
}

/// Where a redirect leads; None: this is the answer.
fn next(url: &Url, response: &Response) -> Option<Result<Url, Answer<ImageAnswer>>> {
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

async fn content(response: Response) -> Answer<ImageAnswer> {
    match read(response, LARGEST_UPLOAD, Need::Body).await {
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

fn failed(error: reqwest::Error) -> Answer<ImageAnswer> {
    match public::cause(&error) {
        Some(cause) => elsewhere(cause),
        None => Answer::Unanswered(silence(error)),
    }
}

fn elsewhere(error: &NotPublic) -> Answer<ImageAnswer> {
    refused(&format!(
        "the uploaded file is not read: {error}, and no part of evalai.apiServer"
    ))
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
