//! EvalAI over HTTP: one method a request, every answer classified.
//!
//! Called by `task` only. Knows no policy: it hands each request to its [`Transport`] once, and follows no redirect of the API (the server
//! drops the body of a redirected write).

use std::collections::BTreeMap;
use std::sync::Arc;

use bytes::Bytes;
use http::Method;
use http::header::{AUTHORIZATION, CONTENT_TYPE};
use jiff::Timestamp;
use serde::Serialize;
use serde::de::DeserializeOwned;
use tokio::time::Instant;
use url::Url;

use super::answer::{Answer, Silence};
use super::files::Files;
use super::request::{Reply, Request, SubmissionRef};
use super::row::Row;
use super::transport::{Need, Timeouts, Transport, answer, unsendable};
use super::types::Payload;
use crate::token::Token;
use leaderboard_base::meter::Meter;

/// Largest answer that is read about one submission, in bytes: a row has some 2 kB, and its participant can write into it.
const LARGEST_ROW: usize = 1 << 20;
/// Largest other answer that is read, in bytes: a list takes 8 ms for each row and has 30 s, so it has less than 4,000.
const LARGEST: usize = 8 << 20;

/// A server of EvalAI.
pub struct Client {
    transport: Arc<dyn Transport>,
    files: Files,
    base: String,
    timeouts: Timeouts,
    meter: Meter,
}

/// The body of a PUT, as the server wants it: `result` and `metadata` are texts that hold JSON.
#[derive(Serialize)]
struct Put<'a> {
    submission: i64,
    submission_status: &'a str,
    challenge_phase: i64,
    #[serde(skip_serializing_if = "Option::is_none")]
    result: Option<&'a str>,
    stdout: &'a str,
    stderr: &'a str,
    metadata: &'a str,
    #[serde(skip_serializing_if = "Option::is_none")]
    environment_log: Option<&'a str>,
}

#[derive(Serialize)]
struct Patch<'a> {
    submission: i64,
    submission_status: &'a str,
    #[serde(skip_serializing_if = "Option::is_none")]
    job_name: Option<&'a str>,
}

impl Client {
    /// A client of one server, named by its root, over the transport to it. The meter counts its requests.
    pub fn new(transport: Arc<dyn Transport>, api_server: &str, timeouts: Timeouts, meter: Meter) -> Self {
        Self {
            files: Files::new(transport.clone(), timeouts),
            transport,
            base: format!("{}/api/", api_server.trim_end_matches('/')),
            timeouts,
            meter,
        }
    }

    /// Sends a request and reads its answer.
    pub async fn send(&self, token: &Token, request: &Request) -> Reply {
        let running = self.meter.begin("evalai", request.op());
        let reply = self.exchange(token, request).await;
        running.end(reply.answer().as_str());
        reply
    }

    async fn exchange(&self, token: &Token, request: &Request) -> Reply {
        match request {
            Request::Get(s) => Reply::Row(self.row(token, s.pk).await),
            Request::Image(_, url) => Reply::Image(self.files.image(url).await),
            Request::List {
                challenge,
                purpose,
                after,
            } => {
                let path = list(*challenge, purpose.status(), *after);
                Reply::Rows(self.get(token, &path).await.of_hosts())
            }
            Request::Phases(challenge) => {
                let path = format!("challenges/{challenge}/phases/");
                Reply::Phases(self.get(token, &path).await.of_hosts())
            }
            Request::Splits(challenge) => {
                let path = format!("challenges/{challenge}/challenge_phase_split");
                Reply::Splits(self.get(token, &path).await)
            }
            Request::DatasetSplit(_, id) => {
                let path = format!("challenges/challenge/create/dataset_split/{id}/");
                Reply::DatasetSplit(self.get(token, &path).await)
            }
            Request::PhaseSplit(_, id) => {
                let path = format!("challenges/challenge/create/challenge_phase_split/{id}/");
                Reply::PhaseSplit(self.get(token, &path).await)
            }
            Request::Challenge(id) => {
                let path = format!("challenges/challenge/{id}/");
                Reply::Challenge(self.get(token, &path).await)
            }
            Request::Receive(queue) => {
                let path = format!("jobs/challenge/queues/{queue}/");
                Reply::Message(self.get(token, &path).await.of_hosts())
            }
            Request::MessageRow(pk) => Reply::Row(self.row(token, *pk).await),
            Request::DeleteMessage(queue, receipt) => {
                let body = BTreeMap::from([("receipt_handle", receipt)]);
                let path = format!("jobs/queues/{queue}/");
                Reply::Written(self.write(token, Method::POST, &path, &body).await)
            }
            Request::Progress(s, progress, job) => {
                let body = Patch {
                    submission: s.pk,
                    submission_status: progress.as_str(),
                    job_name: job.as_deref(),
                };
                Reply::Written(self.write(token, Method::PATCH, &update(s), &body).await)
            }
            Request::Partial(s, payload) => Reply::Written(self.write_partial(token, s, payload).await),
            Request::Final(s, outcome, payload) => {
                let body = put(s, outcome.as_str(), *outcome == super::Outcome::Finished, payload);
                Reply::Written(self.write(token, Method::PUT, &update(s), &body).await)
            }
        }
    }

    async fn write_partial(&self, token: &Token, s: &SubmissionRef, payload: &Payload) -> Answer<()> {
        let path = format!("jobs/challenges/{}/update_partially_evaluated_submission/", s.challenge);
        let body = Put {
            environment_log: None,
            ..put(s, "partially_evaluated", true, payload)
        };
        self.write(token, Method::PUT, &path, &body).await
    }

    async fn row(&self, token: &Token, pk: i64) -> Answer<Row> {
        let path = format!("jobs/submission/{pk}");
        self.get_within(LARGEST_ROW, token, &path).await
    }

    async fn get<T: DeserializeOwned>(&self, token: &Token, path: &str) -> Answer<T> {
        self.get_within(LARGEST, token, path).await
    }

    async fn get_within<T: DeserializeOwned>(&self, largest: usize, token: &Token, path: &str) -> Answer<T> {
        let end = Instant::now() + self.timeouts.read;
        let request = self.request(token, Method::GET, path, Bytes::new());
        let answer = answer(&*self.transport, request, end, largest, Need::Body).await;
        answer.and_then(|(status, body)| match serde_json::from_slice(&body) {
            Ok(content) => Answer::Done(content),
            Err(_) => Answer::unusable(status, "something that is not EvalAI's"),
        })
    }

    async fn write<B: Serialize>(&self, token: &Token, method: Method, path: &str, body: &B) -> Answer<()> {
        let body = match serde_json::to_vec(body) {
            Ok(body) => body,
            Err(error) => return Answer::unusable(0, &format!("nothing: the request could not be written ({error})")),
        };
        let end = Instant::now() + self.timeouts.write;
        let request = self.request(token, method, path, body.into());
        answer(&*self.transport, request, end, LARGEST_ROW, Need::Status)
            .await
            .and_then(|_| Answer::Done(()))
    }

    fn request(&self, token: &Token, method: Method, path: &str, body: Bytes) -> Result<http::Request<Bytes>, Silence> {
        let url = Url::parse(&format!("{}{path}", self.base)).map_err(|error| unsendable(&error))?;
        let mut request = http::Request::builder()
            .method(method)
            .uri(url.as_str())
            .header(AUTHORIZATION, token.header());
        if !body.is_empty() {
            request = request.header(CONTENT_TYPE, "application/json");
        }
        request.body(body).map_err(|error| unsendable(&error))
    }
}

fn update(subject: &SubmissionRef) -> String {
    format!("jobs/challenge/{}/update_submission/", subject.challenge)
}

fn list(challenge: i64, status: &str, after: Timestamp) -> String {
    let after = after.strftime("%Y-%m-%dT%H:%M:%SZ");
    format!("jobs/challenge/{challenge}/submission/?status={status}&submitted_after={after}")
}

fn put<'a>(subject: &SubmissionRef, status: &'a str, results: bool, payload: &'a Payload) -> Put<'a> {
    Put {
        submission: subject.pk,
        submission_status: status,
        challenge_phase: payload.phase,
        result: results.then_some(payload.result.as_str()),
        stdout: &payload.stdout,
        stderr: &payload.stderr,
        metadata: &payload.metadata,
        environment_log: Some(&payload.environment_log),
    }
}

#[cfg(test)]
mod tests;

#[cfg(test)]
mod strangers_tests;
