//! An overlay over the Pods of a host's evaluator: names, and all that stays the operator's.

use serde_json::{Value, json};

use super::tests::{carla, refused_by};
use super::*;

fn container() -> &'static dyn Evaluation {
    leaderboard_evaluation::of(&of_evaluator(&json!([]), &json!([])))
}

/// A Leaderboard with these variables of its evaluator and of its agents.
fn of_evaluator(own: &Value, agents: &Value) -> LeaderboardSpec {
    let spec = json!({
        "evaluation": {"container": {"mode": "Interactive", "image": "e", "command": ["/evaluate"], "env": own}},
        "agent": {"command": ["/agent"], "env": agents},
        "tracks": [{"name": "t", "container": {"score": {"metric": "m"}}}], "storage": {"s3": {"bucket": "bucket"}},
    });
    serde_json::from_value(spec).unwrap()
}

#[test]
fn containers_are_addressed_by_the_names_of_their_own_kind_of_evaluation() {
    let both = |name: &str| {
        let list = |list: &str| json!({"spec": {list: [{"name": name}]}});
        [list("containers"), list("initContainers")]
    };
    for (kind, own, others) in [
        (
            carla(),
            ["simulator", "simulator-2", "agent-1"],
            ["evaluator-1"].as_slice(),
        ),
        (
            container(),
            ["evaluator", "evaluator-2", "agent-1"],
            &["simulator-1", "contents"],
        ),
    ] {
        for name in own {
            let [worker, init] = both(name);
            assert_eq!(validate_overlay(&worker, kind), Ok(()), "{name}");
            let error = validate_overlay(&init, kind).unwrap_err().to_string();
            assert!(error.ends_with("it belongs to containers"), "{error}");
        }
        for name in others {
            for overlay in both(name) {
                let error = validate_overlay(&overlay, kind).unwrap_err().to_string();
                assert!(
                    error.contains("only Pods of another kind of evaluation have it"),
                    "{error}"
                );
            }
        }
    }
    let mut template =
        json!({"spec": {"containers": [{"name": "evaluator-1"}, {"name": "evaluator-2"}, {"name": "agent-1"}]}});
    let overlay =
        json!({"spec": {"containers": [{"name": "evaluator", "tty": true}, {"name": "evaluator-2", "tty": false}]}});
    apply(&mut template, &overlay);
    assert_eq!(
        template["spec"]["containers"],
        json!([{"name": "evaluator-1", "tty": true}, {"name": "evaluator-2", "tty": false}, {"name": "agent-1"}])
    );
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
    refused_by(container(), &refused);
    let volume = r#"{"spec": {"volumes": [{"name": "shm-agent-1", "emptyDir": {}}]}}"#;
    let why = "podOverrides.spec.volumes[shm-agent-1] cannot be overridden: the operator fills this volume";
    refused_by(container(), &[(volume, why)]);
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
