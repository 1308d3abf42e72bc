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

fn merged(mut of: Value, more: &Value) -> Value {
    merge(&mut of, more);
    of
}

fn container(more: &Value) -> Value {
    json!({"evaluation": {"container": more}})
}

fn case(message: &'static str, good: &Value, bad: &Value) -> Case {
    create(Leaderboard, message, &by_container(good), bad)
}

pub(super) fn all() -> Vec<Case> {
    [kinds(), modes(), gpus(), sizes()].into_iter().flatten().collect()
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

fn modes() -> Vec<Case> {
    let mode = |mode: &str, more: &Value| {
        let mut all = json!({"mode": mode});
        merge(&mut all, more);
        container(&all)
    };
    let (dataset, none) = (json!({"dataset": {"image": {"reference": "data:1"}}}), json!({}));
    let for_agent = |of: &Value| merged(of.clone(), &json!({"datasetForAgent": true}));
    let score = |split: usize, metric: usize| {
        tracks(&json!({"container": {"score": {"split": "s".repeat(split), "metric": "m".repeat(metric)}}}))
    };
    vec![
        update(
            Leaderboard,
            "container.mode is immutable",
            &by_container(&none),
            &mode("Batch", &none),
            &json!({"paused": true}),
        ),
        case(
            "container.port is for Interactive",
            &mode("Batch", &none),
            &mode("Batch", &json!({"port": 7000})),
        ),
        case(
            "container.input is for Batch",
            &none,
            &container(&json!({"input": {"maxFiles": 2}})),
        ),
        case(
            "datasetForAgent needs a dataset",
            &container(&for_agent(&dataset)),
            &container(&for_agent(&json!({"dataset": null}))),
        ),
        case(
            "datasetForAgent needs a dataset",
            &mode("Predictions", &dataset),
            &mode("Predictions", &for_agent(&dataset)),
        ),
        case("split and metric have at most 63", &score(31, 32), &score(32, 32)),
        case(
            "merge Command a track has at most 15 workers",
            &container(&json!({"merge": "Command", "workers": 15})),
            &container(&json!({"workers": 16})),
        ),
        case(
            "merge Command a track has at most 15 workers",
            &merged(
                container(&json!({"merge": "Command", "workers": 16})),
                &tracks(&json!({"container": {"workers": 15}})),
            ),
            &tracks(&json!({"container": {"workers": 16}})),
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
        case(
            "container.resources names nvidia.com/gpu",
            &container(&merged(requests("limits"), &json!({"mode": "Predictions"}))),
            &container(&json!({"mode": "Batch"})),
        ),
    ]
}

fn sizes() -> Vec<Case> {
    let shm = |size: &str| container(&json!({"shmSize": size}));
    let bytes = |size: &str| container(&json!({"mode": "Batch", "input": {"maxBytes": size}}));
    vec![
        case("input.maxBytes must be 1 or", &bytes("1"), &bytes("0")),
        case("input.maxBytes must be 100Gi", &bytes("100Gi"), &bytes("101Gi")),
        case("container.shmSize must be 1Mi", &shm("1Mi"), &shm("1M")),
        case("container.shmSize must be 1Ti", &shm("1024Gi"), &shm("1025Gi")),
    ]
}
