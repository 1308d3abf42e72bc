//! Where a Pod is weaker than Pod Security's level `baseline`, as far as a host can make it so. Pure, and on the finished template.
//!
//! Called by the check of a Leaderboard, which shows it: the API server refuses such Pods only where the namespace enforces the level.
//! What an overlay may not say at all (the host's network, processes and shared memory) is not repeated here, nor what no valid Linux Pod
//! has (hostProcess; procMount without a user namespace). `tests/api/pod_security.rs` compares the list with the API server's own.

use std::collections::BTreeSet;

use serde_json::Value;

/// Capabilities that a container may add.
const CAPABILITIES: [&str; 13] = [
    "AUDIT_WRITE",
    "CHOWN",
    "DAC_OVERRIDE",
    "FOWNER",
    "FSETID",
    "KILL",
    "MKNOD",
    "NET_BIND_SERVICE",
    "SETFCAP",
    "SETGID",
    "SETPCAP",
    "SETUID",
    "SYS_CHROOT",
];
const SELINUX_TYPES: [&str; 4] = [
    "container_t",
    "container_init_t",
    "container_kvm_t",
    "container_engine_t",
];
/// Kernel parameters that a Pod may set: they belong to its own namespaces.
const SYSCTLS: [&str; 12] = [
    "kernel.shm_rmid_forced",
    "net.ipv4.ip_local_port_range",
    "net.ipv4.tcp_syncookies",
    "net.ipv4.ping_group_range",
    "net.ipv4.ip_unprivileged_port_start",
    "net.ipv4.ip_local_reserved_ports",
    "net.ipv4.tcp_keepalive_time",
    "net.ipv4.tcp_fin_timeout",
    "net.ipv4.tcp_keepalive_intvl",
    "net.ipv4.tcp_keepalive_probes",
    "net.ipv4.tcp_rmem",
    "net.ipv4.tcp_wmem",
];
/// Of the annotations by which AppArmor was chosen before it had a field.
const APPARMOR_ANNOTATION: &str = "container.apparmor.security.beta.kubernetes.io/";

/// Everything weaker, each as `agents: privileged`; the containers of all pairs have one name.
pub fn weaknesses(template: &Value) -> BTreeSet<String> {
    let pod = &template["spec"];
    let mut found: BTreeSet<String> = of_pod(pod).into_iter().map(|what| format!("Pod: {what}")).collect();
    let annotations = template["metadata"]["annotations"].as_object().into_iter().flatten();
    let unconfined = annotations.filter(|(key, profile)| key.starts_with(APPARMOR_ANNOTATION) && !is_apparmor(profile));
    found.extend(unconfined.map(|(key, _)| format!("Pod: annotation {key}")));
    for container in containers(pod) {
        let whose = whose(container);
        let weak = of_container(container).into_iter();
        found.extend(weak.map(|what| format!("{whose}: {what}")));
    }
    found
}

/// All containers of a Pod.
pub(in crate::controller) fn containers(pod: &Value) -> impl Iterator<Item = &Value> {
    let lists = ["initContainers", "containers"].map(|list| pod[list].as_array());
    lists.into_iter().flatten().flatten()
}

fn whose(container: &Value) -> &str {
    match container["name"].as_str().unwrap_or_default() {
        name if name.starts_with("agent-") => "agents",
        name if name.starts_with("simulator-") => "simulators",
        name => name,
    }
}

fn of_pod(pod: &Value) -> Vec<String> {
    let volumes = pod["volumes"].as_array().into_iter().flatten();
    let paths = volumes.filter_map(|volume| volume["hostPath"]["path"].as_str());
    let context = &pod["securityContext"];
    let sysctls = context["sysctls"].as_array().into_iter().flatten();
    let sysctls = sysctls.filter_map(|sysctl| sysctl["name"].as_str());
    paths
        .map(|path| format!("hostPath {path}"))
        .chain(
            sysctls
                .filter(|name| !SYSCTLS.contains(name))
                .map(|name| format!("sysctl {name}")),
        )
        .chain(of_either(context))
        .collect()
}

fn of_container(container: &Value) -> Vec<String> {
    let context = &container["securityContext"];
    let privileged = (context["privileged"] == true).then(|| "privileged".to_owned());
    let added = context["capabilities"]["add"].as_array().into_iter().flatten();
    let added = added
        .filter_map(Value::as_str)
        .filter(|name| !CAPABILITIES.contains(name));
    let ports = container["ports"].as_array().into_iter().flatten();
    let ports = ports
        .filter_map(|port| port["hostPort"].as_u64())
        .filter(|port| *port != 0);
    privileged
        .into_iter()
        .chain(added.map(|name| format!("capability {name}")))
        .chain(ports.map(|port| format!("hostPort {port}")))
        .chain(probed_hosts(container))
        .chain(of_either(context))
        .collect()
}

/// What a Pod's security context and a container's have in common.
fn of_either(context: &Value) -> Vec<String> {
    let mut found = Vec::new();
    if context["seccompProfile"]["type"] == "Unconfined" {
        found.push("seccompProfile Unconfined".to_owned());
    }
    if context["appArmorProfile"]["type"] == "Unconfined" {
        found.push("appArmorProfile Unconfined".to_owned());
    }
    for field in ["type", "user", "role"] {
        let label = context["seLinuxOptions"][field].as_str().unwrap_or_default();
        let is_usual = label.is_empty() || (field == "type" && SELINUX_TYPES.contains(&label));
        if !is_usual {
            found.push(format!("seLinuxOptions {field} {label}"));
        }
    }
    found
}

/// Addresses that the kubelet would be made to connect to, from the node.
fn probed_hosts(container: &Value) -> Vec<String> {
    let probes = ["livenessProbe", "readinessProbe", "startupProbe"].map(|probe| &container[probe]);
    let hooks = ["postStart", "preStop"].map(|hook| &container["lifecycle"][hook]);
    let handlers = probes.into_iter().chain(hooks);
    let hosts = handlers.flat_map(|handler| ["httpGet", "tcpSocket"].map(|kind| handler[kind]["host"].as_str()));
    let hosts = hosts.flatten().filter(|host| !host.is_empty());
    hosts.map(|host| format!("probe of host {host}")).collect()
}

fn is_apparmor(profile: &Value) -> bool {
    let profile = profile.as_str().unwrap_or_default();
    profile.is_empty() || profile == "runtime/default" || profile.starts_with("localhost/")
}
