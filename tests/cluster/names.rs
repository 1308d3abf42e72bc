//! Pods that can look up no name: the operator has looked the services' names up for them.

use std::time::Duration;

use k8s_openapi::api::core::v1::Pod;
use k8s_openapi::api::networking::v1::NetworkPolicy;
use serde_json::json;

use super::expected::{assert_finished, assert_results};
use crate::operator::controller_that_knows;
use crate::scene::{Scene, scenario};

const LIMIT: Duration = Duration::from_mins(4);
/// Known to the operator alone.
const S3: &str = "s3.pinned.invalid";
const LOGS: &str = "logs.pinned.invalid";

/// Who of a Pod is told a text.
fn told(pod: &Pod, text: &str) -> Vec<String> {
    let spec = pod.spec.as_ref().unwrap();
    let all = spec.init_containers.iter().flatten().chain(&spec.containers);
    let told = all.filter(|container| json!(container).to_string().contains(text));
    told.map(|container| container.name.clone()).collect()
}

#[tokio::test]
async fn an_agent_gains_no_resolver_where_its_run_is_stored_by_names() {
    scenario("names", async |scene: &Scene| {
        let (_, port) = scene.cloud.endpoint.rsplit_once(':').unwrap();
        let at = |name: &str| format!("http://{name}:{port}");
        let change = json!({
            "storage": {"endpoint": at(S3)},
            "logGroup": {"name": scene.namespace, "endpoint": at(LOGS), "retentionDays": 1},
            "network": {"dns": "Pinned"},
        });
        scene.leaderboard("lb", change).await;
        let host = &scene.lab.host;
        let _controller = controller_that_knows(scene, &format!("127.0.0.1 localhost\n{host} {S3} {LOGS}\n"));
        scene.submit("one", "agent:standard").await;
        let pod = scene.first_pod("one", LIMIT).await;
        for name in [S3, LOGS] {
            assert_eq!(told(&pod, name), ["workspace", "logcopy"], "{name}");
        }
        assert!(pod.spec.as_ref().unwrap().host_aliases.is_none());
        let policy = scene.api::<NetworkPolicy>().get("leaderboard-lb").await.unwrap();
        let policy = json!(policy.spec).to_string();
        assert!(
            policy.contains(host.as_str()) && !policy.contains("\"port\":53"),
            "{policy}"
        );
        let ended = scene.settled("one", LIMIT).await;
        assert_finished(&ended);
        assert_results(&scene.cloud.text("one", "evalai/results.json").await);
        let own = scene.cloud.text("one", "logcopy/logcopy.log").await;
        assert!(!own.contains("CloudWatch"), "{own}");
    })
    .await;
}
