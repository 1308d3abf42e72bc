//! The server, its configuration and its API.

use std::collections::BTreeSet;
use std::fs;
use std::net::SocketAddr;
use std::path::Path;

use serde_json::{Value, json};
use tokio::process::Child;

use super::super::bridge::eventually;
use crate::support::tools;

/// A process to scrape, with the labels that the chart's monitors give it.
pub(super) struct Target {
    pub(super) job: &'static str,
    pub(super) pod: String,
    pub(super) namespace: String,
    pub(super) address: SocketAddr,
}

/// A running server; its folder goes with it.
pub(super) struct Prometheus {
    url: String,
    http: reqwest::Client,
    _child: Child,
    _folder: tempfile::TempDir,
}

impl Prometheus {
    /// With this file of rules and these targets, all of them asked each second.
    pub(super) async fn start(rules: &Path, targets: impl Iterator<Item = &Target>) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let place = |name: &str| folder.path().join(name);
        let scraped: Vec<_> = targets.map(scrape).collect();
        let settings = json!({
            "global": {"scrape_interval": "1s", "evaluation_interval": "1s"},
            "rule_files": [rules],
            "scrape_configs": scraped,
        });
        // JSON is YAML.
        fs::write(place("prometheus.json"), settings.to_string()).unwrap();
        let arguments = [
            format!("--config.file={}", place("prometheus.json").display()),
            format!("--storage.tsdb.path={}", place("data").display()),
            "--web.listen-address=127.0.0.1:0".into(),
        ];
        let program = tools::program("prometheus").await;
        let (child, address) = tools::start(&program, &arguments, "Listening on").await;
        let server = Self {
            url: format!("http://{address}/api/v1"),
            http: reqwest::Client::builder().no_proxy().build().unwrap(),
            _child: child,
            _folder: folder,
        };
        eventually("Prometheus is ready", async || server.is_ready().await).await;
        server
    }

    async fn is_ready(&self) -> bool {
        let url = self.url.replace("/api/v1", "/-/ready");
        let answer = self.http.get(url).send().await;
        answer.is_ok_and(|answer| answer.status().is_success())
    }

    /// The data of an answer of its API, which must be free of errors and warnings.
    pub(super) async fn get(&self, path: &str, parameters: &[(&str, &str)]) -> Value {
        let url = reqwest::Url::parse_with_params(&format!("{}/{path}", self.url), parameters).unwrap();
        let answer = self.http.get(url).send().await.unwrap().text().await.unwrap();
        let answer: Value = serde_json::from_str(&answer).unwrap();
        let faults = ["error", "warnings", "infos"].map(|key| &answer[key]);
        assert_eq!(
            (&answer["status"], faults),
            (&json!("success"), [&Value::Null; 3]),
            "{path} {parameters:?}"
        );
        answer["data"].clone()
    }

    /// The samples that a query has now.
    pub(super) async fn query(&self, query: &str) -> Vec<Value> {
        let data = self.get("query", &[("query", query)]).await;
        data["result"].as_array().unwrap().clone()
    }

    /// Waits until a query has one sample with this value.
    pub(super) async fn until(&self, query: &str, value: &str) {
        let what = format!("{query} is {value}");
        eventually(&what, async || {
            let found = self.query(query).await;
            found.len() == 1 && found[0]["value"][1] == value
        })
        .await;
    }

    /// The rules that it has loaded, each with its state.
    pub(super) async fn rules(&self) -> Vec<Value> {
        let groups = self.get("rules", &[]).await["groups"].clone();
        let groups = groups.as_array().unwrap().iter();
        groups
            .flat_map(|group| group["rules"].as_array().unwrap().clone())
            .collect()
    }

    /// The names of all that it has stored.
    pub(super) async fn names(&self) -> BTreeSet<String> {
        serde_json::from_value(self.get("label/__name__/values", &[]).await).unwrap()
    }
}

/// As the operator of Prometheus makes it of the chart's monitors, which set `honorLabels`.
fn scrape(target: &Target) -> Value {
    let labels = json!({"job": target.job, "namespace": target.namespace, "pod": target.pod});
    json!({
        "job_name": target.pod,
        "honor_labels": true,
        "static_configs": [{"targets": [target.address], "labels": labels}],
    })
}
