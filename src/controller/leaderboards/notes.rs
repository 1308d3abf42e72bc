//! What the Pods of a Leaderboard may do that those of strangers should not: said in `Ready`, never refused, since the host decides. Pure.

use k8s_openapi::api::core::v1::{Capabilities, EnvVar, SecurityContext};
use serde_json::Value;

use leaderboard_api::LeaderboardSpec;

/// A sentence for each weakness, with the next step.
pub(super) fn weaknesses(spec: &LeaderboardSpec) -> Vec<String> {
    let mut notes = Vec::new();
    let secrets = secrets(&spec.agent.env);
    if !secrets.is_empty() {
        notes.push(format!(
            "Participants can read what agent.env takes from Secrets ({}); remove it unless it is meant for them.",
            secrets.join(", ")
        ));
    }
    let powers = powers(spec);
    if !powers.is_empty() {
        notes.push(format!(
            "A participant's code can leave its Pod: {}; remove it, or give the Leaderboard nodes of its own.",
            powers.join(", ")
        ));
    }
    notes
}

/// Variables of an agent that come from Secrets.
fn secrets(env: &[EnvVar]) -> Vec<&str> {
    let is_secret = |variable: &&EnvVar| {
        let source = variable.value_from.as_ref();
        source.is_some_and(|source| source.secret_key_ref.is_some())
    };
    env.iter()
        .filter(is_secret)
        .map(|variable| variable.name.as_str())
        .collect()
}

/// What lifts the walls around an agent. A simulator runs the host's own image.
fn powers(spec: &LeaderboardSpec) -> Vec<String> {
    let mut powers = of_context("agent.securityContext", spec.agent.security_context.as_ref());
    let Some(pod) = spec.pod_overrides.as_ref().and_then(|overrides| overrides.get("spec")) else {
        return powers;
    };
    if pod["hostIPC"] == Value::Bool(true) {
        powers.push("podOverrides.spec.hostIPC".into());
    }
    for container in list(&pod["containers"]) {
        let name = container["name"].as_str().unwrap_or_default();
        if name != "agent" && !name.starts_with("agent-") {
            continue;
        }
        let context = serde_json::from_value(container["securityContext"].clone())
            .ok()
            .flatten();
        powers.extend(of_context(
            &format!("securityContext of {name} in podOverrides"),
            context.as_ref(),
        ));
        powers.extend(host_paths(pod, container, name));
    }
    powers
}

fn of_context(place: &str, context: Option<&SecurityContext>) -> Vec<String> {
    let Some(context) = context else { return Vec::new() };
    let mut powers = Vec::new();
    if context.privileged == Some(true) {
        powers.push(format!("privileged in {place}"));
    }
    let added = |capabilities: &Capabilities| capabilities.add.clone().unwrap_or_default();
    let added = context.capabilities.as_ref().map(added).unwrap_or_default();
    if !added.is_empty() {
        powers.push(format!("{} in {place}", added.join(" and ")));
    }
    powers
}

/// Folders of the node that an agent gets.
fn host_paths<'a>(pod: &'a Value, container: &'a Value, name: &'a str) -> impl Iterator<Item = String> + 'a {
    let mounted = move |volume: &&Value| {
        list(&container["volumeMounts"])
            .iter()
            .any(|mount| mount["name"] == volume["name"])
    };
    let of_node = list(&pod["volumes"]).iter().filter(mounted);
    let paths = of_node.filter_map(|volume| volume["hostPath"]["path"].as_str());
    paths.map(move |path| format!("the node's {path} in {name}"))
}

fn list(value: &Value) -> &[Value] {
    value.as_array().map_or(&[], Vec::as_slice)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn notes(more: &Value) -> Vec<String> {
        let mut spec = json!({
            "leaderboardVersion": "V2", "tracks": [{"name": "sensors", "codename": "SENSORS"}],
            "contents": {"image": "contents"}, "simulator": {"image": "simulator"}, "storage": {"bucket": "bucket"},
        });
        for (key, value) in more.as_object().unwrap() {
            spec[key] = value.clone();
        }
        weaknesses(&serde_json::from_value(spec).unwrap())
    }

    #[test]
    fn what_is_usual_is_not_said() {
        let usual = json!({
            "agent": {
                "env": [{"name": "A", "value": "1"}, {"name": "NODE", "valueFrom": {"fieldRef": {"fieldPath": "spec.nodeName"}}}],
                "securityContext": {"runAsUser": 1000, "capabilities": {"drop": ["ALL"]}},
            },
            "simulator": {"image": "simulator", "securityContext": {"privileged": true}},
            "podOverrides": {"spec": {
                "hostIPC": false,
                "volumes": [{"name": "x11", "hostPath": {"path": "/tmp/.X11-unix"}}],
                "containers": [{"name": "simulator", "volumeMounts": [{"name": "x11", "mountPath": "/tmp/.X11-unix"}]}, {"name": "agent"}],
            }},
        });
        assert_eq!(notes(&usual), Vec::<String>::new());
        assert_eq!(notes(&json!({})), Vec::<String>::new());
    }

    #[test]
    fn a_secret_of_an_agent_is_said() {
        let source = json!({"secretKeyRef": {"name": "keys", "key": "key"}});
        let said = notes(&json!({"agent": {"env": [{"name": "LICENCE", "valueFrom": source}]}}));
        assert_eq!(
            said,
            [
                "Participants can read what agent.env takes from Secrets (LICENCE); remove it unless it is meant for them."
            ]
        );
    }

    #[test]
    fn what_opens_an_agents_pod_is_said() {
        let agent = |context: Value| json!({"agent": {"securityContext": context}});
        let overrides = |pod: Value| json!({"podOverrides": {"spec": pod}});
        let with_context =
            |name: &str| json!({"containers": [{"name": name, "securityContext": {"privileged": true}}]});
        let node = json!({
            "volumes": [{"name": "etc", "hostPath": {"path": "/etc"}}, {"name": "var", "hostPath": {"path": "/var"}}],
            "containers": [{"name": "agent-2", "volumeMounts": [{"name": "etc", "mountPath": "/node"}]}],
        });
        let cases = [
            (
                agent(json!({"privileged": true})),
                "privileged in agent.securityContext",
            ),
            (
                agent(json!({"capabilities": {"add": ["NET_ADMIN", "SYS_ADMIN"]}})),
                "NET_ADMIN and SYS_ADMIN in agent.securityContext",
            ),
            (overrides(json!({"hostIPC": true})), "podOverrides.spec.hostIPC"),
            (
                overrides(with_context("agent")),
                "privileged in securityContext of agent in podOverrides",
            ),
            (
                overrides(with_context("agent-1")),
                "privileged in securityContext of agent-1 in podOverrides",
            ),
            (overrides(node), "the node's /etc in agent-2"),
        ];
        for (spec, expected) in cases {
            let said = notes(&spec);
            let expected = format!(
                "A participant's code can leave its Pod: {expected}; remove it, or give the Leaderboard nodes of its own."
            );
            assert_eq!(said, [expected]);
        }
    }
}
