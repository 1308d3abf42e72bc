//! An overlay over the Pods of a host's evaluator: names, and all that stays the operator's.

use serde_json::{Value, json};

use super::tests::{carla, refused_by};
use super::*;

fn container() -> LeaderboardSpec {
    of_evaluator(&json!([]), &json!([]))
}

/// A Leaderboard with these variables of its evaluator and of its agents.
fn of_evaluator(own: &Value, agents: &Value) -> LeaderboardSpec {
    of_mode(&json!({"mode": "Interactive", "env": own}), agents)
}

/// A Leaderboard with these fields of its evaluation, and these variables of its agents.
fn of_mode(more: &Value, agents: &Value) -> LeaderboardSpec {
    let mut spec = json!({
        "evaluation": {"container": {"image": "e", "command": ["/evaluate"]}},
        "agent": {"command": ["/agent"], "env": agents},
        "tracks": [{"name": "t", "container": {"score": {"metric": "m"}}}], "storage": {"s3": {"bucket": "bucket"}},
    });
    for (key, value) in more.as_object().unwrap() {
        spec["evaluation"]["container"][key] = value.clone();
    }
    serde_json::from_value(spec).unwrap()
}

/// A mode with a dataset in an image and labels in a claim.
fn with_data(mode: &str) -> LeaderboardSpec {
    let more = json!({
        "mode": mode,
        "dataset": {"image": {"reference": "dataset"}},
        "labels": {"persistentVolumeClaim": {"claimName": "answers"}},
    });
    of_mode(&more, &json!([]))
}

#[test]
fn containers_are_addressed_where_the_pods_of_their_leaderboard_have_them() {
    let (none, init, worker, further) = (
        "no Pod of this Leaderboard has it",
        "it is an init container",
        "it belongs to containers",
        "a further container would keep the Pod from ending",
    );
    let plain = |mode: &str| of_mode(&json!({"mode": mode}), &json!([]));
    for (spec, names, in_containers, in_init) in vec![
        (
            carla(),
            ["simulator", "simulator-2", "agent", "agent-1"].as_slice(),
            None,
            Some(worker),
        ),
        (carla(), &["evaluator-1"], Some(none), Some(none)),
        (carla(), &["collect", "dataset", "labels"], Some(further), None),
        (
            container(),
            &["evaluator", "evaluator-2", "agent", "agent-1"],
            None,
            Some(worker),
        ),
        (
            container(),
            &["simulator-1", "contents", "collect", "dataset", "labels"],
            Some(none),
            Some(none),
        ),
        (with_data("Interactive"), &["dataset"], Some(init), None),
        (with_data("Interactive"), &["labels"], Some(none), Some(none)),
        (plain("Batch"), &["agent", "agent-1", "collect"], Some(init), None),
        (plain("Batch"), &["evaluator", "evaluator-1"], None, Some(worker)),
        (
            plain("Predictions"),
            &["agent", "agent-1", "collect", "dataset"],
            Some(none),
            Some(none),
        ),
        (plain("Predictions"), &["evaluator", "evaluator-1"], None, Some(worker)),
    ] {
        for name in names {
            for (list, expected) in [("containers", in_containers), ("initContainers", in_init)] {
                let overlay = json!({"spec": {list: [{"name": name}]}});
                let found = validate_overlay(&overlay, &spec).err().map(|error| error.to_string());
                match expected {
                    None => assert_eq!(found, None, "{list} {name}"),
                    Some(why) => assert!(
                        found.as_ref().is_some_and(|found| found.contains(why)),
                        "{list} {name}: {found:?}"
                    ),
                }
            }
        }
    }
}

#[test]
fn an_agent_that_runs_first_is_addressed_among_the_init_containers_and_added_ones_come_before_it() {
    let mut template = json!({"spec": {
        "initContainers": [{"name": "logcopy"}, {"name": "agent-1"}, {"name": "collect"}],
        "containers": [{"name": "evaluator-1"}, {"name": "evaluator-2"}],
    }});
    let overlay = json!({"spec": {
        "initContainers": [
            {"name": "agent-1", "tty": false}, {"name": "one"}, {"name": "agent", "tty": true, "stdin": true}, {"name": "two"},
            {"name": "collect", "tty": true}, {"name": "agent-2", "tty": true},
        ],
        "containers": [{"name": "evaluator", "tty": true}, {"name": "evaluator-2", "tty": false}],
    }});
    apply(&mut template, &overlay);
    let expected = json!({"spec": {
        "initContainers": [
            {"name": "logcopy"}, {"name": "one"}, {"name": "two"}, {"name": "agent-1", "tty": false, "stdin": true},
            {"name": "collect", "tty": true},
        ],
        "containers": [{"name": "evaluator-1", "tty": true}, {"name": "evaluator-2", "tty": false}],
    }});
    assert_eq!(template, expected);
}

/// In every mode, whichever container asks for it.
#[test]
fn no_overlay_mounts_the_data_or_what_is_submitted() {
    for (mode, list) in [
        ("Interactive", "containers"),
        ("Batch", "initContainers"),
        ("Predictions", "containers"),
    ] {
        let member = if mode == "Predictions" { "evaluator" } else { "agent" };
        let mounted = |name: &str, path: &str| {
            let mount = json!({"name": name, "mountPath": path, "readOnly": true});
            json!({"spec": {list: [{"name": member, "volumeMounts": [mount]}]}})
        };
        let volume = |volume: Value| json!({"spec": {"volumes": [volume]}});
        let claim = |name: &str| json!({"name": "mine", "persistentVolumeClaim": {"claimName": name}});
        for (overlay, why) in [
            (
                mounted("dataset", "/mine"),
                "volume dataset is mounted by the operator alone",
            ),
            (
                mounted("labels", "/mine"),
                "volume labels is mounted by the operator alone",
            ),
            (mounted("logs", "/mine"), "volume logs is mounted by the operator alone"),
            (mounted("mine", "/dataset"), "the operator mounts /dataset"),
            (mounted("mine", "/labels/more"), "the operator mounts /labels"),
            (volume(json!({"name": "labels"})), "the operator fills this volume"),
            (volume(json!({"name": "dataset"})), "the operator fills this volume"),
            (volume(claim("answers")), "the operator mounts this claim"),
        ] {
            let error = validate_overlay(&overlay, &with_data(mode))
                .expect_err(mode)
                .to_string();
            assert!(error.contains(why), "{mode} {overlay}: {error}");
        }
        assert_eq!(validate_overlay(&volume(claim("models")), &with_data(mode)), Ok(()));
        let copies = json!({"name": "dataset", "volumeMounts": [{"name": "mine", "mountPath": "/data"}]});
        let copies = json!({"spec": {"initContainers": [copies]}});
        let error = validate_overlay(&copies, &with_data(mode)).expect_err(mode).to_string();
        assert!(error.contains("[dataset].volumeMounts cannot be overridden"), "{error}");
        for (path, modes) in [
            ("/input", ["Batch", "Predictions"].as_slice()),
            ("/submission", &["Batch"]),
        ] {
            let found = validate_overlay(&mounted("mine", path), &with_data(mode));
            assert_eq!(found.is_err(), modes.contains(&mode), "{mode} {path}");
        }
    }
    // Without data these names are the host's own.
    for overlay in [
        json!({"spec": {"volumes": [{"name": "labels", "emptyDir": {}}]}}),
        json!({"spec": {"containers": [{"name": "evaluator", "volumeMounts": [{"name": "labels", "mountPath": "/labels"}]}]}}),
    ] {
        assert_eq!(validate_overlay(&overlay, &container()), Ok(()), "{overlay}");
    }
}

#[test]
fn no_container_mounts_what_is_an_evaluators_alone() {
    let mounted = |name: &str, path: &str| {
        let overlay =
            json!({"spec": {"containers": [{"name": "agent", "volumeMounts": [{"name": name, "mountPath": path}]}]}});
        overlay.to_string()
    };
    let path = "podOverrides.spec.containers[agent].volumeMounts[0] cannot be overridden: ";
    let refused = [
        (mounted("logs", "/mine"), "volume logs is mounted by the operator alone"),
        (
            mounted("shm-evaluator-1", "/mine"),
            "volume shm-evaluator-1 is mounted by the operator alone",
        ),
        (mounted("mine", "/results"), "the operator mounts /results"),
        (mounted("mine", "/results/1"), "the operator mounts /results"),
        (mounted("mine", "/dev/shm"), "the operator mounts /dev/shm"),
    ]
    .map(|(overlay, why)| (overlay, format!("{path}{why}")));
    let refused: Vec<(&str, &str)> = refused
        .iter()
        .map(|(overlay, why)| (overlay.as_str(), why.as_str()))
        .collect();
    refused_by(&container(), &refused);
    let volume = r#"{"spec": {"volumes": [{"name": "shm-agent-1", "emptyDir": {}}]}}"#;
    let why = "podOverrides.spec.volumes[shm-agent-1] cannot be overridden: the operator fills this volume";
    refused_by(&container(), &[(volume, why)]);
}

#[test]
fn the_variables_of_an_evaluator_and_of_its_agent_follow_from_the_plan() {
    let variable = |name: &str| json!([{"name": name, "value": "1"}]);
    assert_eq!(validate(&of_evaluator(&variable("LABELS"), &variable("MODEL"))), Ok(()));
    for name in [
        "WORKER",
        "WORKERS",
        "TRACK",
        "PHASE",
        "EVALUATOR_ADDRESS",
        "RESULTS",
        "RESUME",
        "ATTEMPT",
    ] {
        for (path, spec) in [
            ("evaluation.container.env", of_evaluator(&variable(name), &json!([]))),
            ("agent.env", of_evaluator(&json!([]), &variable(name))),
        ] {
            let error = validate(&spec).unwrap_err().to_string();
            assert!(
                error.starts_with(&format!("{path}[{name}] cannot be overridden: ")),
                "{error}"
            );
        }
    }
}

#[test]
fn the_variables_with_folders_follow_from_the_plan_where_the_folders_are() {
    let variable = |name: &str| json!([{"name": name, "value": "1"}]);
    for (name, modes) in [
        ("INPUT", ["Batch", "Predictions"].as_slice()),
        ("SUBMISSION_PATH", &["Batch"]),
        ("DATASET", &["Interactive", "Batch", "Predictions"]),
        ("LABELS", &["Interactive", "Batch", "Predictions"]),
    ] {
        for mode in ["Interactive", "Batch", "Predictions"] {
            let mut spec = with_data(mode);
            spec.agent.env = serde_json::from_value(variable(name)).unwrap();
            let found = validate(&spec).err().map(|error| error.to_string());
            let begin = format!("agent.env[{name}] cannot be overridden: it follows from the plan");
            let is_refused = found.as_ref().is_some_and(|found| found.starts_with(&begin));
            assert_eq!(is_refused, modes.contains(&mode), "{mode} {name}: {found:?}");
            assert_eq!(found.is_some(), is_refused, "{mode} {name}: {found:?}");
        }
    }
}
