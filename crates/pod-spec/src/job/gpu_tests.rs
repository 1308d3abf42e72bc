//! The GPUs and the screen that each container of a built Job gets from its node, mode by mode.

use serde_json::{Value, json};

use super::tests::{Case, container, containers};
use super::unclear;

const GPU: &str = "nvidia.com/gpu";
const DEVICES: &str = "NVIDIA_VISIBLE_DEVICES";
const INDEX: &str = "LEADERBOARD_GPU_INDEX";

fn variable<'a>(container: &'a Value, name: &str) -> Option<&'a str> {
    let mut env = container["env"].as_array()?.iter();
    env.find(|variable| variable["name"] == name)?["value"].as_str()
}

fn words(container: &Value) -> Vec<&str> {
    let words = container["command"].as_array().unwrap();
    words.iter().map(|word| word.as_str().unwrap()).collect()
}

/// GPU settings of a container: devices by variable, capabilities, index, its request, its claims.
#[derive(Debug, PartialEq, Eq)]
struct Given<'a> {
    devices: Option<&'a str>,
    capabilities: Option<&'a str>,
    index: Option<&'a str>,
    requested: Option<&'a str>,
    claims: Value,
}

fn given(container: &Value) -> Given<'_> {
    Given {
        devices: variable(container, DEVICES),
        capabilities: variable(container, "NVIDIA_DRIVER_CAPABILITIES"),
        index: variable(container, INDEX),
        requested: container["resources"]["limits"][GPU].as_str(),
        claims: container["resources"]["claims"].clone(),
    }
}

const NOTHING: Given<'_> = Given {
    devices: Some("void"),
    capabilities: None,
    index: None,
    requested: None,
    claims: Value::Null,
};
/// With every mode but None: the variables of a simulator of pair 2 and of its agent.
const SIMULATOR: Given<'_> = Given {
    devices: None,
    capabilities: Some("all"),
    index: Some("1"),
    requested: None,
    claims: Value::Null,
};

/// The mode, and what simulator 2 and agent 2 get.
fn modes() -> Vec<(Value, Given<'static>, Given<'static>)> {
    let requests = |given| Given {
        requested: Some("1"),
        ..given
    };
    let sees = |devices, given| Given {
        devices: Some(devices),
        ..given
    };
    let claims = |given| Given {
        claims: json!([{"name": "gpu-2"}]),
        ..sees("void", given)
    };
    let agent = || Given {
        index: None,
        ..SIMULATOR
    };
    let per_container = || (requests(SIMULATOR), requests(agent()));
    let (simulator, companion) = per_container();
    let (same_simulator, same_agent) = per_container();
    vec![
        (json!(null), NOTHING, NOTHING),
        (json!({}), NOTHING, NOTHING),
        (json!({"mode": "None"}), NOTHING, NOTHING),
        (json!({"resourceName": GPU}), simulator, companion),
        (
            json!({"mode": "PerContainer", "resourceName": GPU}),
            same_simulator,
            same_agent,
        ),
        (
            json!({"mode": "NodeIndex", "resourceName": GPU}),
            sees("1", requests(SIMULATOR)),
            sees("1", agent()),
        ),
        (
            json!({"mode": "Claim", "claim": {"deviceClassName": "gpu.nvidia.com"}}),
            claims(SIMULATOR),
            claims(agent()),
        ),
        (
            json!({"mode": "Claim", "claim": {"resourceClaimTemplateName": "t"}}),
            claims(SIMULATOR),
            claims(agent()),
        ),
    ]
}

#[test]
fn each_mode_gives_a_pair_its_gpu_and_nobody_else_any() {
    let metrics = json!({"name": "metrics", "image": "m", "restartPolicy": "Always"});
    let overlay = json!({"spec": {"initContainers": [metrics]}});
    for (gpu, simulator, agent) in modes() {
        let limits = json!({"limits": {"memory": "8Gi"}});
        let more = json!({"gpu": gpu, "agent": {"resources": limits}, "podOverrides": overlay});
        let job = Case::new("V2", more).json();
        assert_eq!(given(container(&job, "simulator-2")), simulator, "{gpu}");
        assert_eq!(given(container(&job, "agent-2")), agent, "{gpu}");
        assert_eq!(container(&job, "agent-2")["resources"]["limits"]["memory"], "8Gi");
        for other in ["contents", "workspace", "logcopy", "metrics"] {
            assert_eq!(given(container(&job, other)), NOTHING, "{other} {gpu}");
        }
    }
}

#[test]
fn an_evaluator_and_its_agent_have_what_a_simulator_and_its_agent_have() {
    for (gpu, evaluator, agent) in modes() {
        let job = Case::container(json!({"workers": 2}), &json!({"gpu": gpu})).json();
        let runner = words(container(&job, "evaluator-2"));
        assert_eq!(given(container(&job, "evaluator-2")), evaluator, "{gpu}");
        assert_eq!(given(container(&job, "agent-2")), agent, "{gpu}");
        // GPUs of an evaluator may be of any maker, and the runner knows NVIDIA's alone.
        assert!(
            !runner.iter().any(|word| word.starts_with("--gpu=")),
            "{gpu}: {runner:?}"
        );
        assert_eq!(
            runner.contains(&"--agent-gpu=true"),
            gpu["mode"] == "NodeIndex",
            "{gpu}: {runner:?}"
        );
    }
    let limits = json!({"limits": {GPU: "1"}});
    let case = Case::container(json!({"resources": limits}), &json!({}));
    let found = unclear(&case.leaderboard.spec, &case.json()["spec"]["template"]).unwrap();
    assert!(
        found.contains("what the other container of the worker is to have"),
        "{found}"
    );
}

#[test]
fn each_pair_has_a_claim_of_its_own_from_one_template() {
    for (claim, template) in [
        (json!({"resourceClaimTemplateName": "mine"}), "mine"),
        (json!({"deviceClassName": "gpu.nvidia.com"}), "carla-gpu-"),
    ] {
        let job = Case::new(
            "V2",
            json!({"evaluation": {"carla": {"pairs": 3}}, "gpu": {"mode": "Claim", "claim": claim}}),
        )
        .json();
        let claims = job["spec"]["template"]["spec"]["resourceClaims"]
            .as_array()
            .unwrap()
            .clone();
        let names: Vec<&str> = claims.iter().map(|claim| claim["name"].as_str().unwrap()).collect();
        assert_eq!(names, ["gpu-1", "gpu-2", "gpu-3"]);
        for claim in &claims {
            let name = claim["resourceClaimTemplateName"].as_str().unwrap();
            assert!(name.starts_with(template), "{name}");
        }
    }
    let job = Case::new("V2", json!({"gpu": {"resourceName": GPU}})).json();
    assert_eq!(job["spec"]["template"]["spec"].get("resourceClaims"), None);
}

#[test]
fn the_resources_of_a_track_get_the_gpu_too() {
    let track = json!({"name": "sensors", "agent": {"resources": {"limits": {"memory": "1Gi"}}}});
    let job = Case::new("V2", json!({"tracks": [track]})).json();
    let limits = json!({"memory": "1Gi", GPU: "1", "ephemeral-storage": "20Gi"});
    assert_eq!(container(&job, "agent-1")["resources"]["limits"], limits);
}

#[test]
fn what_is_not_nvidias_is_not_hidden_from_those_that_request_it() {
    let job = Case::new("V2", json!({"gpu": {"resourceName": "vendor.example/shared"}})).json();
    for name in ["simulator-1", "agent-1"] {
        let container = container(&job, name);
        assert_eq!(container["resources"]["limits"]["vendor.example/shared"], "1");
        assert_eq!(variable(container, DEVICES), None);
    }
}

#[test]
fn a_container_that_requests_a_gpu_itself_is_left_to_the_plugin() {
    let limits = json!({"limits": {"nvidia.com/mig-1g.5gb": "1"}});
    let check = json!({"name": "check", "image": "c", "resources": limits});
    let none = json!({"name": "none", "image": "n", "resources": {"limits": {GPU: "0"}}});
    let overlay = json!({"spec": {
        "initContainers": [check, none],
        "containers": [{"name": "simulator", "resources": limits}],
    }});
    let job = Case::new("V2", json!({"gpu": {"mode": "None"}, "podOverrides": overlay})).json();
    for (name, expected) in [
        ("check", None),
        ("simulator-1", None),
        ("none", Some("void")),
        ("agent-1", Some("void")),
    ] {
        assert_eq!(variable(container(&job, name), DEVICES), expected, "{name}");
    }
}

/// The graphics API that the runner of simulator 2 checks, and the adapter in the server's words.
fn drawn_with(version: &str, more: Value) -> (Option<String>, Option<String>) {
    let job = Case::new(version, more).json();
    let words = words(container(&job, "simulator-2"));
    let value = |begin: &str| {
        let found = words.iter().find_map(|word| word.split_once(begin))?;
        Some(found.1.to_owned())
    };
    (value("--gpu="), value("r.GraphicsAdapter="))
}

/// Only there the agent's GPU depends on the node's runtime alone. One side with the flag and the other without would wait permanently.
#[test]
fn an_agent_that_finds_its_gpu_by_its_index_reports_to_its_simulator_whether_it_sees_one() {
    for (gpu, asks) in [
        (json!({"mode": "None"}), false),
        (json!({"resourceName": GPU}), false),
        (json!({"mode": "NodeIndex", "resourceName": GPU}), true),
        (
            json!({"mode": "Claim", "claim": {"resourceClaimTemplateName": "t"}}),
            false,
        ),
    ] {
        let job = Case::new("V2", json!({"gpu": gpu})).json();
        let has = |name: &str, flag: &str| words(container(&job, name)).contains(&flag);
        for pair in 1..=4 {
            let found = [
                has(&format!("simulator-{pair}"), "--agent-gpu=true"),
                has(&format!("agent-{pair}"), "--report-gpu=true"),
            ];
            assert_eq!(found, [asks, asks], "pair {pair}: {gpu}");
        }
    }
}

#[test]
fn the_runner_checks_what_the_server_draws_with_and_finds_its_adapter() {
    let found = "$$(LEADERBOARD_GRAPHICS_ADAPTER)";
    let own = json!({"image": "s", "command": ["server"]});
    let numbered = json!({"image": "s", "graphicsAdapter": 3});
    let none = json!({"mode": "None"});
    for (version, more, check, adapter) in [
        ("V1", json!({}), Some("opengl"), None),
        ("V2", json!({}), Some("vulkan"), Some(found)),
        ("V1", json!({"gpu": none}), None, None),
        ("V2", json!({"gpu": none}), None, None),
        (
            "V2",
            json!({"evaluation": {"carla": {"simulator": own}}}),
            Some("any"),
            None,
        ),
        (
            "V2",
            json!({"evaluation": {"carla": {"simulator": numbered}}}),
            Some("vulkan"),
            Some("3"),
        ),
        (
            "V2",
            json!({"evaluation": {"carla": {"simulator": numbered}}, "gpu": none}),
            None,
            Some("3"),
        ),
    ] {
        let expected = (check.map(str::to_owned), adapter.map(str::to_owned));
        assert_eq!(drawn_with(version, more.clone()), expected, "{version} {more}");
    }
}

#[test]
fn only_pods_that_share_by_index_keep_away_from_each_other() {
    let affinity = |more| {
        let job = Case::new("V2", more).json();
        job["spec"]["template"]["spec"]["affinity"].clone()
    };
    let required = "requiredDuringSchedulingIgnoredDuringExecution";
    let apart = json!({
        "topologyKey": "kubernetes.io/hostname",
        "namespaceSelector": {},
        "labelSelector": {"matchExpressions": [{"key": "leaderboard.carla.org/submission", "operator": "Exists"}]},
    });
    let index = json!({"mode": "NodeIndex", "resourceName": GPU});
    for (gpu, _, _) in modes() {
        let expected = if gpu["mode"] == "NodeIndex" {
            json!({"podAntiAffinity": {required: [apart]}})
        } else {
            Value::Null
        };
        assert_eq!(affinity(json!({"gpu": gpu})), expected, "{gpu}");
    }
    // The host's own terms stay, and do not take its place.
    let own = json!({"topologyKey": "zone", "labelSelector": {}});
    let overlay = json!({"spec": {"affinity": {"podAntiAffinity": {required: [own]}}}});
    let found = affinity(json!({"gpu": index, "podOverrides": overlay}));
    assert_eq!(found["podAntiAffinity"][required], json!([own, apart]));
}

#[test]
fn pods_are_for_amd64_unless_the_host_sets_it_otherwise() {
    let selector = |more| Case::new("V2", more).json()["spec"]["template"]["spec"]["nodeSelector"].clone();
    let amd64 = json!({"kubernetes.io/arch": "amd64"});
    let track = |nodes: &Value| json!({"tracks": [{"name": "sensors", "nodeSelector": nodes}]});
    assert_eq!(selector(json!({})), amd64);
    let pool = json!({"pool": "gpu"});
    assert_eq!(
        selector(track(&pool)),
        json!({"kubernetes.io/arch": "amd64", "pool": "gpu"})
    );
    let arm64 = json!({"kubernetes.io/arch": "arm64"});
    assert_eq!(selector(track(&arm64)), arm64);
    let overlay = json!({"podOverrides": {"spec": {"nodeSelector": {"kubernetes.io/arch": null}}}});
    assert_eq!(selector(overlay), json!({}));
}

/// SDL's driver, DISPLAY, and the variables that the runner removes, of simulator 1.
fn screen(version: &str, simulator: &Value, overlay: &Value) -> (Option<String>, Option<String>, Option<String>) {
    let mut simulator = simulator.clone();
    simulator["image"] = "s".into();
    let job = Case::new(
        version,
        json!({"evaluation": {"carla": {"simulator": simulator}}, "podOverrides": overlay}),
    )
    .json();
    let container = container(&job, "simulator-1");
    let words = words(container);
    let own: Vec<&&str> = words.iter().take_while(|word| **word != "--").collect();
    let unset = own.iter().find_map(|word| word.strip_prefix("--unset="));
    let value = |name| variable(container, name).map(str::to_owned);
    (value("SDL_VIDEODRIVER"), value("DISPLAY"), unset.map(str::to_owned))
}

#[test]
fn a_simulator_draws_where_the_host_wants_it() {
    let both = Some("DISPLAY,XAUTHORITY");
    let env = |name: &str, value: &str| json!({"env": [{"name": name, "value": value}]});
    let on_x11 = json!({"display": "X11Socket"});
    let second = json!({"display": "X11Socket", "x11": {"display": ":1"}});
    for (version, simulator, driver, display, unset) in [
        ("V1", json!({}), "offscreen", None, both),
        ("V2", json!({}), "dummy", None, both),
        ("V2", env("SDL_VIDEODRIVER", "kmsdrm"), "kmsdrm", None, both),
        ("V2", env("DISPLAY", ":7"), "dummy", Some(":7"), Some("XAUTHORITY")),
        ("V1", on_x11.clone(), "x11", Some(":0"), None),
        ("V2", on_x11, "x11", Some(":0"), None),
        ("V2", second, "x11", Some(":1"), None),
    ] {
        let expected = (
            Some(driver.to_owned()),
            display.map(str::to_owned),
            unset.map(str::to_owned),
        );
        assert_eq!(
            screen(version, &simulator, &json!({})),
            expected,
            "{version} {simulator}"
        );
    }
    let overlay = json!({"spec": {"containers": [{"name": "simulator", "env": [
        {"name": "DISPLAY", "value": ":8"}, {"name": "XAUTHORITY", "value": "/x"},
    ]}]}});
    assert_eq!(
        screen("V2", &json!({}), &overlay).2,
        None,
        "what the overlay sets stays"
    );
}

#[test]
fn only_simulators_on_x11_see_the_nodes_sockets() {
    let sockets = |job: &Value, name: &str| {
        let mounts = container(job, name)["volumeMounts"].as_array().unwrap().clone();
        mounts.into_iter().find(|mount| mount["mountPath"] == "/tmp/.X11-unix")
    };
    let job = Case::new(
        "V2",
        json!({"evaluation": {"carla": {"simulator": {"image": "s", "display": "X11Socket"}}}}),
    )
    .json();
    let volumes = job["spec"]["template"]["spec"]["volumes"].as_array().unwrap();
    let volume = json!({"name": "x11-sockets", "hostPath": {"path": "/tmp/.X11-unix", "type": "Directory"}});
    assert!(volumes.contains(&volume), "{volumes:?}");
    let mount = json!({"name": "x11-sockets", "mountPath": "/tmp/.X11-unix", "readOnly": true});
    for container in containers(&job) {
        let name = container["name"].as_str().unwrap();
        let expected = name.starts_with("simulator-").then(|| mount.clone());
        assert_eq!(sockets(&job, name), expected, "{name}");
    }
    let job = Case::new("V2", json!({})).json();
    assert_eq!(sockets(&job, "simulator-1"), None);
    assert!(!job.to_string().contains("hostPath"));
}

#[test]
fn resources_that_leave_open_who_has_a_gpu_are_refused() {
    let limits = |name: &str| json!({"image": "s", "resources": {"limits": {name: "1"}}});
    let overlay = json!({"spec": {"containers": [{"name": "agent", "resources": {"limits": {GPU: "1"}}}]}});
    let claim = json!({"mode": "Claim", "claim": {"deviceClassName": "gpu.nvidia.com"}});
    for (more, expected) in [
        (
            json!({"gpu": null, "evaluation": {"carla": {"simulator": limits(GPU)}}}),
            Some("simulator-1 requests nvidia.com/gpu and the Leaderboard has no field gpu"),
        ),
        (
            json!({"gpu": null, "evaluation": {"carla": {"simulator": limits("nvidia.com/mig-1g.5gb")}}}),
            Some("simulator-1 requests nvidia.com/mig-1g.5gb"),
        ),
        (
            json!({"gpu": null, "podOverrides": overlay}),
            Some("agent-1 requests nvidia.com/gpu"),
        ),
        (
            json!({"gpu": claim, "evaluation": {"carla": {"simulator": limits(GPU)}}}),
            Some("simulator-1 requests nvidia.com/gpu of a device plugin"),
        ),
        (json!({"gpu": null}), None),
        (
            json!({"gpu": null, "evaluation": {"carla": {"simulator": limits("vendor.example/fpga")}}}),
            None,
        ),
        (
            json!({"gpu": {"mode": "None"}, "evaluation": {"carla": {"simulator": limits(GPU)}}}),
            None,
        ),
        (json!({"gpu": claim}), None),
        (json!({}), None),
        (json!({"gpu": {"mode": "NodeIndex", "resourceName": GPU}}), None),
    ] {
        let case = Case::new("V2", more.clone());
        let found = unclear(&case.leaderboard.spec, &case.json()["spec"]["template"]);
        match expected {
            Some(begin) => assert!(
                found.as_ref().is_some_and(|why| why.starts_with(begin)),
                "{more}: {found:?}"
            ),
            None => assert_eq!(found, None, "{more}"),
        }
    }
}
