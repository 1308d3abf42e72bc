//! `dashboard` up to where a kubelet begins: which replica it finds, what it says where there is none, and its listener.

use k8s_openapi::api::core::v1::Pod;
use kube::Api;
use kube::api::{Patch, PatchParams, PostParams};
use serde_json::{Value, json};
use tokio::io::AsyncReadExt;
use tokio::net::TcpStream;
use tokio::time::timeout;

use super::terminal::{Terminal, Waits, assert_has};
use crate::api::bridge::LIMIT;
use crate::api::objects::Kind;

/// A replica of the operator that is ready, with this port.
async fn replica(terminal: &Terminal, name: &str, port: &str) {
    let pods: Api<Pod> = Api::namespaced(terminal.client.clone(), &terminal.namespace);
    let labels =
        json!({"app.kubernetes.io/part-of": "leaderboard-operator", "app.kubernetes.io/component": "controller"});
    let ports = json!([{"name": port, "containerPort": 8081}]);
    let pod = json!({
        "metadata": {"name": name, "labels": labels},
        "spec": {"containers": [{"name": "controller", "image": "operator:1", "ports": ports}]},
    });
    let pod = serde_json::from_value(pod).unwrap();
    pods.create(&PostParams::default(), &pod).await.unwrap();
    let ready: Value = json!({"status": {"conditions": [{"type": "Ready", "status": "True"}]}});
    pods.patch_status(name, &PatchParams::default(), &Patch::Merge(ready))
        .await
        .unwrap();
}

#[tokio::test]
async fn dashboard_prints_what_is_missing_before_a_browser_is_sent_anywhere() {
    let terminal = Terminal::new().await;
    terminal.leaderboard(&json!({})).await;
    let text = terminal.run(&["dashboard"]).await.refused();
    assert_has(&text, &["names its operator", "--operator-namespace"]);

    let operator = format!("{}/operator", terminal.namespace);
    terminal
        .status(Kind::Leaderboard, "local", &json!({"operator": operator}))
        .await;
    let text = terminal.run(&["dashboard"]).await.refused();
    assert_has(&text, &["has no replica", "its Deployment runs"]);

    replica(&terminal, "without", "http").await;
    let text = terminal.run(&["dashboard"]).await.refused();
    assert_has(&text, &["serves no page", "webUI.enabled"]);

    replica(&terminal, "with", "page").await;
    let mut command = terminal.command(&["dashboard", "--operator-namespace", &terminal.namespace]);
    let mut waits = Waits::start(&mut command);
    let line = timeout(LIMIT, waits.lines.next_line()).await.unwrap().unwrap().unwrap();
    let address = line.strip_prefix("http://").and_then(|rest| rest.split('/').next());
    let address = address.expect(&line);
    assert!(address.starts_with("127.0.0.1:"), "{line}");
    // No kubelet answers here: each connection ends, and the command stays.
    for _ in 0..2 {
        let mut browser = TcpStream::connect(address).await.unwrap();
        let mut answer = Vec::new();
        timeout(LIMIT, browser.read_to_end(&mut answer)).await.unwrap().unwrap();
        assert!(answer.is_empty());
    }
    assert!(waits.child.try_wait().unwrap().is_none());
}
