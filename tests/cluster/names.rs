//! A Pod that can ask no server for a name (`network.dns: None`), on a node: its own containers reach S3 by the host's aliases.

use std::fs;
use std::time::Duration;

use k8s_openapi::api::core::v1::Pod;
use kube::ResourceExt;
use leaderboard_api::State;
use serde_json::json;

use crate::operator::controller_with_hosts;
use crate::processes;
use crate::scene::{Scene, containers, scenario, state};

/// A name that no resolver of the world knows.
const NAME: &str = "s3.aliased.invalid";
const LIMIT: Duration = Duration::from_mins(4);

#[tokio::test]
async fn a_pod_that_can_ask_no_server_stores_its_results_by_the_hosts_aliases() {
    scenario("names", async |scene: &Scene| {
        let host = &scene.lab.host;
        let endpoint = scene.cloud.endpoint.replacen(host, NAME, 1);
        assert!(endpoint.contains(NAME), "{endpoint} is not at {host}");
        let change = json!({
            "evaluation": {"carla": {"pairs": 1, "routes": 2}},
            "storage": {"s3": {"endpoint": endpoint}},
            "network": {"dns": "None"},
            // A Pod must name a server: its own loopback, where no program answers.
            "podOverrides": {"spec": {
                "dnsPolicy": "None",
                "dnsConfig": {"nameservers": ["127.0.0.1"]},
                "hostAliases": [{"ip": host, "hostnames": [NAME]}],
            }},
            // It drives on while its Pod's files are read.
            "agent": {"env": [{"name": "ROUTE_MS", "value": "3000"}]},
        });
        scene.leaderboard("lb", change).await;
        let _controller = controller_with_hosts(scene, &format!("127.0.0.1 localhost\n{host} {NAME}\n"));
        scene.submit("aliased", "agent:standard").await;
        let pod = pod_with_logcopy(scene).await;
        let logcopy = processes::named(&pod, "logcopy", "leaderboard-ope", LIMIT).await;
        let read = |path: &str| fs::read_to_string(format!("/proc/{logcopy}/root{path}")).unwrap();
        let resolver = read("/etc/resolv.conf");
        let servers: Vec<&str> = resolver
            .lines()
            .filter_map(|line| line.strip_prefix("nameserver "))
            .collect();
        assert_eq!(servers, ["127.0.0.1"], "{resolver}");
        let hosts = read("/etc/hosts");
        assert!(hosts.contains(NAME), "{hosts}");

        let ended = scene.settled("aliased", LIMIT).await;
        assert_eq!(state(&ended), Some(State::Finished), "{:?}", ended.status);
        assert_eq!(scene.jobs().await, ["aliased-1"]);
        let keys = scene.cloud.keys("aliased").await;
        // Objects of `workspace`, and of `logcopy`.
        for key in ["logcopy/owner", "evalai/results.json"] {
            assert!(keys.contains_key(key), "{key}: {keys:?}");
        }
    })
    .await;
}

/// The Pod of the run, once its `logcopy` runs.
async fn pod_with_logcopy(scene: &Scene) -> Pod {
    let name = scene.first_pod("aliased", LIMIT).await.name_any();
    let runs = |pod: Option<&Pod>| {
        let all = pod.map(containers).unwrap_or_default();
        let state = all
            .into_iter()
            .find(|found| found.name == "logcopy")
            .and_then(|found| found.state);
        state.is_some_and(|state| state.running.is_some())
    };
    scene.wait(&name, "its logcopy runs", LIMIT, runs).await.unwrap()
}
