//! Warnings about the Pods of a Leaderboard that can be made all the same: shown in `Ready`, which stays True.
//!
//! Pure, on the Pods as they are created, so that every way to say a thing is covered: fields, tracks, `podOverrides`.

use std::collections::BTreeSet;
use std::net::IpAddr;

use serde_json::Value;

use leaderboard_api::{AgentContainer, Agents, LeaderboardSpec, names};

/// Pods of one track.
pub struct TrackPods {
    pub track: String,
    pub template: Value,
}

/// One sentence or two for each thing.
pub fn notes(tracks: &[TrackPods]) -> Vec<String> {
    [secrets(tracks), unbounded(tracks), ros(tracks)]
        .into_iter()
        .flatten()
        .collect()
}

fn secrets(tracks: &[TrackPods]) -> Option<String> {
    let found = tracks.iter().flat_map(|pods| of_agents(&pods.template["spec"]));
    let secrets = counted("Secret", found.collect::<BTreeSet<_>>().into_iter())?;
    Some(format!(
        "Agents can read {secrets}: what a participant's program can read, it can print and send; remove the reference from agent.env or \
         podOverrides."
    ))
}

/// Names of the Secrets that agents get as variables or files.
fn of_agents(pod: &Value) -> Vec<String> {
    let mut found = Vec::new();
    for agent in agents(pod) {
        for variable in list(agent, "env") {
            found.extend(name(&variable["valueFrom"]["secretKeyRef"]["name"]));
        }
        for source in list(agent, "envFrom") {
            found.extend(name(&source["secretRef"]["name"]));
        }
        for mount in list(agent, "volumeMounts").chain(list(agent, "volumeDevices")) {
            let volumes = list(pod, "volumes").filter(|volume| volume["name"] == mount["name"]);
            found.extend(volumes.flat_map(of_volume));
        }
    }
    found
}

fn of_volume(volume: &Value) -> Vec<String> {
    let projected = list(&volume["projected"], "sources");
    let projected = projected.filter_map(|source| name(&source["secret"]["name"]));
    name(&volume["secret"]["secretName"])
        .into_iter()
        .chain(projected)
        .collect()
}

fn unbounded(tracks: &[TrackPods]) -> Option<String> {
    let has_none = |pods: &&TrackPods| {
        agents(&pods.template["spec"]).any(|agent| agent["resources"]["limits"]["memory"].is_null())
    };
    let named = tracks.iter().filter(has_none).map(|pods| pods.track.clone());
    let tracks = counted("track", named)?;
    Some(format!(
        "Unbounded: agents of the {tracks} have no memory limit, so that one agent can use up its node's memory and end what else runs \
         there; set agent.resources.limits.memory."
    ))
}

/// Several ROS agents in one Pod meet on its network.
fn ros(tracks: &[TrackPods]) -> Option<String> {
    let meet = |pods: &&TrackPods| agents(&pods.template["spec"]).nth(1).is_some() && names_ros(pods);
    let named = tracks.iter().filter(meet).map(|pods| pods.track.clone());
    let tracks = counted("track", named)?;
    Some(format!(
        "ROS: all workers of a Pod share its network, so the agents of the {tracks} meet on one ROS1 master (11311), one rosbridge \
         (9090) and ROS2's default domain; give each track of ROS agents one worker."
    ))
}

/// A track's name or a variable of its agents, the codename among them, has the word.
fn names_ros(pods: &TrackPods) -> bool {
    let variables = agents(&pods.template["spec"]).flat_map(|agent| list(agent, "env"));
    let texts = variables.flat_map(|variable| [&variable["name"], &variable["value"]].map(Value::as_str));
    texts.flatten().chain([pods.track.as_str()]).any(has_ros)
}

fn has_ros(text: &str) -> bool {
    let mut words = text.split(|letter: char| !letter.is_ascii_alphanumeric());
    words.any(|word| ["ros", "ros1", "ros2"].contains(&word.to_ascii_lowercase().as_str()))
}

/// Names of services that Pods without a resolver need and that no alias gives. An error is the reason why a name is not known.
pub fn unnamed(tracks: &[TrackPods], hosts: Result<Vec<String>, String>) -> Option<String> {
    let hosts = match hosts {
        Ok(hosts) => hosts,
        Err(why) => {
            return Some(format!(
                "With network.dns None, {why}; correct storage, logs or the region."
            ));
        }
    };
    let gives = |pods: &TrackPods, host: &str| {
        let mut names = list(&pods.template["spec"], "hostAliases").flat_map(|alias| list(alias, "hostnames"));
        names.any(|name| name.as_str().is_some_and(|name| name.eq_ignore_ascii_case(host)))
    };
    let is_missing = |host: &String| host.parse::<IpAddr>().is_err() && tracks.iter().any(|pods| !gives(pods, host));
    let missing: BTreeSet<String> = hosts.into_iter().filter(is_missing).collect();
    (!missing.is_empty()).then(|| {
        format!(
            "Unnamed: network.dns is None, and no entry of podOverrides.spec.hostAliases gives the address of {}; no result can be stored \
             without it.",
            missing.into_iter().collect::<Vec<_>>().join(", ")
        )
    })
}

/// Settings of agents where none runs.
pub fn unused(spec: &LeaderboardSpec) -> Option<String> {
    let has_agents = leaderboard_evaluation::of(spec).agents() != Agents::Absent;
    let is_set = spec.agent != AgentContainer::default() || spec.tracks.iter().any(|track| track.agent.is_some());
    (is_set && !has_agents).then(|| {
        "Unused: no image is submitted to this Leaderboard, so that agent and tracks[].agent have no effect; leave them out.".to_owned()
    })
}

fn agents(pod: &Value) -> impl Iterator<Item = &Value> {
    let lists = ["initContainers", "containers"].map(|field| list(pod, field));
    lists.into_iter().flatten().filter(|container| {
        let name = container["name"].as_str();
        name.is_some_and(names::is_agent_container)
    })
}

fn list<'a>(object: &'a Value, field: &str) -> impl Iterator<Item = &'a Value> + use<'a> {
    object[field].as_array().into_iter().flatten()
}

fn name(value: &Value) -> Option<String> {
    value.as_str().map(ToOwned::to_owned)
}

/// The names behind the word for one of them or several.
fn counted(one: &str, names: impl Iterator<Item = String>) -> Option<String> {
    let names: Vec<String> = names.collect();
    let plural = if names.len() > 1 { "s" } else { "" };
    (!names.is_empty()).then(|| format!("{one}{plural} {}", names.join(", ")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    /// A Pod whose agents have `more`, and these volumes.
    fn pods(track: &str, more: Value, volumes: &Value) -> TrackPods {
        let mut agent = more;
        agent["name"] = "agent-1".into();
        let simulator = json!({"name": "simulator-1", "envFrom": [{"secretRef": {"name": "of-the-host"}}]});
        TrackPods {
            track: track.to_owned(),
            template: json!({"spec": {"containers": [simulator, agent], "volumes": volumes}}),
        }
    }

    fn limited() -> Value {
        json!({"resources": {"limits": {"memory": "8Gi"}}})
    }

    fn with(field: &str, value: Value) -> Value {
        let mut agent = limited();
        agent[field] = value;
        agent
    }

    #[test]
    fn pods_that_give_nothing_away_have_no_note() {
        assert!(notes(&[pods("sensors", limited(), &json!([]))]).is_empty());
        assert!(notes(&[]).is_empty());
    }

    #[test]
    fn tracks_whose_agents_have_no_memory_limit_are_named() {
        let unlimited = || json!({"resources": {"requests": {"memory": "1Gi"}, "limits": {"cpu": "1"}}});
        let all = [
            pods("sensors", unlimited(), &json!([])),
            pods("map", limited(), &json!([])),
            pods("mapless", json!({}), &json!([])),
        ];
        let found = notes(&all);
        assert_eq!(found.len(), 1);
        let expected = "Unbounded: agents of the tracks sensors, mapless have no memory limit";
        assert!(found[0].starts_with(expected), "{found:?}");
    }

    #[test]
    fn a_secret_that_agents_can_read_is_named_once() {
        let mount = || json!([{"name": "v", "mountPath": "/v"}]);
        let variable = json!([{"name": "A", "valueFrom": {"secretKeyRef": {"name": "key", "key": "k"}}}]);
        let projected = json!([{"name": "v", "projected": {"sources": [{"secret": {"name": "key"}}, {"configMap": {"name": "c"}}]}}]);
        for (agent, volumes) in [
            (with("env", variable), json!([])),
            (with("envFrom", json!([{"secretRef": {"name": "key"}}])), json!([])),
            (
                with("volumeMounts", mount()),
                json!([{"name": "v", "secret": {"secretName": "key"}}]),
            ),
            (with("volumeMounts", mount()), projected),
        ] {
            let found = notes(&[pods("a", agent.clone(), &volumes), pods("b", agent, &volumes)]);
            assert_eq!(found.len(), 1);
            assert!(found[0].starts_with("Agents can read Secret key: "), "{found:?}");
        }
        // A Secret that no container mounts, and a volume that is no Secret.
        let volumes = json!([{"name": "w", "secret": {"secretName": "key"}}, {"name": "v", "emptyDir": {}}]);
        assert!(notes(&[pods("a", with("volumeMounts", mount()), &volumes)]).is_empty());
    }

    /// A track whose Pod has two agents with this variable.
    fn two_pairs(track: &str, name: &str, value: &str) -> TrackPods {
        let agent = |pair| {
            let mut agent = with("env", json!([{"name": name, "value": value}]));
            agent["name"] = format!("agent-{pair}").into();
            agent
        };
        let template = json!({"spec": {"containers": [agent(1), agent(2)]}});
        let track = track.to_owned();
        TrackPods { track, template }
    }

    #[test]
    fn tracks_of_several_pairs_that_say_ros_are_named() {
        for (track, name, value, has_note) in [
            ("sensors", "ROS_DOMAIN_ID", "3", true),
            ("sensors", "SETUP", "/opt/ros/humble/setup.bash", true),
            ("sensors", "CHALLENGE_TRACK_CODENAME", "SENSORS_ROS2", true),
            ("map-ros", "CHALLENGE_TRACK_CODENAME", "MAP", true),
            ("sensors", "PROSE", "across", false),
            ("sensors", "CHALLENGE_TRACK_CODENAME", "MICROSERVICE", false),
        ] {
            let found = notes(&[two_pairs(track, name, value)]);
            assert_eq!(found.len(), usize::from(has_note), "{track} {name}={value}: {found:?}");
            let expected = format!("the agents of the track {track} meet on one ROS1 master (11311)");
            assert!(found.iter().all(|note| note.contains(&expected)), "{found:?}");
        }
        // One agent alone in its Pod meets no other.
        let alone = with("env", json!([{"name": "ROS_DISTRO", "value": "humble"}]));
        assert!(notes(&[pods("sensors", alone, &json!([]))]).is_empty());
    }

    /// An agent that runs first is an init container.
    #[test]
    fn agents_are_found_wherever_the_pod_has_them() {
        let agent = json!({"name": "agent-1", "envFrom": [{"secretRef": {"name": "key"}}]});
        let template = json!({"spec": {"initContainers": [agent], "containers": [{"name": "evaluator-1"}]}});
        let found = notes(&[TrackPods {
            track: "test".to_owned(),
            template,
        }]);
        let starts = ["Agents can read Secret key", "Unbounded: agents of the track test"];
        assert_eq!(found.len(), starts.len(), "{found:?}");
        assert!(
            found.iter().zip(starts).all(|(note, start)| note.starts_with(start)),
            "{found:?}"
        );
    }

    #[test]
    fn settings_of_agents_are_named_where_none_runs() {
        let spec = |mode: &str, agent: &Value, own: &Value| -> LeaderboardSpec {
            let spec = json!({
                "evaluation": {"container": {"mode": mode, "image": "e", "command": ["/e"]}}, "agent": agent,
                "tracks": [{"name": "t", "container": {"score": {"metric": "m"}}, "agent": own}],
                "storage": {"s3": {"bucket": "bucket"}},
            });
            serde_json::from_value(spec).unwrap()
        };
        let (none, command, resources) = (json!({}), json!({"command": ["/a"]}), json!({"resources": {}}));
        for (mode, agent, own, has_note) in [
            ("Predictions", &none, &Value::Null, false),
            ("Predictions", &command, &Value::Null, true),
            ("Predictions", &none, &resources, true),
            ("Batch", &command, &resources, false),
        ] {
            assert_eq!(
                unused(&spec(mode, agent, own)).is_some(),
                has_note,
                "{mode} {agent} {own}"
            );
        }
    }

    #[test]
    fn a_name_that_no_alias_gives_is_listed_where_pods_have_no_resolver() {
        let named = |names: Value| TrackPods {
            track: "sensors".to_owned(),
            template: json!({"spec": {"hostAliases": [{"ip": "10.0.4.10", "hostnames": names}]}}),
        };
        let hosts = || {
            Ok(["b.s3.amazonaws.com", "sts.amazonaws.com", "10.0.0.5"]
                .map(str::to_owned)
                .to_vec())
        };
        let both = named(json!(["B.s3.amazonaws.com", "sts.amazonaws.com"]));
        assert_eq!(unnamed(&[both], hosts()), None);
        let found = unnamed(&[named(json!(["b.s3.amazonaws.com"]))], hosts()).unwrap();
        assert!(found.contains("gives the address of sts.amazonaws.com; "), "{found}");
        let found = unnamed(&[], hosts());
        assert_eq!(found, None, "without a track there is no Pod");
        let found = unnamed(&[], Err("the endpoint of S3 is not known".to_owned())).unwrap();
        assert!(
            found.starts_with("With network.dns None, the endpoint of S3 is not known; "),
            "{found}"
        );
    }
}
