//! The NetworkPolicy of a Leaderboard: nothing in, out only what its `network` names. Pure; called by the controller in each
//! reconcile of a Leaderboard, and before each Job.
//!
//! It holds for whole Pods, so what logcopy may reach the agents may reach too. The cluster's network plugin decides
//! whether it is enforced, and `pod::isolation` measures that.

use std::collections::BTreeMap;

use k8s_openapi::api::networking::v1::{
    IPBlock, NetworkPolicy, NetworkPolicyEgressRule, NetworkPolicyPeer, NetworkPolicyPort, NetworkPolicySpec,
};
use k8s_openapi::apimachinery::pkg::apis::meta::v1::LabelSelector;
use k8s_openapi::apimachinery::pkg::util::intstr::IntOrString;

use crate::owner::child_of;
use leaderboard_api::ranges::{self, Range};
use leaderboard_api::{Dns, Egress, Leaderboard, names};

const DNS_PORT: i32 = 53;
/// The cluster's own DNS, CoreDNS among them, has this label everywhere.
const DNS_PODS: (&str, &str) = ("k8s-app", "kube-dns");
const DNS_NAMESPACE: &str = "kube-system";
/// Every namespace has its name as this label.
const NAME_LABEL: &str = "kubernetes.io/metadata.name";

/// Name of a Leaderboard's policy.
pub fn name(leaderboard: &Leaderboard) -> String {
    format!(
        "leaderboard-{}",
        leaderboard.metadata.name.as_deref().unwrap_or_default()
    )
}

/// The policy for all Pods of a Leaderboard, owned by it.
pub fn network_policy(leaderboard: &Leaderboard) -> NetworkPolicy {
    let name = leaderboard.metadata.name.as_deref().unwrap_or_default();
    NetworkPolicy {
        metadata: child_of(leaderboard, self::name(leaderboard)),
        spec: Some(NetworkPolicySpec {
            pod_selector: Some(labelled((names::LABEL_LEADERBOARD, name))),
            policy_types: Some(vec!["Ingress".into(), "Egress".into()]),
            // Empty, not absent: an apply leaves a field alone that it does not name, and with it a rule that somebody added.
            ingress: Some(Vec::new()),
            egress: Some(egress(leaderboard)),
        }),
    }
}

/// True if a policy, as the API server has it, is the one of the Leaderboard's present spec.
pub fn is_in_place(found: &NetworkPolicy, leaderboard: &Leaderboard) -> bool {
    let wanted = network_policy(leaderboard);
    let has_labels = wanted.metadata.labels.iter().flatten().all(|(key, value)| {
        let labels = found.metadata.labels.as_ref();
        labels.is_some_and(|labels| labels.get(key) == Some(value))
    });
    // One of an older Leaderboard of this name is going away with its owner.
    let mut owners = found.metadata.owner_references.iter().flatten();
    let is_owned = owners.any(|owner| Some(&owner.uid) == leaderboard.metadata.uid.as_ref());
    let is_going = found.metadata.deletion_timestamp.is_some();
    has_labels && is_owned && !is_going && found.spec.clone().map(plain) == wanted.spec.map(plain)
}

/// The API server drops empty lists.
fn plain(spec: NetworkPolicySpec) -> NetworkPolicySpec {
    NetworkPolicySpec {
        ingress: spec.ingress.filter(|rules| !rules.is_empty()),
        egress: spec.egress.filter(|rules| !rules.is_empty()),
        ..spec
    }
}

fn egress(leaderboard: &Leaderboard) -> Vec<NetworkPolicyEgressRule> {
    let network = &leaderboard.spec.network;
    let names = (network.dns == Dns::Cluster).then(|| dns(&network.dns_servers));
    names
        .into_iter()
        .chain(network.egress.iter().filter_map(rule))
        .collect()
}

/// The cluster's DNS, and further servers: no other Pod, which might answer on the same port what is no question of names.
fn dns(servers: &[String]) -> NetworkPolicyEgressRule {
    let pods = NetworkPolicyPeer {
        namespace_selector: Some(labelled((NAME_LABEL, DNS_NAMESPACE))),
        pod_selector: Some(labelled(DNS_PODS)),
        ip_block: None,
    };
    let servers = servers.iter().filter_map(|server| Range::of(server));
    let servers = servers.map(|range| block(range.text(), Vec::new()));
    NetworkPolicyEgressRule {
        to: Some([pods].into_iter().chain(servers).collect()),
        ports: Some(["UDP", "TCP"].map(|protocol| port(protocol, DNS_PORT)).into()),
    }
}

fn rule(egress: &Egress) -> Option<NetworkPolicyEgressRule> {
    let range = Range::parse(&egress.cidr)?;
    let forbidden: Vec<Range> = ranges::forbidden().collect();
    if forbidden.iter().any(|forbidden| forbidden.contains(range)) {
        return None;
    }
    let except = forbidden
        .into_iter()
        .filter(|forbidden| range.contains(*forbidden))
        .map(Range::text);
    Some(NetworkPolicyEgressRule {
        to: Some(vec![block(range.text(), except.collect())]),
        ports: (!egress.ports.is_empty()).then(|| egress.ports.iter().map(|number| port("TCP", *number)).collect()),
    })
}

fn labelled((key, value): (&str, &str)) -> LabelSelector {
    LabelSelector {
        match_labels: Some(BTreeMap::from([(key.into(), value.into())])),
        match_expressions: None,
    }
}

fn block(cidr: String, except: Vec<String>) -> NetworkPolicyPeer {
    let except = (!except.is_empty()).then_some(except);
    NetworkPolicyPeer {
        ip_block: Some(IPBlock { cidr, except }),
        ..NetworkPolicyPeer::default()
    }
}

fn port(protocol: &str, number: i32) -> NetworkPolicyPort {
    NetworkPolicyPort {
        protocol: Some(protocol.into()),
        port: Some(IntOrString::Int(number)),
        end_port: None,
    }
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn leaderboard(network: &Value) -> Leaderboard {
        let leaderboard = serde_json::from_value(json!({
            "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Leaderboard",
            "metadata": {"name": "carla-2", "namespace": "challenge", "uid": "u-1"},
            "spec": {
                "evaluation": {"carla": {
                    "version": "V2", "contents": {"image": "contents"}, "simulator": {"image": "simulator"},
                }}, "tracks": [{"name": "sensors"}],
                "storage": {"s3": {"bucket": "bucket"}}, "network": network,
            },
        }));
        leaderboard.unwrap()
    }

    fn policy(network: &Value) -> Value {
        serde_json::to_value(network_policy(&leaderboard(network))).unwrap()
    }

    #[test]
    fn by_default_nothing_but_dns_gets_out_and_nothing_in() {
        let policy = policy(&json!({}));
        assert_eq!(policy["metadata"]["name"], "leaderboard-carla-2");
        assert_eq!(policy["metadata"]["namespace"], "challenge");
        assert_eq!(policy["metadata"]["ownerReferences"][0]["kind"], "Leaderboard");
        assert_eq!(policy["metadata"]["ownerReferences"][0]["uid"], "u-1");
        assert_eq!(
            policy["spec"],
            json!({
                "podSelector": {"matchLabels": {"leaderboard.carla.org/leaderboard": "carla-2"}},
                "policyTypes": ["Ingress", "Egress"],
                "ingress": [],
                "egress": [{
                    "to": [
                        {
                            "namespaceSelector": {"matchLabels": {"kubernetes.io/metadata.name": "kube-system"}},
                            "podSelector": {"matchLabels": {"k8s-app": "kube-dns"}},
                        },
                        {"ipBlock": {"cidr": "169.254.20.10/32"}},
                    ],
                    "ports": [{"protocol": "UDP", "port": 53}, {"protocol": "TCP", "port": 53}],
                }],
            })
        );
    }

    #[test]
    fn names_are_asked_of_the_servers_that_are_named() {
        let peers = |network: &Value| -> Vec<Value> {
            let egress = policy(network)["spec"]["egress"].clone();
            egress[0]["to"].as_array().unwrap()[1..].to_vec()
        };
        assert_eq!(peers(&json!({"dnsServers": []})), Vec::<Value>::new());
        assert_eq!(
            peers(&json!({"dnsServers": ["10.0.0.10", "10.1.2.3/24", "fd00::a", "nonsense"]})),
            ["10.0.0.10/32", "10.1.2.0/24", "fd00::a/128"].map(|cidr| json!({"ipBlock": {"cidr": cidr}}))
        );
        assert_eq!(
            policy(&json!({"dns": "None", "dnsServers": ["10.0.0.10"]}))["spec"]["egress"],
            json!([])
        );
    }

    #[test]
    fn without_dns_and_addresses_nothing_gets_out() {
        assert_eq!(policy(&json!({"dns": "None"}))["spec"]["egress"], json!([]));
    }

    #[test]
    fn ports_are_tcp_and_none_means_all() {
        let network =
            json!({"dns": "None", "egress": [{"cidr": "10.1.2.3/16", "ports": [443, 4566]}, {"cidr": "192.0.2.0/24"}]});
        assert_eq!(
            policy(&network)["spec"]["egress"],
            json!([
                {"to": [{"ipBlock": {"cidr": "10.1.0.0/16"}}], "ports": [{"protocol": "TCP", "port": 443}, {"protocol": "TCP", "port": 4566}]},
                {"to": [{"ipBlock": {"cidr": "192.0.2.0/24"}}]},
            ])
        );
    }

    #[test]
    fn no_range_reaches_a_metadata_address() {
        let cases: [(&str, Option<&[&str]>); 14] = [
            (
                "0.0.0.0/0",
                Some(&[
                    "169.254.0.0/16",
                    "100.100.100.200/32",
                    "168.63.129.16/32",
                    "192.0.0.192/32",
                ]),
            ),
            (
                "128.0.0.0/1",
                Some(&["169.254.0.0/16", "168.63.129.16/32", "192.0.0.192/32"]),
            ),
            ("100.64.0.0/10", Some(&["100.100.100.200/32"])),
            ("168.63.129.16/32", None),
            ("192.0.0.0/24", Some(&["192.0.0.192/32"])),
            ("169.0.0.0/8", Some(&["169.254.0.0/16"])),
            ("10.0.0.0/8", Some(&[])),
            ("169.254.0.0/16", None),
            ("169.254.169.254/32", None),
            ("169.254.170.23/32", None),
            ("::/0", Some(&["fe80::/10", "fd00:ec2::/64"])),
            ("fd00::/8", Some(&["fd00:ec2::/64"])),
            ("fd00:ec2::254/128", None),
            ("2001:db8::/32", Some(&[])),
        ];
        for (cidr, expected) in cases {
            let egress = policy(&json!({"dns": "None", "egress": [{"cidr": cidr}]}))["spec"]["egress"].clone();
            let except = |rule: &Value| -> Vec<String> {
                let list = rule["to"][0]["ipBlock"]["except"]
                    .as_array()
                    .cloned()
                    .unwrap_or_default();
                list.iter().map(|text| text.as_str().unwrap().to_owned()).collect()
            };
            let rules = egress.as_array().unwrap();
            assert_eq!(
                rules.first().map(except),
                expected.map(|list| list.iter().map(ToString::to_string).collect()),
                "{cidr}"
            );
        }
    }

    #[test]
    fn a_policy_is_in_place_only_as_the_present_spec_asks_for_it() {
        let asked = leaderboard(&json!({"egress": [{"cidr": "10.1.2.3/32", "ports": [443]}]}));
        let applied = serde_json::to_value(network_policy(&asked)).unwrap();
        let is_in_place = |found: &Value, leaderboard: &Leaderboard| {
            super::is_in_place(&serde_json::from_value(found.clone()).unwrap(), leaderboard)
        };
        assert!(is_in_place(&applied, &asked));
        // As it comes back from the API server.
        let mut stored = applied.clone();
        stored["spec"].as_object_mut().unwrap().remove("ingress");
        stored["metadata"]["labels"]["team"] = json!("somebody's");
        assert!(is_in_place(&stored, &asked));
        assert!(!is_in_place(
            &stored,
            &leaderboard(&json!({"egress": [{"cidr": "10.1.2.4/32", "ports": [443]}]}))
        ));

        let edits: [(&str, Value); 8] = [
            ("/spec/ingress", json!([{}])),
            ("/spec/egress", json!([{}])),
            ("/spec/egress", Value::Null),
            ("/spec/policyTypes", json!(["Ingress"])),
            (
                "/spec/podSelector/matchExpressions",
                json!([{"key": "x", "operator": "Exists"}]),
            ),
            ("/metadata/labels/app.kubernetes.io~1managed-by", json!("somebody")),
            ("/metadata/ownerReferences/0/uid", json!("u-0")),
            ("/metadata/deletionTimestamp", json!("2026-11-01T12:00:00Z")),
        ];
        for (place, value) in edits {
            let mut edited = applied.clone();
            let (parent, field) = place.rsplit_once('/').unwrap();
            edited.pointer_mut(parent).unwrap()[field.replace("~1", "/")] = value;
            assert!(!is_in_place(&edited, &asked), "{place}");
        }
    }
}
