//! The variables, mounts and rights that each container of a built Job gets, and those that it must not get.

use serde_json::{Value, json};

use super::run_document;
use super::tests::{Case, OPERATOR_IMAGE, container, containers, role};
use leaderboard_api::{Attempt, names};
use leaderboard_contract::run::{ENV_ROLE_ARN, Run};

fn env<'a>(container: &'a Value, name: &str) -> Option<&'a Value> {
    container["env"]
        .as_array()?
        .iter()
        .find(|variable| variable["name"] == name)
}

fn value<'a>(container: &'a Value, name: &str) -> Option<&'a str> {
    env(container, name)?["value"].as_str()
}

fn is_own(container: &Value) -> bool {
    container["name"] == "workspace" || container["name"] == "logcopy"
}

/// `kubectl leaderboard logs --of start` shows them in the order of this list.
#[test]
#[expect(clippy::useless_vec, reason = "an array of Leaderboards is too large for the stack")]
fn the_init_containers_have_names_and_start_in_that_order() {
    let data = json!({"image": {"reference": "d"}});
    let case = |mode: &str| Case::container(json!({"mode": mode, "dataset": data, "labels": data}), &json!({}));
    let with_data = ["workspace", "dataset", "labels", "logcopy"];
    for (case, expected, first) in vec![
        (
            Case::new("V1", json!({})),
            ["workspace", "contents", "logcopy"].as_slice(),
            [].as_slice(),
        ),
        (Case::container(json!({}), &json!({})), &["workspace", "logcopy"], &[]),
        (case("Interactive"), &with_data, &[]),
        (case("Batch"), &with_data, &["agent-1", "collect"]),
        (case("Predictions"), &with_data, &[]),
    ] {
        let job = case.json();
        let init = job["spec"]["template"]["spec"]["initContainers"].as_array().unwrap();
        let found: Vec<&str> = init
            .iter()
            .map(|container| container["name"].as_str().unwrap())
            .collect();
        assert_eq!(found, [expected, first].concat());
        let mut all = names::INIT_CONTAINERS.into_iter();
        assert!(
            expected.iter().all(|name| all.any(|known| known == *name)),
            "{expected:?}"
        );
    }
}

#[test]
fn the_pairs_share_out_the_routes_of_the_plan() {
    let job = Case::new("V1", json!({"evaluation": {"carla": {"pairs": 3}}})).json();
    let expected = [
        ("0-6", "2000", "2010"),
        ("7-13", "2100", "2110"),
        ("14-19", "2200", "2210"),
    ];
    for (pair, (slice, port, traffic)) in (1..).zip(expected) {
        let agent = container(&job, &format!("agent-{pair}"));
        let simulator = container(&job, &format!("simulator-{pair}"));
        assert_eq!(value(agent, "ROUTES_SUBSET"), Some(slice));
        assert_eq!(value(agent, "CARLA_PORT"), Some(port));
        assert_eq!(value(simulator, "CARLA_PORT"), Some(port));
        assert_eq!(value(agent, "CARLA_TM_PORT"), Some(traffic));
        assert!(
            simulator["command"]
                .as_array()
                .unwrap()
                .contains(&json!(format!("--port={port}")))
        );
    }
    assert_eq!(
        job["spec"]["template"]["spec"]["containers"].as_array().unwrap().len(),
        6
    );
}

#[test]
fn resume_is_1_or_empty() {
    for (attempt, taken_up, expected) in [(1, false, ""), (1, true, "1"), (2, false, "1"), (2, true, "1")] {
        let mut case = Case::new("V2", json!({}));
        case.number.attempt = Attempt(attempt);
        case.plan.resume = taken_up;
        let job = case.json();
        assert_eq!(
            value(container(&job, "agent-2"), "RESUME"),
            Some(expected),
            "{attempt} {taken_up}"
        );
    }
}

#[test]
fn the_contents_get_what_the_old_pipelines_had_and_the_hosts_variables_win() {
    let of = |contents: Value, attempt: i64| {
        let mut case = Case::new("V2", json!({ "evaluation": {"carla": {"contents": contents}} }));
        case.number.attempt = Attempt(attempt);
        let run = case.plan.run_id.as_str().to_owned();
        let bucket = case.plan.storage.s3.bucket.clone();
        let container = container(&case.json(), "contents").clone();
        (container, run, bucket)
    };
    for (attempt, resume) in [(1, ""), (2, "1")] {
        let (contents, run, bucket) = of(json!({"image": "c"}), attempt);
        let expected = [
            ("SUBMISSION_ID", run.as_str()),
            ("RESUME", resume),
            ("S3_BUCKET", bucket.as_str()),
        ];
        for (name, text) in expected {
            assert_eq!(value(&contents, name), Some(text), "{name}");
        }
    }
    let own =
        json!([{"name": "S3_BUCKET", "value": "mine"}, {"name": "FROM", "value": "$(S3_BUCKET)/$(SUBMISSION_ID)"}]);
    let (contents, ..) = of(json!({"image": "c", "env": own}), 1);
    let names: Vec<_> = contents["env"]
        .as_array()
        .unwrap()
        .iter()
        .map(|v| v["name"].as_str().unwrap())
        .collect();
    assert!(
        names.ends_with(&["SUBMISSION_ID", "RESUME", "S3_BUCKET", "FROM"]),
        "{names:?}"
    );
    assert_eq!(value(&contents, "S3_BUCKET"), Some("mine"));
}

#[test]
fn a_track_brings_its_files_and_repetitions() {
    let track = json!({"name": "sensors", "carla": {"codename": "MAP", "routesFile": "/r/a.xml", "scenariosFile": "/r/b.json", "repetitions": 2}});
    let job = Case::new("V1", json!({"tracks": [track]})).json();
    let agent = container(&job, "agent-1");
    let expected = [
        ("ROUTES", "/r/a.xml"),
        ("SCENARIOS", "/r/b.json"),
        ("REPETITIONS", "2"),
        ("CHALLENGE_TRACK_CODENAME", "MAP"),
    ];
    for (name, expected) in expected {
        assert_eq!(value(agent, name), Some(expected));
    }
}

#[test]
fn a_track_that_was_taken_away_leaves_the_plan() {
    let mut case = Case::new("V1", json!({}));
    case.leaderboard.spec.tracks.clear();
    let job = case.json();
    assert_eq!(
        value(container(&job, "agent-1"), "CHALLENGE_TRACK_CODENAME"),
        Some("SENSORS")
    );
    assert_eq!(job, Case::new("V1", json!({})).json());
}

#[test]
fn only_our_own_containers_have_an_identity() {
    let identities = [
        json!({"podIdentity": role()}),
        json!({"podIdentity": {"secretName": "writer"}}),
        json!({}),
    ];
    for identity in identities {
        let job = Case::new("V2", identity.clone()).json();
        assert_eq!(job["spec"]["template"]["spec"]["automountServiceAccountToken"], false);
        for container in containers(&job) {
            let mounts = container["volumeMounts"].as_array().unwrap();
            let token = mounts.iter().any(|mount| mount["name"] == "identity");
            let env_of = container["env"].as_array().map(Vec::as_slice).unwrap_or_default();
            let identities = env_of.iter().filter(|variable| {
                let name = variable["name"].as_str().unwrap();
                name.starts_with("AWS_")
                    || name == ENV_ROLE_ARN
                    || variable.pointer("/valueFrom/secretKeyRef").is_some()
            });
            if is_own(container) {
                assert_eq!(
                    token,
                    identity["podIdentity"]["roleARN"].is_string(),
                    "{}",
                    container["name"]
                );
                assert_eq!(value(container, ENV_ROLE_ARN).is_some(), token);
                let secret = identity["podIdentity"]["secretName"].is_string();
                assert_eq!(env(container, "AWS_SECRET_ACCESS_KEY").is_some(), secret);
                assert_eq!(value(container, "AWS_REGION"), Some("eu-west-1"));
            } else {
                assert!(!token, "{}", container["name"]);
                assert_eq!(identities.count(), 0, "{}", container["name"]);
                assert!(mounts.iter().all(|mount| mount["name"] != "podinfo"));
                assert!(
                    mounts
                        .iter()
                        .all(|mount| mount["name"] != "logs" || mount["subPath"].is_string())
                );
            }
        }
    }
}

#[test]
fn the_controllers_setting_of_checksums_is_that_of_its_pods() {
    const NAME: &str = "AWS_REQUEST_CHECKSUM_CALCULATION";
    let mut case = Case::new("V2", json!({}));
    for setting in [None, Some("when_required")] {
        case.own.checksums = setting.map(str::to_owned);
        for container in containers(&case.json()) {
            assert_eq!(value(container, NAME), setting.filter(|_| is_own(container)));
        }
    }
    // A Leaderboard with another store has its own.
    let env = json!([{"name": NAME, "value": "when_supported"}]);
    let pod = json!({"spec": {"initContainers": [{"name": "logcopy", "env": env}]}});
    case.leaderboard.spec.pod_overrides = Some(pod);
    let job = case.json();
    let found = ["workspace", "logcopy"].map(|name| value(container(&job, name), NAME));
    assert_eq!(found, [Some("when_required"), Some("when_supported")]);
}

#[test]
fn eks_skips_every_container_of_a_stranger() {
    let pod = json!({"spec": {"initContainers": [{"name": "metrics", "image": "m", "restartPolicy": "Always"}]}});
    let job = Case::new(
        "V2",
        json!({"evaluation": {"carla": {"pairs": 2}}, "podOverrides": pod}),
    )
    .json();
    assert_eq!(
        job["spec"]["template"]["metadata"]["annotations"]["eks.amazonaws.com/skip-containers"],
        "contents,metrics,simulator-1,simulator-2,agent-1,agent-2"
    );
}

#[test]
fn secrets_are_named_and_never_written() {
    let job = Case::new("V2", json!({"podIdentity": {"secretName": "writer"}})).json();
    for name in ["workspace", "logcopy"] {
        let known = |key: &str| env(container(&job, name), key).unwrap().clone();
        for key in ["AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"] {
            assert_eq!(
                known(key),
                json!({"name": key, "valueFrom": {"secretKeyRef": {"name": "writer", "key": key}}})
            );
        }
        assert_eq!(
            known("AWS_SESSION_TOKEN")["valueFrom"]["secretKeyRef"]["optional"],
            true
        );
    }
    // The only references to Secrets, and no literal beside them.
    let text = job.to_string();
    assert_eq!(text.matches("secretKeyRef").count(), 6);
    assert!(!text.contains("evalai"));
}

#[test]
fn a_hostile_image_name_cannot_ask_kubernetes_for_a_secret() {
    let mut case = Case::new("V2", json!({"podIdentity": {"secretName": "writer"}}));
    case.plan.image = Some("x/$(AWS_SECRET_ACCESS_KEY)$$(AWS_SECRET_ACCESS_KEY)".into());
    let job = case.json();
    let written = value(container(&job, "logcopy"), "LEADERBOARD_RUN").unwrap();
    let handed_on = super::command_tests::kubernetes_expand(written, &|name| Some(format!("<{name}>")));
    let run: Run = serde_json::from_str(&handed_on).unwrap();
    assert_eq!(run, run_document(&case.input()));
    assert_eq!(run.plan.image, case.plan.image);
}

#[test]
fn the_run_document_is_the_plan_and_its_times() {
    let mut case = Case::new(
        "V2",
        json!({"syncPeriodSeconds": 5, "evaluation": {"carla": {"verify": "Refuse"}}, "logs": {"cloudWatch": {"name": "g"}}}),
    );
    case.number.attempt = Attempt(2);
    let run = run_document(&case.input());
    assert_eq!(
        (run.namespace.as_str(), run.submission.as_str(), run.uid.as_str()),
        ("challenge", "submission-4711", "submission-uid")
    );
    assert_eq!(
        (run.attempt, run.period_seconds, run.flush_seconds, run.cancel_seconds),
        (Attempt(2), 5, 1800, 120)
    );
    assert_eq!(run.plan, case.plan);
    assert_eq!(run.verify, leaderboard_api::Verify::Refuse);
    assert_eq!(run.log_group().unwrap().name, "g");
}

#[test]
fn status_folders_are_read_by_all_and_written_by_their_own() {
    let job = Case::new("V2", json!({})).json();
    for container in containers(&job)
        .into_iter()
        .filter(|container| container["command"][1] == "agent" || container["command"][1] == "simulator")
    {
        let name = container["name"].as_str().unwrap();
        let mounts = container["volumeMounts"].as_array().unwrap();
        let at = |path: &str| mounts.iter().position(|mount| mount["mountPath"] == path).unwrap();
        let (all, own) = (at("/tmp/status"), at(&format!("/tmp/status/{name}")));
        assert!(all < own);
        assert_eq!(
            mounts[all],
            json!({"name": "logs", "mountPath": "/tmp/status", "subPath": "containers-status", "readOnly": true})
        );
        assert_eq!(mounts[own]["subPath"], format!("containers-status/{name}"));
        assert_eq!(mounts[own].get("readOnly"), None);
        assert_eq!(mounts[at("/leaderboard-tools")]["readOnly"], true);
        if let Some(pair) = name.strip_prefix("agent-") {
            assert_eq!(mounts[at("/tmp/agent")]["subPath"], format!("agent/agent{pair}"));
            for contents in ["leaderboard", "scenario_runner", "CARLA"] {
                assert_eq!(mounts[at(&format!("/workspace/{contents}"))]["readOnly"], true);
            }
        } else {
            assert_eq!(mounts[at("/home/carla/CarlaUE4/Saved")]["subPath"], "simulator");
        }
    }
}

#[test]
fn logs_have_room_for_all_that_the_limits_allow() {
    let gib = 1_i64 << 30;
    let cases = [
        (json!({}), 20 + 4 * 2 + 1),
        (
            json!({"evaluation": {"carla": {"pairs": 1}}, "agent": {"logSizeLimit": "1Gi"}, "storage": {"s3": {"bucket": "results", "sizeLimit": "5Gi"}}}),
            5 + 1 + 1,
        ),
    ];
    for (more, expected) in cases {
        let job = Case::new("V2", more).json();
        let volumes = job["spec"]["template"]["spec"]["volumes"].as_array().unwrap().clone();
        let logs = volumes.iter().find(|volume| volume["name"] == "logs").unwrap();
        assert_eq!(logs["emptyDir"]["sizeLimit"], (expected * gib).to_string());
    }
}

#[test]
fn the_hosts_variables_win_but_not_over_the_plan() {
    let env = json!([{"name": "ROUTES_SUBSET", "value": "0-99"}, {"name": "NVIDIA_VISIBLE_DEVICES", "value": "all"}, {"name": "MINE", "value": "x"}]);
    let job = Case::new("V2", json!({"agent": {"env": env}})).json();
    let agent = container(&job, "agent-1");
    assert_eq!(value(agent, "ROUTES_SUBSET"), Some("0-4"));
    assert_eq!(value(agent, "NVIDIA_VISIBLE_DEVICES"), Some("all"));
    assert_eq!(value(agent, "MINE"), Some("x"));
    let names: Vec<&str> = agent["env"]
        .as_array()
        .unwrap()
        .iter()
        .map(|v| v["name"].as_str().unwrap())
        .collect();
    let mut unique = names.clone();
    unique.sort_unstable();
    unique.dedup();
    assert_eq!(names.len(), unique.len(), "{names:?}");
}

#[test]
fn the_pod_gets_what_to_measure_and_the_next_one_what_was_found() {
    let asked = |network: Value, found: Option<(&str, i64, &str)>| {
        let mut case = Case::new("V2", json!({ "network": network }));
        case.leaderboard.metadata.generation = Some(3);
        if let Some((reason, generation, since)) = found {
            let condition = json!({"type": "Isolated", "status": "False", "reason": reason, "message": "",
                                   "observedGeneration": generation, "lastTransitionTime": since});
            case.leaderboard.status = serde_json::from_value(json!({"conditions": [condition]})).unwrap();
        }
        let annotation = &case.json()["spec"]["template"]["metadata"]["annotations"][names::ANNOTATION_GENERATION];
        assert_eq!(annotation, "3");
        serde_json::to_value(run_document(&case.input()).isolation).unwrap()
    };
    assert_eq!(
        asked(json!({}), None),
        json!({"enforcement": "Warn", "isKnownOpen": false})
    );
    assert_eq!(
        asked(
            json!({"enforcement": "Require", "probe": "192.0.2.1:80", "egress": [{"cidr": "10.0.0.0/8"}]}),
            None
        ),
        json!({"enforcement": "Require", "probe": "192.0.2.1:80", "egress": ["10.0.0.0/8"], "isKnownOpen": false})
    );
    for unmeasured in [json!({"enforcement": "Disabled"}), json!({"policy": "External"})] {
        assert_eq!(asked(unmeasured, None), Value::Null);
    }
    // It is 12:00.
    let lately = "2026-11-01T11:30:00Z";
    for (enforcement, reason, generation, since, expected) in [
        ("Warn", "NotEnforced", 3, lately, true),
        ("Warn", "NotEnforced", 3, "2026-11-01T10:59:00Z", false),
        ("Warn", "NotEnforced", 2, lately, false),
        ("Warn", "Forbidden", 3, lately, false),
        ("Require", "NotEnforced", 3, lately, false),
    ] {
        let isolation = asked(json!({"enforcement": enforcement}), Some((reason, generation, since)));
        assert_eq!(
            isolation["isKnownOpen"], expected,
            "{enforcement} {reason} of {generation}"
        );
    }
}

#[test]
fn all_agents_of_a_pod_get_one_image_unless_the_host_has_nodes_ask_each_time() {
    let policies = |change: Value| -> Vec<String> {
        let job = Case::new("V2", change).json();
        let all = containers(&job).into_iter();
        let agents = all.filter(|container| container["name"].as_str().unwrap().starts_with("agent-"));
        agents
            .map(|agent| agent["imagePullPolicy"].as_str().unwrap().to_owned())
            .collect()
    };
    assert_eq!(policies(json!({})), ["IfNotPresent"; 4]);
    let always = json!({"podOverrides": {"spec": {"containers": [{"name": "agent", "imagePullPolicy": "Always"}]}}});
    assert_eq!(policies(always), ["Always"; 4]);
}

#[test]
fn our_own_image_has_the_pull_policy_and_region_of_the_operator() {
    let mut case = Case::new("V2", json!({}));
    case.own.pull_policy = Some("Always".into());
    case.own.region = Some("us-west-2".into());
    let job = case.json();
    for container in containers(&job) {
        let is_agent = container["name"].as_str().unwrap().starts_with("agent-");
        assert_eq!(
            container.get("imagePullPolicy").is_some(),
            is_own(container) || is_agent
        );
        if is_own(container) {
            assert_eq!(container["image"], OPERATOR_IMAGE);
            assert_eq!(value(container, "AWS_REGION"), Some("us-west-2"));
            assert_eq!(value(container, "AWS_EC2_METADATA_DISABLED"), Some("true"));
        }
    }
}

#[test]
fn each_agent_has_shared_memory_of_its_own_and_of_the_size_that_is_asked_for() {
    let job = Case::new(
        "V2",
        json!({"evaluation": {"carla": {"pairs": 2}}, "agent": {"shmSize": "2Gi"}}),
    )
    .json();
    let volumes = job["spec"]["template"]["spec"]["volumes"].as_array().unwrap();
    for pair in [1, 2] {
        let name = format!("shm-agent-{pair}");
        let volume = volumes.iter().find(|volume| volume["name"] == name).unwrap();
        let expected = json!({"name": name, "emptyDir": {"medium": "Memory", "sizeLimit": (2_u64 << 30).to_string()}});
        assert_eq!(*volume, expected);
        for container in containers(&job) {
            let mounts = container["volumeMounts"].as_array().unwrap();
            let mounted: Vec<_> = mounts.iter().filter(|mount| mount["name"] == name).collect();
            let expected = json!({"name": name, "mountPath": "/dev/shm"});
            let is_its_own = container["name"] == format!("agent-{pair}");
            assert_eq!(
                mounted,
                if is_its_own { vec![&expected] } else { vec![] },
                "{}",
                container["name"]
            );
        }
    }
    let without = Case::new("V2", json!({})).json();
    assert!(!without.to_string().contains("shm"));
}

#[test]
fn a_track_has_its_priority_and_a_host_may_let_karpenter_disrupt() {
    let track = json!({"name": "sensors", "carla": {"codename": "SENSORS"}, "priorityClassName": "sensors"});
    let overlay = json!({"metadata": {"annotations": {"karpenter.sh/do-not-disrupt": null}}});
    let job = Case::new("V2", json!({"tracks": [track], "podOverrides": overlay})).json();
    let template = &job["spec"]["template"];
    assert_eq!(template["spec"]["priorityClassName"], "sensors");
    assert_eq!(
        template["metadata"]["annotations"].get("karpenter.sh/do-not-disrupt"),
        None
    );
    let job = Case::new("V2", json!({})).json();
    let template = &job["spec"]["template"];
    assert_eq!(template["spec"].get("priorityClassName"), None);
    assert_eq!(
        template["metadata"]["annotations"]["karpenter.sh/do-not-disrupt"],
        "true"
    );
}
