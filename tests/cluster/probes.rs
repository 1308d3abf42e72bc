//! A hostile image tries each attack of local/challenge/probe, as root and as a user, under Leaderboard 1.0 and 2.0. An attack that gets
//! through fails the test. The test looks at the object of each attack that only the cluster holds.

use std::collections::BTreeMap;
use std::net::IpAddr;
use std::time::Duration;

use challenge_probe::objects::{Check, OBJECTS};
use challenge_probe::probe::Probe;
use challenge_probe::seen::{self, Seen};
use challenge_probe::table;
use futures::future::join_all;
use k8s_openapi::api::core::v1::{Node, Pod, Service};
use k8s_openapi::api::networking::v1::{NetworkPolicy, NetworkPolicySpec};
use kube::ResourceExt;
use kube::api::{Api, ListParams, PostParams};
use leaderboard_api::State;
use leaderboard_api::ranges::Range;
use serde_json::{Value, json};

use super::matrix;
use crate::operator::controller;
use crate::scene::{Scene, scenario, state};

const LIMIT: Duration = Duration::from_mins(5);
/// The Leaderboards, which are named after their versions.
const VERSIONS: [&str; 2] = ["V1", "V2"];
const IMAGES: [&str; 2] = ["probe", "probe-user"];

/// A name for a run, and what each probe saw in it.
type Run = (String, BTreeMap<String, Seen>);

#[tokio::test]
async fn no_probe_of_a_hostile_image_gets_through() {
    scenario("probes", async |scene: &Scene| {
        for version in VERSIONS {
            let change = with_network(json!({"evaluation": {"carla": {"version": version}}}));
            scene.leaderboard(&version.to_lowercase(), change).await;
        }
        make_service(scene).await;
        let _controller = controller(scene);
        let mut names = Vec::new();
        for version in VERSIONS.map(str::to_lowercase) {
            for image in IMAGES {
                let name = format!("{version}-{image}");
                scene.submit_to(&version, &name, &format!("agent:{image}")).await;
                names.push(name);
            }
        }
        check_objects(scene, &names[0]).await;
        let runs = join_all(names.iter().map(|name| probed(scene, name))).await;
        let failed: Vec<String> = table::probes().filter_map(|probe| judge(probe, &runs)).collect();
        assert!(failed.is_empty(), "{} probes:\n{}", failed.len(), failed.join("\n"));
    })
    .await;
}

/// Something of the namespace that a Pod would read of.
async fn make_service(scene: &Scene) {
    let service = json!({"metadata": {"name": "other"}, "spec": {"ports": [{"port": 80}]}});
    let service: Service = serde_json::from_value(service).unwrap();
    scene.api().create(&PostParams::default(), &service).await.unwrap();
}

/// Two pairs, so that there is another agent's folder; everything outside open, so that it shows what is never opened.
fn with_network(change: Value) -> Value {
    let mut base = json!({
        "evaluation": {"carla": {"pairs": 2, "routes": 2, "repetitions": 1}},
        "network": {"dns": "None", "egress": [{"cidr": "0.0.0.0/0"}, {"cidr": "::/0"}], "enforcement": "Disabled"},
    });
    crate::scene::lay_over(&mut base, change);
    base
}

/// Sightings of the first pair's probes. The run ends as an honest one does: the probes have broken no part of it.
async fn probed(scene: &Scene, name: &str) -> Run {
    let ended = scene.settled(name, LIMIT).await;
    assert_eq!(state(&ended), Some(State::Finished), "{name}: {:?}", ended.status);
    let log = scene.cloud.text(name, "agent/agent1/leaderboard.log").await;
    let mut all = BTreeMap::new();
    for (id, seen) in log.lines().filter_map(seen::parse) {
        all.entry(id.to_owned()).or_insert(seen);
    }
    (name.to_owned(), all)
}

/// Prints the probe's line; what is wrong with it.
fn judge(probe: &Probe, runs: &[Run]) -> Option<String> {
    let nothing = Seen::Unclear("it printed no line".to_owned());
    let of = |run: &Run| run.1.get(probe.id).unwrap_or(&nothing).clone();
    let wrong: Vec<_> = runs
        .iter()
        .filter(|run| !probe.expected.allows(&of(run)))
        .map(|run| format!("{}: {}", run.0, of(run)))
        .collect();
    let mut seen: Vec<_> = runs.iter().map(|run| of(run).to_string()).collect();
    seen.sort();
    seen.dedup();
    let expected = probe.expected.word();
    let name = format!("probe {}: {}", probe.id, probe.attack);
    if wrong.is_empty() {
        matrix::as_expected(&name, expected, &seen.join("; "));
        return None;
    }
    matrix::not_as_expected(&name, expected, &wrong.join("; "));
    Some(format!("{name}: expected {expected}, {}", wrong.join("; ")))
}

/// A host who takes our confinement away sees it taken away: so a probe that says "denied" elsewhere means it.
#[tokio::test]
async fn the_probes_see_what_a_container_with_more_rights_may_do() {
    scenario("probes-open", async |scene: &Scene| {
        let rights = [
            "SYS_ADMIN",
            "SYS_CHROOT",
            "MKNOD",
            "NET_RAW",
            "SETUID",
            "DAC_READ_SEARCH",
        ];
        let change = json!({
            "evaluation": {"carla": {"pairs": 1, "routes": 1}},
            "agent": {"securityContext": {
                "allowPrivilegeEscalation": true,
                "capabilities": {"add": rights},
                "seccompProfile": {"type": "Unconfined"},
                "appArmorProfile": {"type": "Unconfined"},
            }},
        });
        scene.leaderboard("lb", change).await;
        let _controller = controller(scene);
        scene.submit("open", "agent:probe").await;
        let (_, found) = probed(scene, "open").await;
        let blind: Vec<_> = table::probes()
            .filter(|probe| probe.opens_with_rights && !matches!(found.get(probe.id), Some(Seen::Open(_))))
            .map(|probe| format!("{}: {:?}", probe.id, found.get(probe.id)))
            .collect();
        assert!(blind.is_empty(), "{blind:#?}");
    })
    .await;
}

async fn check_objects(scene: &Scene, submission: &str) {
    let pod = scene.first_pod(submission, LIMIT).await;
    let policies = policies_of(scene, &pod).await;
    assert!(
        !policies.is_empty(),
        "no policy selects {}: {:?}",
        pod.name_any(),
        pod.labels()
    );
    let mut failed = Vec::new();
    for object in OBJECTS {
        let name = format!("probe: {}", object.attack);
        let wrong = match object.check {
            Check::NoWayTo(addresses) => addresses
                .iter()
                .find(|address| policies.iter().any(|policy| is_open_to(policy, address)))
                .map(|address| format!("{address} is open")),
            Check::NothingComesIn => policies
                .iter()
                .find(|policy| !lets_nothing_in(policy))
                .map(|policy| format!("open: {:?}", policy.ingress)),
            Check::PodPidsLimit => no_limit_of_processes(scene, &pod).await,
        };
        match wrong {
            None => matrix::as_expected(&name, "by policy", object.shown),
            Some(wrong) => {
                matrix::not_as_expected(&name, "by policy", &wrong);
                failed.push(format!("{name}: {wrong}"));
            }
        }
    }
    assert!(failed.is_empty(), "{}", failed.join("\n"));
}

/// The policies that select a Pod, as a network plugin would find them.
async fn policies_of(scene: &Scene, pod: &Pod) -> Vec<NetworkPolicySpec> {
    let all = scene.all::<NetworkPolicy>().await.into_iter();
    let specs = all.filter_map(|policy| policy.spec);
    let selects = |spec: &NetworkPolicySpec| {
        let selector = spec.pod_selector.clone().unwrap_or_default();
        let labels = selector.match_labels.unwrap_or_default();
        selector.match_expressions.is_none() && labels.iter().all(|(key, value)| pod.labels().get(key) == Some(value))
    };
    specs.filter(selects).collect()
}

fn has_type(policy: &NetworkPolicySpec, wanted: &str) -> bool {
    policy.policy_types.iter().flatten().any(|kind| kind == wanted)
}

fn lets_nothing_in(policy: &NetworkPolicySpec) -> bool {
    has_type(policy, "Ingress") && policy.ingress.iter().flatten().next().is_none()
}

/// True if a rule lets the address through. Anything but a block of addresses may be any Pod, so it counts as open.
fn is_open_to(policy: &NetworkPolicySpec, address: &str) -> bool {
    if !has_type(policy, "Egress") {
        return true;
    }
    let address: IpAddr = address.parse().unwrap();
    let address = Range::new(address, if address.is_ipv4() { 32 } else { 128 }).unwrap();
    let covers = |cidr: &str| Range::parse(cidr).unwrap().contains(address);
    policy.egress.iter().flatten().any(|rule| {
        let peers = rule.to.as_deref().unwrap_or_default();
        peers.is_empty()
            || peers.iter().any(|peer| {
                peer.ip_block.as_ref().is_none_or(|block| {
                    covers(&block.cidr) && !block.except.iter().flatten().any(|except| covers(except))
                })
            })
    })
}

/// The fault of the kubelet's limit of a Pod's processes; None if there is a limit.
async fn no_limit_of_processes(scene: &Scene, pod: &Pod) -> Option<String> {
    let nodes: Api<Node> = Api::all(scene.client.clone());
    let bound = pod.spec.as_ref().and_then(|spec| spec.node_name.clone());
    // Not bound yet: there is one node.
    let node = match bound {
        Some(node) => node,
        None => nodes.list(&ListParams::default()).await.unwrap().items[0].name_any(),
    };
    let path = format!("/api/v1/nodes/{node}/proxy/configz");
    let request = http::Request::get(path).body(Vec::new()).unwrap();
    let config: Value = scene.client.request(request).await.unwrap();
    let limit = config["kubeletconfig"]["podPidsLimit"].as_i64();
    limit
        .is_none_or(|limit| limit <= 0)
        .then(|| format!("podPidsLimit is {limit:?}"))
}

#[test]
fn a_policy_is_open_where_one_of_its_rules_is() {
    let policy = |egress: Value| -> NetworkPolicySpec {
        let spec = json!({"podSelector": {}, "policyTypes": ["Egress"], "egress": egress});
        serde_json::from_value(spec).unwrap()
    };
    let block = |cidr: &str, except: &[&str]| json!([{"to": [{"ipBlock": {"cidr": cidr, "except": except}}]}]);
    for (egress, address, is_open) in [
        (block("0.0.0.0/0", &[]), "169.254.169.254", true),
        (block("0.0.0.0/0", &["169.254.0.0/16"]), "169.254.169.254", false),
        (block("10.0.0.0/8", &[]), "169.254.169.254", false),
        (block("::/0", &[]), "fd00:ec2::254", true),
        (json!([{"to": [{"namespaceSelector": {}}]}]), "10.0.0.1", true),
        (json!([{}]), "10.0.0.1", true),
        (json!([]), "10.0.0.1", false),
    ] {
        assert_eq!(
            is_open_to(&policy(egress.clone()), address),
            is_open,
            "{egress} {address}"
        );
    }
}
