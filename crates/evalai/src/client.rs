//! EvalAI over HTTP: one method a request, every answer classified.
//!
//! Called by `task` only, which has one for its token. Knows no policy: it hands each request to its [`Transport`] once, and follows no
//! redirect of the API (the server drops the body of a redirected write).

use std::collections::BTreeMap;
use std::sync::Arc;

use bytes::Bytes;
use http::Method;
use http::header::{AUTHORIZATION, CONTENT_TYPE};
use serde::Serialize;
use serde::de::DeserializeOwned;
use tokio::time::Instant;
use url::Url;

use super::answer::{Answer, Silence};
use super::files::Files;
use super::request::{Reply, Request, SubmissionRef};
use super::transport::{Need, Timeouts, Transport, answer, unsendable};
use super::types::Payload;
use crate::token::Token;
use leaderboard_base::meter::Meter;

/// Largest answer that is read about one submission, in bytes: a row has some 2 kB, and its participant can write into it.
const LARGEST_ROW: usize = 1 << 20;
/// Largest other answer that is read, in bytes: a list takes 8 ms for each row and has 30 s, so it has less than 4,000.
const LARGEST: usize = 8 << 20;

/// A server of EvalAI, as one token is shown it.
pub struct Client {
    transport: Arc<dyn Transport>,
    /// Reads what participants have uploaded there, without the token.
    pub(super) files: Files,
    base: String,
    token: Arc<Token>,
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
    pub fn new(
        transport: Arc<dyn Transport>,
        api_server: &str,
        token: Arc<Token>,
        timeouts: Timeouts,
        meter: Meter,
    ) -> Self {
        Self {
            files: Files::new(transport.clone(), timeouts),
            transport,
            base: format!("{}/api/", api_server.trim_end_matches('/')),
            token,
            timeouts,
            meter,
        }
    }

    /// Sends a request and reads its answer.
    pub async fn send(&self, request: &Request) -> Reply {
        let running = self.meter.begin("evalai", request.op());
        let reply = self.exchange(request).await;
        running.end(reply.answer().as_str());
        reply
    }

    async fn exchange(&self, request: &Request) -> Reply {
        let path = path(request);
        match request {
            Request::Image(_, url) => Reply::Image(self.files.image(url).await),
            Request::Get(_) | Request::MessageRow(_) => Reply::Row(self.get(&path, LARGEST_ROW).await),
            Request::List { .. } => Reply::Rows(self.get(&path, LARGEST).await.of_hosts()),
            Request::Phases(_) => Reply::Phases(self.get(&path, LARGEST).await.of_hosts()),
            Request::Splits(_) => Reply::Splits(self.get(&path, LARGEST).await),
            Request::DatasetSplit(..) => Reply::DatasetSplit(self.get(&path, LARGEST).await),
            Request::PhaseSplit(..) => Reply::PhaseSplit(self.get(&path, LARGEST).await),
            Request::Challenge(_) => Reply::Challenge(self.get(&path, LARGEST).await),
            Request::Receive(_) => Reply::Message(self.get(&path, LARGEST).await.of_hosts()),
            Request::DeleteMessage(_, receipt) => {
                let body = BTreeMap::from([("receipt_handle", receipt)]);
                Reply::Written(self.write(Method::POST, &path, &body).await)
            }
            Request::Progress(s, progress, job) => {
                let body = Patch {
                    submission: s.pk,
                    submission_status: progress.as_str(),
                    job_name: job.as_deref(),
                };
                Reply::Written(self.write(Method::PATCH, &path, &body).await)
            }
            Request::Partial(s, payload) => {
                let body = Put {
                    environment_log: None,
                    ..put(s, "partially_evaluated", true, payload)
                };
                Reply::Written(self.write(Method::PUT, &path, &body).await)
            }
            Request::Final(s, outcome, payload) => {
                let body = put(s, outcome.as_str(), *outcome == super::Outcome::Finished, payload);
                Reply::Written(self.write(Method::PUT, &path, &body).await)
            }
        }
    }

    async fn get<T: DeserializeOwned>(&self, path: &str, largest: usize) -> Answer<T> {
        let end = Instant::now() + self.timeouts.read;
        let request = self.request(Method::GET, path, Bytes::new());
        let answer = answer(&*self.transport, request, end, largest, Need::Body).await;
        answer.and_then(|(status, body)| match serde_json::from_slice(&body) {
            Ok(content) => Answer::Done(content),
            Err(_) => Answer::unusable(status, "something that is not EvalAI's"),
        })
    }

    async fn write<B: Serialize>(&self, method: Method, path: &str, body: &B) -> Answer<()> {
        let body = match serde_json::to_vec(body) {
            Ok(body) => body,
            Err(error) => return Answer::unusable(0, &format!("nothing: the request could not be written ({error})")),
        };
        let end = Instant::now() + self.timeouts.write;
        let request = self.request(method, path, body.into());
        answer(&*self.transport, request, end, LARGEST_ROW, Need::Status)
            .await
            .map(|_| ())
    }

    fn request(&self, method: Method, path: &str, body: Bytes) -> Result<http::Request<Bytes>, Silence> {
        let url = Url::parse(&format!("{}{path}", self.base)).map_err(|error| unsendable(&error))?;
        let mut request = http::Request::builder()
            .method(method)
            .uri(url.as_str())
            .header(AUTHORIZATION, self.token.header());
        if !body.is_empty() {
            request = request.header(CONTENT_TYPE, "application/json");
        }
        request.body(body).map_err(|error| unsendable(&error))
    }
}

/// Where a request goes, below the root of the API.
fn path(request: &Request) -> String {
    match request {
        Request::Get(SubmissionRef { pk, .. }) | Request::MessageRow(pk) => format!("jobs/submission/{pk}"),
        // A file is not of the API.
        Request::Image(..) => String::new(),
        Request::Progress(s, ..) | Request::Final(s, ..) => {
            format!("jobs/challenge/{}/update_submission/", s.challenge)
        }
        Request::Partial(s, _) => format!("jobs/challenges/{}/update_partially_evaluated_submission/", s.challenge),
        Request::List {
            challenge,
            purpose,
            after,
        } => {
            let (status, after) = (purpose.status(), after.strftime("%Y-%m-%dT%H:%M:%SZ"));
            format!("jobs/challenge/{challenge}/submission/?status={status}&submitted_after={after}")
        }
        Request::Phases(id) => format!("challenges/{id}/phases/"),
        Request::Splits(id) => format!("challenges/{id}/challenge_phase_split"),
        Request::DatasetSplit(_, id) => format!("challenges/challenge/create/dataset_split/{id}/"),
        Request::PhaseSplit(_, id) => format!("challenges/challenge/create/challenge_phase_split/{id}/"),
        Request::Challenge(id) => format!("challenges/challenge/{id}/"),
        Request::Receive(queue) => format!("jobs/challenge/queues/{queue}/"),
        Request::DeleteMessage(queue, _) => format!("jobs/queues/{queue}/"),
    }
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
