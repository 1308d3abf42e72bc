//! The program's commands for people: requests to a running stand-in, and their answers as text.

use std::fmt::Write as _;

use reqwest::Method;
use serde_json::{Value, json};
use thiserror::Error;

/// A command that did not work out.
#[derive(Debug, Error)]
pub(crate) enum Failure {
    /// The server could not be started, or a file not be read.
    #[error("{0}")]
    Start(String),
    /// The server could not be reached.
    #[error("no answer from {server}: {source}; is `evalai-stand-in serve` running there (--server)?")]
    Unreachable {
        /// Where.
        server: String,
        /// Why.
        source: reqwest::Error,
    },
    /// The server refused.
    #[error("the server answered {status}: {reason}")]
    Refused {
        /// HTTP status code.
        status: u16,
        /// Its message.
        reason: String,
    },
}

/// A person's connection to a stand-in.
pub(crate) struct Client {
    server: String,
    token: String,
    http: reqwest::Client,
}

impl Client {
    /// Acts on the server at this URL with this refresh token.
    pub(crate) fn new(server: &str, token: &str) -> Self {
        let server = server.trim_end_matches('/').to_owned();
        Self {
            server,
            token: token.to_owned(),
            http: reqwest::Client::new(),
        }
    }

    /// Submits through the control plane.
    pub(crate) async fn submit(&self, body: &Value) -> Result<String, Failure> {
        let answer = self.json(Method::POST, "/_stand-in/submit", Some(body)).await?;
        Ok(format!(
            "submission {} is submitted; message {}",
            answer["submission"], answer["message"]
        ))
    }

    /// Cancels as the web page does.
    pub(crate) async fn cancel(&self, pk: u64) -> Result<String, Failure> {
        let state = self.json(Method::GET, "/_stand-in/state", None).await?;
        let phase = &state["submissions"][pk.to_string()]["challenge_phase"];
        let challenges = state["seed"]["challenges"].as_array().into_iter().flatten();
        let has_phase = |challenge: &&Value| items(&challenge["phases"]).any(|row| row["id"] == *phase);
        let challenge = challenges
            .into_iter()
            .find(has_phase)
            .map_or(Value::from(1), |row| row["id"].clone());
        let path = format!("/api/jobs/challenges/{challenge}/submissions/{pk}/update_submission_meta/");
        let answer = self
            .json(Method::PATCH, &path, Some(&json!({"status": "cancelled"})))
            .await?;
        Ok(format!("submission {pk} is {}", plain(&answer["status"])))
    }

    /// Resumes or re-runs.
    pub(crate) async fn again(&self, pk: u64, how: &str) -> Result<String, Failure> {
        let answer = self
            .json(Method::POST, &format!("/api/jobs/submissions/{pk}/{how}/"), None)
            .await?;
        Ok(plain(&answer["success"]))
    }

    /// One submission, and the texts that are in its files.
    pub(crate) async fn show(&self, pk: u64) -> Result<String, Failure> {
        let answer = self
            .json(Method::GET, &format!("/api/jobs/submission/{pk}"), None)
            .await?;
        let fields = answer
            .as_object()
            .into_iter()
            .flatten()
            .filter(|(_, value)| !value.is_null());
        let mut text = String::new();
        for (name, value) in fields {
            let _ = writeln!(text, "{name:24} {}", plain(value));
        }
        for name in [
            "stdout_file",
            "stderr_file",
            "environment_log_file",
            "submission_result_file",
        ] {
            let Some((_, path)) = answer[name].as_str().and_then(|url| url.split_once("/media/")) else {
                continue;
            };
            let content = self.call(Method::GET, &format!("/media/{path}"), None).await?;
            if !content.trim().is_empty() {
                let _ = writeln!(text, "\n--- {name}\n{}", content.trim_end());
            }
        }
        Ok(text.trim_end().to_owned())
    }

    /// All submissions, newest last.
    pub(crate) async fn list(&self) -> Result<String, Failure> {
        let state = self.json(Method::GET, "/_stand-in/state", None).await?;
        let team = |id: &Value| {
            items(&state["seed"]["teams"])
                .find(|team| team["id"] == *id)
                .map(|team| &team["name"])
        };
        let mut rows: Vec<_> = state["submissions"]
            .as_object()
            .into_iter()
            .flatten()
            .map(|(_, row)| row)
            .collect();
        rows.sort_by_key(|row| row["id"].as_u64());
        let mut text = format!("{:>6}  {:12} {:>5}  {:20} SUBMITTED", "KEY", "TEAM", "PHASE", "STATUS");
        for row in rows {
            let team = team(&row["participant_team"]).map_or_else(String::new, plain);
            let (phase, status, at) = (
                &row["challenge_phase"],
                plain(&row["status"]),
                plain(&row["submitted_at"]),
            );
            let _ = write!(
                text,
                "\n{:>6}  {team:12} {:>5}  {status:20} {at}",
                row["id"].to_string(),
                phase.to_string()
            );
        }
        Ok(text)
    }

    /// Every leaderboard that has entries.
    pub(crate) async fn leaderboards(&self) -> Result<String, Failure> {
        let state = self.json(Method::GET, "/_stand-in/state", None).await?;
        let mut text = String::new();
        for challenge in items(&state["seed"]["challenges"]) {
            for phase in items(&challenge["phases"]) {
                for split in items(&phase["splits"]) {
                    let path = format!("/api/jobs/challenge_phase_split/{}/leaderboard/", split["id"]);
                    let board = self.json(Method::GET, &path, None).await?;
                    if items(&board["results"]).next().is_some() {
                        let _ = writeln!(text, "{}, {}", plain(&challenge["title"]), plain(&phase["name"]));
                        text.push_str(&table(
                            &items(&split["schema"]["labels"]).collect::<Vec<_>>(),
                            &board["results"],
                        ));
                    }
                }
            }
        }
        Ok(if text.is_empty() {
            "no entries yet".to_owned()
        } else {
            text.trim_end().to_owned()
        })
    }

    async fn json(&self, method: Method, path: &str, body: Option<&Value>) -> Result<Value, Failure> {
        Ok(serde_json::from_str(&self.call(method, path, body).await?).unwrap_or_default())
    }

    async fn call(&self, method: Method, path: &str, body: Option<&Value>) -> Result<String, Failure> {
        let unreachable = |source| Failure::Unreachable {
            server: self.server.clone(),
            source,
        };
        let mut request = self
            .http
            .request(method, format!("{}{path}", self.server))
            .bearer_auth(&self.token);
        if let Some(body) = body {
            request = request.json(body);
        }
        let answer = request.send().await.map_err(unreachable)?;
        let status = answer.status();
        let text = answer.text().await.map_err(unreachable)?;
        if status.is_success() {
            return Ok(text);
        }
        let json: Value = serde_json::from_str(&text).unwrap_or_default();
        let known = ["error", "detail"].into_iter().find_map(|name| json[name].as_str());
        let page = || "a page for an exception; see the log of `evalai-stand-in serve`".to_owned();
        let reason = known.map_or_else(page, str::to_owned);
        Err(Failure::Refused {
            status: status.as_u16(),
            reason,
        })
    }
}

/// One entry after the other, a metric a line: twelve to fifteen columns fit no terminal.
fn table(labels: &[&Value], entries: &Value) -> String {
    let mut text = String::new();
    for (rank, entry) in (1..).zip(items(entries)) {
        let (team, pk) = (
            plain(&entry["submission__participant_team__team_name"]),
            &entry["submission__id"],
        );
        let _ = writeln!(text, "  {rank}. {team} (submission {pk})");
        for (label, value) in labels.iter().zip(items(&entry["result"])) {
            let _ = writeln!(text, "     {:36} {}", plain(label), plain(value));
        }
    }
    text
}

fn items(value: &Value) -> impl Iterator<Item = &Value> {
    value.as_array().into_iter().flatten()
}

fn plain(value: &Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), str::to_owned)
}
