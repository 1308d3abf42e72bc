//! Mistakes about GPUs and screens.

use serde_json::{Value, json};

use super::super::objects::Kind::Leaderboard;
use super::{Case, create, one_track};

const GPU: &str = "nvidia.com/gpu";

fn gpu(gpu: &Value) -> Value {
    json!({ "gpu": gpu })
}

fn case(message: &'static str, good: &Value, bad: &Value) -> Case {
    create(Leaderboard, message, good, bad)
}

pub(super) fn all() -> Vec<Case> {
    [modes(), claims(), resources(), screens()]
        .into_iter()
        .flatten()
        .collect()
}

fn modes() -> Vec<Case> {
    let needs = "PerContainer and NodeIndex need gpu.resourceName";
    let is_for = "gpu.resourceName is for gpu.mode PerContainer and NodeIndex";
    vec![
        case(
            needs,
            &gpu(&json!({"resourceName": GPU, "mode": "NodeIndex"})),
            &gpu(&json!({"resourceName": null})),
        ),
        case(
            needs,
            &gpu(&json!({"resourceName": GPU})),
            &gpu(&json!({"resourceName": null, "mode": "PerContainer"})),
        ),
        case(
            is_for,
            &gpu(&json!({"resourceName": GPU})),
            &gpu(&json!({"mode": "None"})),
        ),
        case(
            is_for,
            &gpu(&json!({"mode": "Claim", "claim": {"deviceClassName": "gpu.nvidia.com"}})),
            &gpu(&json!({"resourceName": GPU})),
        ),
        case(
            "gpu.mode Claim needs gpu.claim",
            &gpu(&json!({"mode": "None"})),
            &gpu(&json!({"mode": "Claim"})),
        ),
        case(
            "gpu.claim is for gpu.mode Claim",
            &gpu(&json!({"mode": "Claim", "claim": {"deviceClassName": "gpu.nvidia.com"}})),
            &gpu(&json!({"mode": null})),
        ),
    ]
}

fn claims() -> Vec<Case> {
    let claim = |claim: Value| gpu(&json!({"mode": "Claim", "claim": claim}));
    let one = "exactly one of deviceClassName and resourceClaimTemplateName";
    let class = claim(json!({"deviceClassName": "gpu.nvidia.com", "selectors": ["true"]}));
    let template = claim(json!({"resourceClaimTemplateName": "mine"}));
    vec![
        case(one, &class, &claim(json!({"resourceClaimTemplateName": "mine"}))),
        case(one, &template, &claim(json!({"resourceClaimTemplateName": null}))),
        case(
            "gpu.claim.selectors choose among the devices",
            &template,
            &claim(json!({"selectors": ["true"]})),
        ),
    ]
}

fn resources() -> Vec<Case> {
    let given = gpu(&json!({"resourceName": GPU}));
    let requests = |list: &str| json!({"resources": {list: {GPU: "1"}}});
    let of = |side: &str, list: &str| match side {
        "simulator" => json!({"evaluation": {"carla": {"simulator": requests(list)}}}),
        side => json!({ side: requests(list) }),
    };
    let of_simulator = one_track(&json!({"carla": {"simulator": requests("limits")}}));
    let of_agent = one_track(&json!({"agent": requests("limits")}));
    let none = |side: &str| {
        let mut spec = of(side, "limits");
        spec["gpu"] = json!({"mode": "None"});
        spec
    };
    let missing = json!({"gpu": null});
    vec![
        case(
            "carla.simulator.resources names gpu.resourceName",
            &given,
            &of("simulator", "limits"),
        ),
        case(
            "carla.simulator.resources names gpu.resourceName",
            &given,
            &of("simulator", "requests"),
        ),
        case("agent.resources names gpu.resourceName", &given, &of("agent", "limits")),
        case("the carla.simulator.resources of a track", &given, &of_simulator),
        case("the agent.resources of a track", &given, &of_agent),
        case(
            "carla.simulator.resources names nvidia.com/gpu",
            &none("simulator"),
            &missing,
        ),
        case("agent.resources names nvidia.com/gpu", &none("agent"), &missing),
    ]
}

fn screens() -> Vec<Case> {
    let simulator = |simulator: Value| json!({ "evaluation": {"carla": {"simulator": simulator}} });
    let numbered = simulator(json!({"graphicsAdapter": 1}));
    vec![
        case(
            "carla.simulator.x11 is for",
            &simulator(json!({"display": "X11Socket", "x11": {"display": ":1"}})),
            &simulator(json!({"display": "Offscreen"})),
        ),
        case(
            "carla.simulator.graphicsAdapter is a flag of the default command",
            &numbered,
            &simulator(json!({"command": ["server"]})),
        ),
        case(
            "carla.simulator.graphicsAdapter is for V2",
            &numbered,
            &json!({"evaluation": {"carla": {"version": "V1"}}}),
        ),
    ]
}
