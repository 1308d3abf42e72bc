//! The part of a Leaderboard's spec that defines what its Pods may reach.
//!
//! Owned by `api`; `leaderboard_parts` hands it on.

use kube::KubeSchema;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Who makes the NetworkPolicy of the Pods.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum PolicySource {
    /// The operator applies one and restores it; no Job is made without it.
    #[default]
    Managed,
    /// The cluster has policies of its own: the operator applies none and trusts them.
    External,
}

/// What follows from the measurement of a run's Pod, made before anything of a stranger runs: whether it can reach an
/// address that the policy forbids.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Enforcement {
    /// A Pod that can reach it stops there.
    Require,
    /// The run goes on, and the condition `Isolated` shows it.
    #[default]
    Warn,
    /// Nothing is measured.
    Disabled,
}

/// Who answers a Pod's questions for names.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Dns {
    /// The cluster's DNS, and the servers of `dnsServers`.
    #[default]
    Cluster,
    /// Nobody.
    None,
}

/// What the Pods of strangers may reach, by NetworkPolicy.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Debug, PartialEq, Eq)]
#[x_kube(
    validation = Rule::new("self.policy == 'Managed' || self.enforcement != 'Require'").message("network.enforcement Require needs network.policy Managed, since the operator does not know what the cluster's own policies forbid; use Managed, or Warn"),
    validation = Rule::new("!has(self.probe) || (isIP(self.probe.substring(0, self.probe.lastIndexOf(':')).replace('[', '').replace(']', '')) && int(self.probe.substring(self.probe.lastIndexOf(':') + 1)) > 0 && int(self.probe.substring(self.probe.lastIndexOf(':') + 1)) < 65536)").message("network.probe is not an address and port such as 192.0.2.1:443 or [2001:db8::1]:443"),
    validation = Rule::new("!has(self.dnsServers) || self.dnsServers.all(s, isIP(s) || isCIDR(s))").message("an entry of network.dnsServers is neither an address nor a range such as 10.0.0.10 or 10.0.0.0/24")
)]
#[serde(rename_all = "camelCase")]
pub struct Network {
    /// `Managed`: the operator applies and restores one NetworkPolicy, and creates no Job without it. `External`: the operator applies none; the cluster's own policies are trusted.
    #[serde(default)]
    pub policy: PolicySource,
    /// Consequence of a Pod's measurement that its NetworkPolicy is not enforced. `Require`: the run fails as NotIsolated. `Warn`: it goes on, and the condition Isolated shows it. `Disabled`: nothing is measured.
    #[serde(default)]
    pub enforcement: Enforcement,
    /// Address and port that the Pod connects to, to measure whether the policy is enforced, such as `10.0.0.1:443`. It must answer, and `egress` must not allow it: an address that never answers always looks enforced. Default: the API server's Service address. Set it where `egress` allows that one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(
        length(max = 64),
        regex(pattern = r"^([0-9]{1,3}([.][0-9]{1,3}){3}|\[[0-9A-Fa-f:.]+\]):[0-9]{1,5}$")
    )]
    pub probe: Option<String>,
    /// Addresses, S3's first of all: where policies are enforced, nothing can be stored without them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(length(max = 32))]
    pub egress: Vec<Egress>,
    /// `Cluster`: names are looked up at the cluster's DNS, which are the Pods `k8s-app=kube-dns` in `kube-system`, and at `dnsServers`. `None`: a Pod can look up no name; `podOverrides.spec.hostAliases` gives the addresses of S3, STS and CloudWatch Logs. A Pod keeps them until it ends, so use interface endpoints, whose addresses are fixed. `Ready` lists each of these names that no alias gives.
    #[serde(default)]
    pub dns: Dns,
    /// Further DNS servers, as addresses or ranges. Default: where NodeLocal DNSCache answers.
    #[serde(default = "defaults::dns_servers")]
    #[schemars(length(max = 8), inner(length(min = 1, max = 64)))]
    pub dns_servers: Vec<String>,
}

/// One range of addresses that Pods may reach.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Debug, PartialEq, Eq)]
#[x_kube(validation = Rule::new("isCIDR(self.cidr)").message("network.egress[].cidr is not a range of addresses such as 10.0.0.0/16"))]
pub struct Egress {
    /// A range such as `10.0.0.0/16`.
    #[schemars(length(min = 1, max = 64))]
    pub cidr: String,
    /// TCP ports; none means all.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(length(max = 32), inner(range(min = 1, max = 65535)))]
    pub ports: Vec<i32>,
}

impl Default for Network {
    fn default() -> Self {
        Self {
            policy: PolicySource::default(),
            enforcement: Enforcement::default(),
            probe: None,
            egress: Vec::new(),
            dns: Dns::default(),
            dns_servers: defaults::dns_servers(),
        }
    }
}

mod defaults {
    pub(super) fn dns_servers() -> Vec<String> {
        vec!["169.254.20.10".into()]
    }
}
