//! The matrix: what goes wrong with images, agents, simulators and results, each in a Leaderboard and a phase of its own.

use std::time::Duration;

use evalai_stand_in::model::Status;
use futures::FutureExt;
use k8s_openapi::api::core::v1::{ContainerStatus, Pod};
use kube::ResourceExt;
use leaderboard_api::Submission;
use serde_json::{Value, json};

use super::matrix::{Case, together};
use crate::evalai::{Evalai, FIRST_PHASE};
use crate::operator::{bridge, controller};
use crate::registry::{Registry, image_for_other_machines};
use crate::scene::{Scene, containers, done, lay_over, scenario};

/// Runs at once: each has five containers, and the machine two processors.
const WIDTH: usize = 4;
/// The longest of them takes a quarter of it on an idle machine.
const LIMIT: Duration = Duration::from_mins(4);

/// One line: a submission that ends by itself, or after one change of its Leaderboard.
struct Row {
    name: &'static str,
    /// Image of the challenge, such as `agent:standard`, or a reference with a registry.
    image: String,
    /// Laid over a Leaderboard with one pair and two routes.
    change: Value,
    /// The step that leads to the end.
    then: Then,
    expected: &'static str,
}

/// A step once a submission is under way.
enum Then {
    Nothing,
    /// A start that can't succeed is given no more time.
    GiveUp(&'static str),
    /// When one route is done, this change of the Leaderboard.
    Change(Value),
}

fn row(name: &'static str, change: Value, expected: &'static str) -> Row {
    Row {
        name,
        image: "agent:standard".to_owned(),
        change,
        then: Then::Nothing,
        expected,
    }
}

/// An image that can't be pulled.
fn unpullable(name: &'static str, image: String, words: &'static str, expected: &'static str) -> Row {
    Row {
        image,
        then: Then::GiveUp(words),
        ..row(name, json!({}), expected)
    }
}

/// An image whose command can't be started.
fn unstartable(name: &'static str, image: &str) -> Row {
    Row {
        image: image.to_owned(),
        ..row(
            name,
            json!({}),
            "Failed CannotStart (participant, charged); EvalAI failed",
        )
    }
}

fn agent(knobs: &str) -> Value {
    json!({"agent": {"env": [{"name": "AGENT_KNOBS", "value": knobs}]}})
}

fn simulator(knobs: &str) -> Value {
    json!({"evaluation": {"carla": {"simulator": {"env": [{"name": "SIM_KNOBS", "value": knobs}]}}}})
}

/// The second pair's simulator crashes once, and the first pair's agent, which drives on, listens on its port from then on.
/// That is long after the agent has begun, and it drives for a minute more.
fn taken_port() -> Value {
    let agent = json!([
        {"name": "AGENT_KNOBS", "value": "pair=1,take-port=2100"},
        {"name": "ROUTE_MS", "value": "20000"},
    ]);
    with(
        simulator("pair=2,crash@2"),
        json!({"evaluation": {"carla": {"pairs": 2, "routes": 8}}, "agent": {"env": agent}}),
    )
}

fn with(mut change: Value, more: Value) -> Value {
    lay_over(&mut change, more);
    change
}

fn of_images(other_machines: String, private: &Registry) -> Vec<Row> {
    vec![
        unpullable(
            "image missing",
            "agent:nobody-pushed-this".to_owned(),
            "nobody-pushed-this: not found",
            "Pending ImagePull; Failed ImageNotFound (participant, charged); EvalAI failed",
        ),
        unpullable(
            "image unauthorised",
            private.image(),
            "401 Unauthorized",
            "Pending ImagePull; Failed ImagePull (infrastructure, not charged); EvalAI failed",
        ),
        unpullable(
            "image for another machine",
            other_machines,
            "no match for platform",
            "Pending ImagePull; Failed ImagePlatform (participant, charged); EvalAI failed",
        ),
        Row {
            then: Then::GiveUp("couldn't parse image name"),
            ..row(
                "name of the contents' image that is none",
                json!({"evaluation": {"carla": {"contents": {"image": "leaderboard.example/Contents:1"}}}}),
                "Pending ImagePull; Failed ImagePull (infrastructure, not charged); EvalAI failed",
            )
        },
        // It ends long before startSeconds.
        row(
            "image of root where the Pod forbids it",
            json!({"agent": {"securityContext": {"runAsNonRoot": true}}}),
            "Failed ImageInvalid (participant, charged); EvalAI failed",
        ),
        unstartable("command missing in the image", "agent:no-shell"),
        unstartable("exec format error", "agent:no-program"),
    ]
}

fn of_agents() -> Vec<Row> {
    let memory = json!({"agent": {"resources": {"limits": {"memory": "96Mi"}}}});
    let no_more_time = json!({"deadlines": {"runSeconds": 4, "idleSeconds": 3, "readySeconds": 1}});
    vec![
        row(
            "agent out of memory always",
            with(agent("oom@1"), memory),
            "Failed OutOfMemory (participant, charged); EvalAI failed",
        ),
        row(
            "agent idle",
            with(
                agent("hang@2"),
                json!({"deadlines": {"idleSeconds": 15}, "retries": {"perWorker": 0}}),
            ),
            "Failed Idle (participant, charged); 1/2 routes; EvalAI failed",
        ),
        Row {
            then: Then::Change(no_more_time),
            ..row(
                "run deadline",
                agent("hang@2"),
                "Failed TimeLimit (participant, charged); 1/2 routes; EvalAI failed",
            )
        },
        row(
            "results malformed",
            with(agent("nonsense@1"), json!({"retries": {"perWorker": 0}})),
            "Failed InvalidResults (participant, charged); EvalAI failed",
        ),
        row(
            "agent forges its verdict",
            agent("forge-verdict@1"),
            "Failed AgentCrashed (participant, charged); EvalAI failed",
        ),
        row(
            "agent takes the port of another simulator",
            taken_port(),
            "Failed AgentCrashed (participant, charged); EvalAI failed",
        ),
        row(
            "sensors refused",
            agent("reject@2"),
            "Failed NotEligible (participant, charged); EvalAI failed",
        ),
    ]
}

fn of_results() -> Vec<Row> {
    vec![
        row(
            "results implausible",
            with(agent("forge"), json!({"evaluation": {"carla": {"verify": "Refuse"}}})),
            "Failed InvalidResults (participant, charged); EvalAI failed",
        ),
        row(
            "routes missing at the end",
            agent("early@1"),
            "Failed InvalidResults (participant, charged); 1/2 routes; EvalAI failed",
        ),
    ]
}

fn of_simulators() -> Vec<Row> {
    let crashed = "Failed SimulationCrashed (infrastructure, not charged); EvalAI failed";
    vec![
        row(
            "simulator crashes once",
            simulator("crash@1:once"),
            "Finished; EvalAI finished",
        ),
        row("simulator crashes always", simulator("crash@1"), crashed),
        row(
            "simulator hangs",
            with(
                simulator("hang@2"),
                // A restarted simulator counts its routes anew, and would not hang again: the route it drives then lasts longer than
                // the way of the stop.
                json!({
                    "deadlines": {"idleSeconds": 15}, "retries": {"perWorker": 0},
                    "agent": {"env": [{"name": "ROUTE_MS", "value": "9000"}]},
                }),
            ),
            "Failed SimulationCrashed (infrastructure, not charged); 1/2 routes; EvalAI failed",
        ),
        row(
            "simulator never ready",
            with(simulator("never-ready"), json!({"deadlines": {"readySeconds": 5}})),
            crashed,
        ),
    ]
}

#[tokio::test]
async fn each_failure_ends_with_its_reason_and_whose_it_is() {
    scenario("matrix-runs", async |scene: &Scene| {
        let private = Registry::that_refuses().await;
        let rows: Vec<_> = of_images(image_for_other_machines(&scene.lab).await, &private)
            .into_iter()
            .chain(of_agents())
            .chain(of_results())
            .chain(of_simulators())
            .collect();
        let evalai = Evalai::start_wide(scene, 1 + rows.len() as u64).await;
        let _operator = (controller(scene), bridge(scene));
        let phases = FIRST_PHASE + 1..;
        let mut cases = vec![disk_full(scene, &evalai, FIRST_PHASE).boxed_local()];
        cases.extend(
            rows.into_iter()
                .zip(phases)
                .map(|(row, phase)| run(scene, &evalai, phase, row).boxed_local()),
        );
        together(WIDTH, cases).await;
    })
    .await;
}

/// Applies the Leaderboard of a phase: one pair, two routes, nothing is tried again.
async fn board(scene: &Scene, evalai: &Evalai, phase: u64, change: Value) -> String {
    let name = format!("lb-{phase}");
    let base = json!({
        "evaluation": {"carla": {"pairs": 1, "routes": 2}},
        "retries": {"perWorker": 1, "infrastructure": 0},
        "deadlines": {"cancelSeconds": 20},
        "evalai": {"requestsPerMinute": 600},
        "tracks": [{"name": "sensors", "carla": {"codename": "SENSORS"}, "phase": phase}],
    });
    scene.evalai_leaderboard(&name, evalai, with(base, change)).await;
    name
}

async fn run(scene: &Scene, evalai: &Evalai, phase: u64, row: Row) {
    let mut case = Case::open(row.name, row.expected);
    let board = board(scene, evalai, phase, row.change).await;
    let image = if row.image.starts_with("agent:") {
        scene.lab.challenge(&row.image)
    } else {
        row.image
    };
    let pk = evalai.submit(&image, phase).await;
    let name = format!("submission-{pk}");
    match row.then {
        Then::Nothing => {}
        Then::GiveUp(words) => {
            await_pull_error(scene, &name).await;
            case.cause();
            case.shows(scene, &name, "ImagePull", words).await;
            scene
                .change_leaderboard(&board, &json!({"deadlines": {"startSeconds": 1}}))
                .await;
        }
        Then::Change(change) => {
            let first = |s: &Submission| done(s) == 1;
            scene.submission(&name, "a route is done", LIMIT, first).await;
            case.cause();
            scene.change_leaderboard(&board, &change).await;
        }
    }
    let ended = case.ends(scene, &name, LIMIT).await;
    // Where two routes may be done as well as one or none, nothing is shown of them.
    let progress = ended.status.and_then(|status| status.progress);
    if let Some(progress) = progress.filter(|_| row.expected.contains("routes;")) {
        case.also(&format!("{} routes", progress.text));
        assert_kept(scene, pk, progress.done).await;
    }
    case.evalai(evalai.submission(pk).status);
    case.close();
}

/// Waits until the kubelet has tried an image in vain.
pub async fn await_pull_error(scene: &Scene, name: &str) {
    let pod = scene.first_pod(name, LIMIT).await.name_any();
    let is_error = |container: &ContainerStatus| {
        let waiting = container.state.as_ref().and_then(|state| state.waiting.as_ref());
        matches!(
            waiting.and_then(|waiting| waiting.reason.as_deref()),
            Some("ErrImagePull" | "ImagePullBackOff" | "InvalidImageName")
        )
    };
    let tried = |pod: Option<&Pod>| pod.is_some_and(|pod| containers(pod).iter().any(is_error));
    scene.wait(&pod, "its image can't be pulled", LIMIT, tried).await;
}

/// Fails unless the merged results in S3 have this many routes.
async fn assert_kept(scene: &Scene, pk: u64, done: i32) {
    let text = scene.cloud.text(&pk.to_string(), "agent/agent_results.json").await;
    let merged: Value = serde_json::from_str(&text).unwrap();
    let records = merged["_checkpoint"]["records"].as_array().map_or(0, Vec::len);
    assert_eq!(i32::try_from(records), Ok(done), "{merged}");
}

/// The agent writes more than its disk holds, and the kubelet evicts the Pod.
async fn disk_full(scene: &Scene, evalai: &Evalai, phase: u64) {
    let mut case = Case::open(
        "evicted for disk by the agent",
        "Failed DiskFull (participant, charged); EvalAI failed",
    );
    let change = with(
        agent("spam=60000000,hang@1"),
        json!({"agent": {"resources": {"limits": {"ephemeral-storage": "20Mi"}}}}),
    );
    board(scene, evalai, phase, change).await;
    let pk = evalai.submit(&scene.lab.challenge("agent:standard"), phase).await;
    let name = format!("submission-{pk}");
    let pod = scene.first_pod(&name, LIMIT).await.name_any();
    let evicted = |pod: Option<&Pod>| {
        let status = pod.and_then(|pod| pod.status.as_ref());
        status.is_some_and(|status| status.reason.as_deref() == Some("Evicted"))
    };
    scene.wait(&pod, "it is evicted", LIMIT, evicted).await;
    case.cause();
    case.ends(scene, &name, LIMIT).await;
    case.evalai(Status::Failed);
    assert_eq!(evalai.submission(pk).status, Status::Failed);
    case.close();
}
