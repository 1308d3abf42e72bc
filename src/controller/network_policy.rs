//! The NetworkPolicy of a Leaderboard: nothing in, out only what its `network` names. Pure; called by the controller when a
//! Leaderboard changes.
//!
//! It holds for whole Pods, so what logcopy may reach the agents may reach too. Whether it is enforced is the cluster's
//! network plugin to say.

use std::collections::BTreeMap;
use std::net::IpAddr;

use k8s_openapi::api::networking::v1::{
    IPBlock, NetworkPolicy, NetworkPolicyEgressRule, NetworkPolicyPeer, NetworkPolicyPort, NetworkPolicySpec,
};
use k8s_openapi::apimachinery::pkg::apis::meta::v1::{LabelSelector, ObjectMeta, OwnerReference};
use k8s_openapi::apimachinery::pkg::util::intstr::IntOrString;
use kube::Resource;

use crate::api::{Egress, Leaderboard, names};

/// Where clouds hand out credentials of nodes and Pods: all link-local addresses, and AWS's own of IPv6.
const FORBIDDEN: [(&str, u8); 3] = [("169.254.0.0", 16), ("fe80::", 10), ("fd00:ec2::", 64)];
/// Where NodeLocal DNSCache answers.
const NODE_LOCAL_DNS: &str = "169.254.20.10/32";
const DNS_PORT: i32 = 53;

/// The policy for all Pods of a Leaderboard, named `leaderboard-<name>` and owned by it.
pub fn network_policy(leaderboard: &Leaderboard) -> NetworkPolicy {
    let name = leaderboard.metadata.name.clone().unwrap_or_default();
    let labels = |value: &str, key: &str| BTreeMap::from([(key.to_owned(), value.to_owned())]);
    NetworkPolicy {
        metadata: ObjectMeta {
            name: Some(format!("leaderboard-{name}")),
            namespace: leaderboard.metadata.namespace.clone(),
            labels: Some(
                [
                    labels(names::OPERATOR, names::LABEL_MANAGED_BY),
                    labels(&name, names::LABEL_LEADERBOARD),
                ]
                .into_iter()
                .flatten()
                .collect(),
            ),
            owner_references: Some(vec![OwnerReference {
                api_version: Leaderboard::api_version(&()).into_owned(),
                kind: Leaderboard::kind(&()).into_owned(),
                name: name.clone(),
                uid: leaderboard.metadata.uid.clone().unwrap_or_default(),
                controller: Some(true),
                block_owner_deletion: Some(true),
            }]),
            ..ObjectMeta::default()
        },
        spec: Some(NetworkPolicySpec {
            pod_selector: Some(LabelSelector {
                match_labels: Some(labels(&name, names::LABEL_LEADERBOARD)),
                match_expressions: None,
            }),
            policy_types: Some(vec!["Ingress".into(), "Egress".into()]),
            ingress: None,
            egress: Some(egress(leaderboard)),
        }),
    }
}

fn egress(leaderboard: &Leaderboard) -> Vec<NetworkPolicyEgressRule> {
    let network = &leaderboard.spec.network;
    network
        .dns
        .then(dns)
        .into_iter()
        .chain(network.egress.iter().filter_map(rule))
        .collect()
}

/// The cluster's DNS, wherever it runs: any Pod, or the node's cache.
fn dns() -> NetworkPolicyEgressRule {
    let pods = NetworkPolicyPeer {
        namespace_selector: Some(LabelSelector::default()),
        ..NetworkPolicyPeer::default()
    };
    NetworkPolicyEgressRule {
        to: Some(vec![pods, block(NODE_LOCAL_DNS.into(), Vec::new())]),
        ports: Some(["UDP", "TCP"].map(|protocol| port(protocol, DNS_PORT)).into()),
    }
}

fn rule(egress: &Egress) -> Option<NetworkPolicyEgressRule> {
    let range = Range::parse(&egress.cidr)?;
    let forbidden: Vec<Range> = FORBIDDEN
        .iter()
        .filter_map(|(address, bits)| Range::new(address.parse().ok()?, *bits))
        .collect();
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

/// A range of addresses. Both kinds are kept as 128 bits, the number left-aligned.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Range {
    v6: bool,
    start: u128,
    bits: u8,
}

impl Range {
    fn parse(text: &str) -> Option<Self> {
        let (address, bits) = text.split_once('/')?;
        Self::new(address.parse().ok()?, bits.parse().ok()?)
    }

    fn new(address: IpAddr, bits: u8) -> Option<Self> {
        let (v6, number, width) = match address {
            IpAddr::V4(address) => (false, u128::from(address.to_bits()) << 96, 32),
            IpAddr::V6(address) => (true, address.to_bits(), 128),
        };
        (bits <= width).then(|| Self {
            v6,
            start: number & mask(bits),
            bits,
        })
    }

    fn contains(self, other: Self) -> bool {
        self.v6 == other.v6 && self.bits <= other.bits && other.start & mask(self.bits) == self.start
    }

    fn text(self) -> String {
        let address = if self.v6 {
            IpAddr::V6(self.start.into())
        } else {
            IpAddr::V4(u32::try_from(self.start >> 96).unwrap_or_default().into())
        };
        format!("{address}/{}", self.bits)
    }
}

fn mask(bits: u8) -> u128 {
    u128::MAX.checked_shl(128 - u32::from(bits)).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn policy(network: &Value) -> Value {
        let leaderboard: Leaderboard = serde_json::from_value(json!({
            "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Leaderboard",
            "metadata": {"name": "carla-2", "namespace": "challenge", "uid": "u-1"},
            "spec": {
                "results": "V2", "tracks": [{"name": "sensors", "codename": "SENSORS"}],
                "contents": {"image": "contents"}, "simulator": {"image": "simulator"},
                "storage": {"bucket": "bucket"}, "network": network,
            },
        }))
        .unwrap();
        serde_json::to_value(network_policy(&leaderboard)).unwrap()
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
                "egress": [{
                    "to": [{"namespaceSelector": {}}, {"ipBlock": {"cidr": "169.254.20.10/32"}}],
                    "ports": [{"protocol": "UDP", "port": 53}, {"protocol": "TCP", "port": 53}],
                }],
            })
        );
    }

    #[test]
    fn without_dns_and_addresses_nothing_gets_out() {
        assert_eq!(policy(&json!({"dns": false}))["spec"]["egress"], json!([]));
    }

    #[test]
    fn ports_are_tcp_and_none_means_all() {
        let network =
            json!({"dns": false, "egress": [{"cidr": "10.1.2.3/16", "ports": [443, 4566]}, {"cidr": "192.0.2.0/24"}]});
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
        let cases: [(&str, Option<&[&str]>); 11] = [
            ("0.0.0.0/0", Some(&["169.254.0.0/16"])),
            ("128.0.0.0/1", Some(&["169.254.0.0/16"])),
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
            let egress = policy(&json!({"dns": false, "egress": [{"cidr": cidr}]}))["spec"]["egress"].clone();
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
    fn ranges_are_read_exactly() {
        for bad in [
            "",
            "10.0.0.0",
            "10.0.0.0/33",
            "::/129",
            "a/8",
            "10.0.0/8",
            "10.0.0.0/-1",
        ] {
            assert_eq!(Range::parse(bad), None, "{bad}");
        }
        for (text, expected) in [
            ("10.9.8.7/8", "10.0.0.0/8"),
            ("0.0.0.0/0", "0.0.0.0/0"),
            ("2001:DB8::1/32", "2001:db8::/32"),
            ("1.2.3.4/32", "1.2.3.4/32"),
        ] {
            assert_eq!(Range::parse(text).map(Range::text).as_deref(), Some(expected));
        }
    }
}
