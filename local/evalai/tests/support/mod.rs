//! A stand-in on a free port and a small client for it.
#![allow(dead_code, reason = "each test file uses a part of it")]
#![allow(clippy::unwrap_used, clippy::panic, reason = "a helper that fails fails its test")]

use std::sync::Arc;
use std::time::Duration;

use evalai_stand_in::errors::ErrorText;
use evalai_stand_in::log::RequestLog;
use evalai_stand_in::{Config, Handle, MemoryQueues, State, serve};
use reqwest::Method;
use serde_json::{Value, json};
use tokio::net::TcpListener;

pub(crate) const HOST: &str = "Bearer local-host-token";
pub(crate) const TEAM_A: &str = "Bearer local-team-a-token";
pub(crate) const TEAM_B: &str = "Bearer local-team-b-token";
pub(crate) const UPDATE: &str = "/api/jobs/challenge/1/update_submission/";
pub(crate) const PARTIAL: &str = "/api/jobs/challenges/1/update_partially_evaluated_submission/";
pub(crate) const IMAGE: &str = "registry.example/carla/team-a:7f3";

/// A running stand-in without a throttle, whose messages stay in memory.
pub(crate) struct Stand {
    pub(crate) handle: Handle,
    pub(crate) queues: Arc<MemoryQueues>,
    pub(crate) http: reqwest::Client,
}

/// An answer, read to its end.
#[derive(Debug, Clone)]
pub(crate) struct Got {
    pub(crate) status: u16,
    pub(crate) headers: reqwest::header::HeaderMap,
    pub(crate) text: String,
}

impl Got {
    pub(crate) fn json(&self) -> Value {
        serde_json::from_str(&self.text).unwrap_or_else(|error| panic!("{error}: {}", self.text))
    }

    pub(crate) fn header(&self, name: &str) -> &str {
        self.headers.get(name).map_or("", |value| value.to_str().unwrap())
    }

    /// The answer is this line of the error table.
    #[track_caller]
    pub(crate) fn is(&self, error: &ErrorText, values: &[&str]) {
        assert_eq!(
            (self.status, self.text.as_str()),
            (error.status, error.body(values).as_str()),
            "{}",
            error.name
        );
        assert_eq!(self.header("content-type"), error.content_type(), "{}", error.name);
    }

    #[track_caller]
    pub(crate) fn ok(self) -> Self {
        assert_eq!(self.status, 200, "{}", self.text);
        self
    }
}

impl Stand {
    pub(crate) async fn start() -> Self {
        Self::start_with(|config| config.throttle = 0).await
    }

    pub(crate) async fn start_with(change: impl FnOnce(&mut Config)) -> Self {
        let _ = rustls::crypto::ring::default_provider().install_default();
        let (mut config, queues) = Config::in_memory().unwrap();
        change(&mut config);
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let http = reqwest::Client::builder()
            .timeout(Duration::from_secs(30))
            .redirect(reqwest::redirect::Policy::none())
            .build()
            .unwrap();
        Self {
            handle: serve(config, vec![listener]),
            queues,
            http,
        }
    }

    pub(crate) fn request(&self, method: Method, path: &str, auth: &str) -> reqwest::RequestBuilder {
        let request = self.http.request(method, format!("{}{path}", self.handle.url()));
        if auth.is_empty() {
            request
        } else {
            request.header("authorization", auth)
        }
    }

    pub(crate) async fn send(request: reqwest::RequestBuilder) -> Got {
        let answer = request.send().await.unwrap();
        let (status, headers) = (answer.status().as_u16(), answer.headers().clone());
        Got {
            status,
            headers,
            text: answer.text().await.unwrap(),
        }
    }

    pub(crate) async fn get(&self, path: &str, auth: &str) -> Got {
        Self::send(self.request(Method::GET, path, auth)).await
    }

    pub(crate) async fn call(&self, method: Method, path: &str, auth: &str, body: &Value) -> Got {
        Self::send(self.request(method, path, auth).json(body)).await
    }

    pub(crate) async fn put(&self, path: &str, body: &Value) -> Got {
        self.call(Method::PUT, path, HOST, body).await
    }

    pub(crate) async fn patch(&self, path: &str, body: &Value) -> Got {
        self.call(Method::PATCH, path, HOST, body).await
    }

    pub(crate) async fn post(&self, path: &str, auth: &str, body: &Value) -> Got {
        self.call(Method::POST, path, auth, body).await
    }

    /// Sends a form with a file, as `evalai push` does.
    pub(crate) async fn upload(&self, path: &str, auth: &str, content: &str) -> Got {
        let body = format!(
            "--b\r\nContent-Disposition: form-data; name=\"status\"\r\n\r\nsubmitting\r\n\
             --b\r\nContent-Disposition: form-data; name=\"method_name\"\r\n\r\nmine\r\n\
             --b\r\nContent-Disposition: form-data; name=\"input_file\"; filename=\"a.json\"\r\n\r\n{content}\r\n--b--\r\n"
        );
        let request = self.request(Method::POST, path, auth);
        let request = request.header("content-type", "multipart/form-data; boundary=b");
        Self::send(request.body(body)).await
    }

    /// Submits for team a in phase 1 and hands the key back.
    pub(crate) async fn submit(&self) -> u64 {
        let body = json!({"team": "team-a", "phase": 1, "image": IMAGE});
        let got = self.post("/_stand-in/submit", "", &body).await;
        assert_eq!(got.status, 201, "{}", got.text);
        got.json()["submission"].as_u64().unwrap()
    }

    pub(crate) async fn submission(&self, pk: u64) -> Value {
        self.get(&format!("/api/jobs/submission/{pk}"), HOST).await.ok().json()
    }

    /// Waits for what a test needs to have happened; fails after 30 s.
    pub(crate) async fn wait_until(&self, ready: impl FnMut(&State, &RequestLog) -> bool) {
        let waited = tokio::time::timeout(Duration::from_secs(30), self.handle.wait_until(ready)).await;
        assert!(
            waited.is_ok(),
            "it did not happen; the requests were {:#?}",
            self.handle.requests()
        );
    }

    /// The host's list of challenge 1.
    pub(crate) async fn list(&self, query: &str) -> Got {
        self.get(&format!("/api/jobs/challenge/1/submission/?{query}"), HOST)
            .await
    }

    pub(crate) async fn cancel(&self, pk: u64, auth: &str) -> Got {
        let path = format!("/api/jobs/challenges/1/submissions/{pk}/update_submission_meta/");
        self.call(Method::PATCH, &path, auth, &json!({"status": "cancelled"}))
            .await
    }

    pub(crate) async fn knobs(&self, knobs: &Value) {
        self.post("/_stand-in/knobs", "", knobs).await.ok();
    }

    /// The bodies of all messages sent so far.
    pub(crate) fn sent(&self) -> Vec<Value> {
        self.queues
            .messages("submissions")
            .into_iter()
            .map(|message| message.body)
            .collect()
    }
}

/// A result with one split, as the text the server wants.
pub(crate) fn result(accuracies: &Value) -> String {
    json!([{"split": "leaderboard", "show_to_participant": true, "accuracies": accuracies}]).to_string()
}

/// The body of a PUT.
pub(crate) fn put_body(pk: u64, status: &str, score: f64) -> Value {
    json!({
        "challenge_phase": 1, "submission": pk, "submission_status": status, "stdout": "out", "stderr": "err",
        "environment_log": "secret", "metadata": "{}", "result": result(&json!({"Driving score": score})),
    })
}
