//! Mistakes about an evaluation by a container of the host's.

use serde_json::{Value, json};

use super::super::objects::Kind::Leaderboard;
use super::super::objects::merge;
use super::{Case, create, update};

const GPU: &str = "nvidia.com/gpu";

/// The smallest such Leaderboard, in place of CARLA's, with more of its spec.
pub fn by_container(more: &Value) -> Value {
    let mut spec = json!({
        "evaluation": {"carla": null, "container": {"mode": "Interactive", "image": "evaluator:1", "command": ["evaluate"]}},
        "agent": {"command": ["play"]},
        "tracks": [track(&json!({}))],
    });
    merge(&mut spec, more);
    spec
}

fn track(more: &Value) -> Value {
    let mut track = json!({"name": "sensors", "container": {"score": {"metric": "accuracy"}}});
    merge(&mut track, more);
    track
}

fn tracks(more: &Value) -> Value {
    json!({"tracks": [track(more)]})
}

fn container(more: &Value) -> Value {
    json!({"evaluation": {"container": more}})
}

fn case(message: &'static str, good: &Value, bad: &Value) -> Case {
    create(Leaderboard, message, &by_container(good), bad)
}

pub(super) fn all() -> Vec<Case> {
    [kinds(), gpus(), sizes()].into_iter().flatten().collect()
}

fn kinds() -> Vec<Case> {
    let (nothing, paused) = (json!({}), json!({"paused": true}));
    let to_carla = json!({
        "evaluation": {"container": null, "carla": {
            "version": "V2", "contents": {"image": "contents:1"}, "simulator": {"image": "simulator:1"},
        }},
        "tracks": [{"name": "sensors"}],
    });
    let immutable = "the kind of evaluation is immutable";
    let score = "each track needs container.score";
    vec![
        update(Leaderboard, immutable, &nothing, &by_container(&nothing), &paused),
        update(Leaderboard, immutable, &by_container(&nothing), &to_carla, &paused),
        case(
            "agent.command is missing",
            &nothing,
            &json!({"agent": {"command": null}}),
        ),
        case(score, &nothing, &json!({"tracks": [{"name": "sensors"}]})),
        create(Leaderboard, score, &nothing, &tracks(&nothing)),
        case(
            "a track has carla, but",
            &nothing,
            &tracks(&json!({"carla": {"codename": "SENSORS"}})),
        ),
    ]
}

fn gpus() -> Vec<Case> {
    let given = json!({"gpu": {"resourceName": GPU}});
    let requests = |list: &str| json!({"resources": {list: {GPU: "1"}}});
    let none = json!({"gpu": {"mode": "None"}, "evaluation": {"container": requests("limits")}});
    let named = "container.resources names gpu.resourceName";
    vec![
        case(named, &given, &container(&requests("limits"))),
        case(named, &given, &container(&requests("requests"))),
        case(
            "the container.evaluator.resources of a track",
            &given,
            &tracks(&json!({"container": {"evaluator": requests("limits")}})),
        ),
        case("container.resources names nvidia.com/gpu", &none, &json!({"gpu": null})),
    ]
}

fn sizes() -> Vec<Case> {
    let shm = |size: &str| container(&json!({"shmSize": size}));
    vec![
        case("container.shmSize must be 1Mi", &shm("1Mi"), &shm("1M")),
        case("container.shmSize must be 1Ti", &shm("1024Gi"), &shm("1025Gi")),
    ]
}
