//! The matrix: a part of the cluster dies while a submission runs, and comes back: the run does not notice. In `interruption` the
//! node is about to go, and comes back; in the mode NodeIndex a submission wants the node to itself.
//!
//! All other tests would. So these run alone and only when they are named, as `make test` does after the others.

mod interruption;
mod limits;

use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

use k8s_openapi::api::core::v1::Pod;
use kube::ResourceExt;
use leaderboard_api::Submission;
use serde_json::json;
use tokio::process::Command;
use tokio::select;

use super::abrupt::assert_untouched;
use super::gpus;
use super::matrix::Case;
use crate::evalai::Evalai;
use crate::operator::{bridge_process, controller_process, kept};
use crate::scene::{Scene, containers, done, say, scenario};

const EXPECTED: &str = "Finished; EvalAI finished; one Job, one row; the same Pod, nothing in it restarted";
/// How many seconds the part is away before it is started again.
const AWAY: &str = "3";
/// A run outlives all crashes, each of which takes it a route at most: each of four pairs drives five such routes.
const ROUTE_MS: &str = "25000";
/// A case of the matrix, and the part that dies in it.
const PARTS: [(&str, &str); 3] = [
    ("API server's process killed", "kube-apiserver"),
    ("etcd's process killed", "etcd"),
    ("kubelet of the node killed", "kubelet"),
];
/// A Lease runs out (15 s), EvalAI is left alone (75 s), and the machine is slow.
const LIMIT: Duration = Duration::from_mins(4);
const PAIRS: usize = 4;

#[tokio::test]
#[ignore = "it disturbs all other tests: make test runs it after them"]
async fn both_containers_of_a_pair_have_the_index_of_its_gpu_on_a_node_of_their_own() {
    gpus::both_containers_have_the_index_of_their_gpu().await;
}

#[tokio::test]
#[ignore = "it disturbs all other tests: make test runs it after them"]
async fn an_agent_that_gets_no_gpu_by_its_index_is_not_charged() {
    gpus::an_agent_that_gets_no_gpu_by_its_index_is_not_charged().await;
}

/// One run for all three: each case has the same end, whichever part is killed.
#[tokio::test]
#[ignore = "it disturbs all other tests: make test runs it after them"]
async fn a_killed_api_server_etcd_and_kubelet_cost_a_run_nothing() {
    scenario("crashes-of-parts", async |scene: &Scene| {
        let evalai = Evalai::start(scene).await;
        let slow = json!({"agent": {"env": [{"name": "ROUTE_MS", "value": ROUTE_MS}]}});
        scene.evalai_leaderboard("lb", &evalai, slow).await;
        // A program that loses the Lease to the outage ends, and the kubelet starts it again.
        select! {
            () = survives(scene, &evalai) => {}
            never = kept(scene, controller_process) => match never {},
            never = kept(scene, bridge_process) => match never {},
        }
    })
    .await;
}

async fn survives(scene: &Scene, evalai: &Evalai) {
    let pk = evalai.submit(&scene.lab.challenge("agent:standard"), 1).await;
    let name = format!("submission-{pk}");
    let mut before = None;
    let mut cases = Vec::new();
    let mut reached = 0;
    for (case, part) in PARTS {
        // The operator has shown more of the run since the crash before.
        let under_way = move |s: &Submission| done(s) > reached;
        let seen = scene.submission(&name, "another route is done", LIMIT, under_way).await;
        reached = done(&seen);
        let pod = scene.pod(&name).await;
        assert_eq!(alive(&pod), [PAIRS, PAIRS], "{part}: all agents and simulators run");
        before.get_or_insert_with(|| pod.uid());
        cases.push(Case::open(case, EXPECTED));
        crash(part).await;
    }
    for mut case in cases {
        let submission = case.ends(scene, &name, LIMIT).await;
        case.evalai(evalai.submission(pk).status);
        assert_untouched(scene, evalai, &submission, pk).await;
        assert_eq!(scene.cloud.rows(&scene.cloud.table).await.len(), 1);
        case.also("one Job, one row");
        let after = scene.pod(&name).await;
        assert_eq!(Some(after.uid()), before, "another Pod has run it");
        let restarts: i32 = containers(&after).iter().map(|container| container.restart_count).sum();
        assert_eq!(restarts, 0, "containers were restarted");
        case.also("the same Pod, nothing in it restarted");
        case.close();
    }
}

/// How many of a Pod's agents and simulators run.
fn alive(pod: &Pod) -> [usize; 2] {
    let all = containers(pod);
    ["agent-", "simulator-"].map(|kind| {
        let running = all.iter().filter(|container| {
            let state = container.state.as_ref();
            container.name.starts_with(kind) && state.is_some_and(|state| state.running.is_some())
        });
        running.count()
    })
}

/// Kills a part of the lab's cluster; it is back, and all that needs it, when this returns.
async fn crash(part: &str) {
    let lab = Path::new(env!("CARGO_MANIFEST_DIR")).join("local/lab");
    let mut command = Command::new(lab);
    command.args(["crash", part, "--away", AWAY]).stdin(Stdio::null());
    let done = command.output().await.unwrap();
    let output = String::from_utf8_lossy(&done.stderr);
    assert!(done.status.success(), "{part} was not crashed: {output}");
    say(output.trim_end());
}
