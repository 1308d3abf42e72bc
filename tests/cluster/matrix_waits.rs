//! The matrix: what a submission waits for, as its status shows it, and that it goes on once that is fixed. Also lost nodes, and other
//! systems that are away: all of these take time and little of the machine, so they share a scene.

use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, resume_unwind};
use std::time::Duration;

use evalai_stand_in::faults::Failure;
use evalai_stand_in::model::Status;
use futures::FutureExt;
use k8s_openapi::api::core::v1::{Container, ContainerState, Node, Pod, ResourceQuota};
use kube::ResourceExt;
use kube::api::{Api, DeleteParams, ListParams, Patch, PatchParams, PostParams};
use leaderboard_api::names::{CONTAINER_CONTENTS, CONTAINER_WORKSPACE};
use leaderboard_api::{Reason, State, Submission, conditions};
use serde_json::{Value, json};

use super::containers::{assert_exact, game, submit};
use super::matrix::{Case, SHOWN, together};
use crate::evalai::Evalai;
use crate::operator::controller;
use crate::played;
use crate::registry::Registry;
use crate::scene::{Scene, containers, lay_over, scenario, score, state};

const WIDTH: usize = 7;
/// An unanswered request to EvalAI costs 75 s, a stuck node 91 s; the rest is patience with the machine.
const LIMIT: Duration = Duration::from_mins(5);
/// Score of two routes and one pair: (100 + 70) / 2.
const TWO_ROUTES: &str = "85.00";
/// Only the nodes of one test have it.
const NODE_LABEL: &str = "leaderboard.carla.org/matrix";
/// The cluster's only machine.
const REAL_NODE: &str = "leaderboard-local";

#[tokio::test]
async fn each_wait_shows_why_and_goes_on_once_it_is_fixed() {
    scenario("matrix-waits", async |scene: &Scene| {
        let _controller = controller(scene);
        let cases = vec![
            silent_registry(scene).boxed_local(),
            node_lost(scene).boxed_local(),
            evalai_away(scene, "EvalAI hangs", Failure::Hang).boxed_local(),
            evalai_away(scene, "EvalAI says 503", Failure::Status(503)).boxed_local(),
            no_node(scene).boxed_local(),
            unknown_leaderboard(scene).boxed_local(),
            unknown_track(scene).boxed_local(),
            quota(scene).boxed_local(),
            missing_secret(scene).boxed_local(),
            contents_fail(scene).boxed_local(),
            no_s3_in_the_pod(scene).boxed_local(),
            table_denied(scene).boxed_local(),
        ];
        together(WIDTH, cases).await;
    })
    .await;
}

/// One pair, two routes, nothing is tried again; the name is the submission's too.
async fn board(scene: &Scene, name: &str, change: Value) {
    scene.leaderboard(name, small(change)).await;
}

fn small(change: Value) -> Value {
    let mut base = json!({
        "evaluation": {"carla": {"pairs": 1, "routes": 2}},
        "retries": {"perWorker": 1, "infrastructure": 0},
        "deadlines": {"cancelSeconds": 1},
    });
    lay_over(&mut base, change);
    base
}

/// It has ended well, with the score of an undisturbed run.
async fn finishes(case: &mut Case, scene: &Scene, name: &str) {
    let submission = case.ends(scene, name, LIMIT).await;
    assert_eq!(score(&submission), TWO_ROUTES);
}

/// A start that can't succeed is given no more time.
async fn give_up(scene: &Scene, board: &str) {
    scene
        .change_leaderboard(board, &json!({"deadlines": {"pullSeconds": 1, "startSeconds": 1}}))
        .await;
}

fn assert_not_accepted(submission: &Submission) {
    let all = &submission.status.as_ref().unwrap().conditions;
    let accepted = conditions::get(all, conditions::ACCEPTED).unwrap();
    assert_eq!(accepted.status, "False", "{accepted:?}");
}

async fn unknown_leaderboard(scene: &Scene) {
    let mut case = Case::open("unknown Leaderboard", "Pending LeaderboardNotFound; Finished");
    case.cause();
    scene.submit_to("board-later", "board-later", "agent:standard").await;
    let words = "There is no Leaderboard board-later";
    assert_not_accepted(&case.shows(scene, "board-later", "LeaderboardNotFound", words).await);
    board(scene, "board-later", json!({})).await;
    finishes(&mut case, scene, "board-later").await;
    case.close();
}

async fn unknown_track(scene: &Scene) {
    let mut case = Case::open("unknown track", "Pending TrackNotFound; Finished");
    let (other, both) = (
        json!({"name": "map", "carla": {"codename": "MAP"}}),
        json!({"name": "sensors", "carla": {"codename": "SENSORS"}}),
    );
    board(scene, "track-later", json!({"tracks": [other]})).await;
    case.cause();
    scene.submit_to("track-later", "track-later", "agent:standard").await;
    let words = "There is no track sensors";
    assert_not_accepted(&case.shows(scene, "track-later", "TrackNotFound", words).await);
    scene
        .change_leaderboard("track-later", &json!({"tracks": [other, both]}))
        .await;
    finishes(&mut case, scene, "track-later").await;
    case.close();
}

async fn quota(scene: &Scene) {
    let mut case = Case::open("quota exceeded", "Pending QuotaExceeded; Finished");
    // It counts Pods without a time limit alone: all others here have one, and the quota is of the whole namespace.
    let mut no_limit = small(json!({}));
    no_limit["deadlines"]["runSeconds"] = Value::Null;
    let none = json!({"metadata": {"name": "none"}, "spec": {"hard": {"pods": "0"}, "scopes": ["NotTerminating"]}});
    let none: ResourceQuota = serde_json::from_value(none).unwrap();
    scene.api().create(&PostParams::default(), &none).await.unwrap();
    // The API server counts a new quota's use first.
    let counted = |quota: Option<&ResourceQuota>| {
        quota.is_some_and(|quota| quota.status.as_ref().is_some_and(|status| status.hard.is_some()))
    };
    scene.wait("none", "it is counted", SHOWN, counted).await;
    scene.leaderboard("quota", no_limit).await;
    case.cause();
    scene.submit_to("quota", "quota", "agent:standard").await;
    case.shows(scene, "quota", "QuotaExceeded", "exceeded quota: none")
        .await;
    let none = scene.api::<ResourceQuota>();
    none.delete("none", &DeleteParams::default()).await.unwrap();
    finishes(&mut case, scene, "quota").await;
    case.close();
}

async fn missing_secret(scene: &Scene) {
    let mut case = Case::open("missing Secret", "Pending ContainerConfig; Finished");
    board(scene, "secret", json!({"podIdentity": {"secretName": "aws-later"}})).await;
    case.cause();
    scene.submit_to("secret", "secret", "agent:standard").await;
    case.shows(scene, "secret", "ContainerConfig", "secret \"aws-later\" not found")
        .await;
    let keys = ["AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"].map(|key| (key, "test"));
    scene.secret("aws-later", &json!(BTreeMap::from(keys))).await;
    finishes(&mut case, scene, "secret").await;
    case.close();
}

async fn contents_fail(scene: &Scene) {
    let mut case = Case::open(
        "contents fail",
        "Pending Preparing; Failed StartDeadline (infrastructure, not charged)",
    );
    let fails = json!({"evaluation": {"carla": {"contents": {"command": ["/bin/bash", "-c", "echo no such town >&2; exit 3"]}}}});
    board(scene, "contents", fails).await;
    scene.submit_to("contents", "contents", "agent:standard").await;
    has_failed(scene, "contents", "contents").await;
    case.cause();
    case.shows(scene, "contents", "Preparing", "contents fails").await;
    give_up(scene, "contents").await;
    case.ends(scene, "contents", LIMIT).await;
    case.close();
}

/// Waits until a container of a submission's Pod has failed, by the kubelet.
async fn has_failed(scene: &Scene, submission: &str, container: &'static str) {
    let pod = scene.first_pod(submission, LIMIT).await.name_any();
    let failed = move |pod: Option<&Pod>| {
        let all = pod.map(containers).unwrap_or_default();
        let ended = |state: Option<&ContainerState>| {
            state
                .and_then(|s| s.terminated.as_ref())
                .is_some_and(|t| t.exit_code != 0)
        };
        let mut ours = all.iter().filter(|status| status.name == container);
        ours.any(|status| ended(status.state.as_ref()) || ended(status.last_state.as_ref()))
    };
    scene.wait(&pod, "a container of it has failed", LIMIT, failed).await;
}

async fn no_s3_in_the_pod(scene: &Scene) {
    let mut case = Case::open(
        "workspace can't reach S3",
        "Pending Preparing; Failed StartDeadline (infrastructure, not charged)",
    );
    // On loopback, where the operator is and no Pod.
    board(scene, "no-s3", json!({"storage": {"s3": {"endpoint": scene.gate.url}}})).await;
    scene.submit_to("no-s3", "no-s3", "agent:standard").await;
    has_failed(scene, "no-s3", "workspace").await;
    case.cause();
    case.shows(scene, "no-s3", "Preparing", "workspace fails").await;
    give_up(scene, "no-s3").await;
    case.ends(scene, "no-s3", LIMIT).await;
    case.close();
}

/// A track whose nodes do not exist.
fn nowhere() -> Value {
    json!([{"name": "sensors", "carla": {"codename": "SENSORS"}, "nodeSelector": {NODE_LABEL: "nowhere"}}])
}

async fn no_node(scene: &Scene) {
    let mut case = Case::open("no node fits", "Pending Unschedulable; Pending; Cancelled");
    board(
        scene,
        "no-node",
        json!({"tracks": nowhere(), "deadlines": {"startSeconds": 1}}),
    )
    .await;
    case.cause();
    scene.submit_to("no-node", "no-node", "agent:standard").await;
    case.shows(
        scene,
        "no-node",
        "Unschedulable",
        "didn't match Pod's node affinity/selector",
    )
    .await;
    // The start has no deadline before there is a node: another submission's whole life later it still waits.
    board(scene, "meanwhile", json!({})).await;
    scene.submit_to("meanwhile", "meanwhile", "agent:standard").await;
    scene.settled("meanwhile", LIMIT).await;
    let still = scene.api::<Submission>().get("no-node").await.unwrap();
    case.also(state(&still).unwrap().as_str());
    scene.change_submission("no-node", &json!({"cancel": true})).await;
    case.ends(scene, "no-node", LIMIT).await;
    case.close();
}

async fn silent_registry(scene: &Scene) {
    let mut case = Case::open(
        "registry that never answers",
        "Pending Preparing; Failed StartDeadline (infrastructure, not charged); nothing stored later",
    );
    let silent = Registry::that_is_silent().await;
    board(scene, "silent", json!({})).await;
    let spec = json!({"leaderboardName": "silent", "track": "sensors", "image": silent.image()});
    case.cause();
    scene.apply_submission("silent", spec).await;
    // The cause of its wait is shown after 45 s: a healthy Pod costs no write until then.
    case.shows(scene, "silent", "Preparing", "images are pulled").await;
    give_up(scene, "silent").await;
    let ended = case.ends(scene, "silent", LIMIT).await;
    // Now the node comes to itself.
    drop(silent);
    let gone = |pod: Option<&Pod>| pod.is_none();
    for pod in scene.pods_of("silent").await {
        scene.wait(&pod, "it is gone", LIMIT, gone).await;
    }
    let later = scene.api::<Submission>().get("silent").await.unwrap();
    assert_eq!(later.status, ended.status);
    let keys = scene.cloud.keys("silent").await;
    let results: Vec<_> = keys.keys().filter(|key| key.starts_with("agent/")).collect();
    assert!(results.is_empty(), "{results:?}");
    case.also("nothing stored later");
    case.close();
}

async fn table_denied(scene: &Scene) {
    let mut case = Case::open(
        "DynamoDB denied and back",
        "Finished; Recorded=False Refused; Recorded=True Recorded",
    );
    scene.gate.deny("DynamoDB_20120810.UpdateItem");
    let table = json!({"name": scene.cloud.table, "region": crate::aws::REGION, "endpoint": scene.gate.url});
    board(scene, "denied", json!({"table": {"dynamoDB": table}})).await;
    scene.submit_to("denied", "denied", "agent:standard").await;
    let recorded = |s: &Submission| {
        let all = s
            .status
            .as_ref()
            .map(|status| status.conditions.as_slice())
            .unwrap_or_default();
        let recorded = conditions::get(all, conditions::RECORDED).cloned();
        recorded.map(|recorded| (recorded.status, recorded.reason, recorded.message))
    };
    let finished = |s: &Submission| state(s).is_some_and(State::is_terminal);
    scene.submission("denied", "it has ended", LIMIT, finished).await;
    case.cause();
    let refused = move |s: &Submission| recorded(s).is_some_and(|(_, reason, _)| reason == Reason::Refused);
    let denied = scene
        .submission("denied", "the table is said to refuse it", SHOWN, refused)
        .await;
    let (truth, reason, message) = recorded(&denied).unwrap();
    assert!(message.contains("not authorized"), "{message}");
    let said = format!("Recorded={truth} {reason}");
    scene.gate.reopen();
    finishes(&mut case, scene, "denied").await;
    case.also(&said);
    let settled = scene.api::<Submission>().get("denied").await.unwrap();
    let (truth, reason, _) = recorded(&settled).unwrap();
    case.also(&format!("Recorded={truth} {reason}"));
    assert_eq!(
        scene.cloud.row(&scene.cloud.table).await["submission_status"],
        "FINISHED"
    );
    case.close();
}

/// EvalAI fails when the result is put, and is well again. Each has a server of its own, whose throttle it does not share.
async fn evalai_away(scene: &Scene, name: &'static str, answer: Failure) {
    let mut case = Case::open(name, "Finished; EvalAI finished; 1 row");
    let evalai = Evalai::start(scene).await;
    evalai.fail_finals(answer, 1);
    let board = format!("lb-{}", evalai.url.rsplit(':').next().unwrap());
    let prefix = format!("{}{board}/", scene.cloud.prefix);
    let mut change = small(json!({"storage": {"s3": {"prefix": prefix}}}));
    // The servers' first submissions have the same key, so there is no table and no queue.
    change["queue"] = Value::Null;
    change["table"] = Value::Null;
    scene.evalai_leaderboard(&board, &evalai, change).await;
    let pk = evalai.submit(&scene.lab.challenge("agent:standard"), 1).await;
    let spec = json!({
        "leaderboardName": board,
        "evalai": {"challenge": 1, "phase": 1, "submission": pk},
        "image": scene.lab.challenge("agent:standard"),
    });
    scene.apply_submission(&board, spec).await;
    finishes(&mut case, scene, &board).await;
    assert_eq!(evalai.submission(pk).status, Status::Finished);
    case.evalai(Status::Finished);
    assert!(evalai.updates("PUT", "finished") > 1, "nothing went wrong");
    case.also(&format!("{} row", evalai.rows(pk).len()));
    case.close();
}

/// A node that is no machine, whose kubelet is played, goes away with its Pods; the Jobs' next ones run on the real node.
async fn node_lost(scene: &Scene) {
    let expected = "Running Running; Running Replacing; Finished; attempt 1, try 0, crashes 0";
    let mut cases = ["node lost", "node lost under evaluators of a host"].map(|case| Case::open(case, expected));
    let nodes: Api<Node> = Api::all(scene.client.clone());
    let label = scene.namespace.as_str();
    nodes.create(&PostParams::default(), &fake_node(label)).await.unwrap();
    let outcome = AssertUnwindSafe(on_the_lost_node(&mut cases, scene, &nodes, label))
        .catch_unwind()
        .await;
    // Whatever came of it, other tests find the nodes as they were.
    _ = nodes.delete(label, &DeleteParams::default()).await;
    let labelled = ListParams::default().labels(&format!("{NODE_LABEL}={label}"));
    for node in nodes.list(&labelled).await.unwrap() {
        label_node(&nodes, &node.name_any(), Value::Null).await;
    }
    match outcome {
        Ok(()) => cases.into_iter().for_each(Case::close),
        Err(panic) => resume_unwind(panic),
    }
}

/// Submissions to CARLA and to a game, in the order of the cases of `node_lost`.
const LOST: [&str; 2] = ["lost-node", "lost-game"];

async fn on_the_lost_node(cases: &mut [Case; 2], scene: &Scene, nodes: &Api<Node>, label: &str) {
    let change = json!({
        "tracks": [{
            "nodeSelector": {NODE_LABEL: label},
            "tolerations": [{"key": NODE_LABEL, "operator": "Exists"}],
        }],
        "retries": {"perWorker": 0},
    });
    let mut of_carla = change.clone();
    lay_over(
        &mut of_carla["tracks"][0],
        json!({"name": "sensors", "carla": {"codename": "SENSORS"}}),
    );
    board(scene, LOST[0], of_carla).await;
    let mut of_game = game(&scene.lab, json!({}));
    let track = of_game["tracks"][0].take();
    lay_over(&mut of_game, change);
    lay_over(&mut of_game["tracks"][0], track);
    scene.leaderboard(LOST[1], of_game).await;
    scene.submit_to(LOST[0], LOST[0], "agent:standard").await;
    submit(scene, LOST[1], LOST[1], "agent:1").await;
    let scheduled = |pod: Option<&Pod>| pod.is_some_and(|pod| pod.spec.as_ref().is_some_and(|s| s.node_name.is_some()));
    for (case, name) in cases.iter_mut().zip(LOST) {
        let pod = scene.first_pod(name, LIMIT).await.name_any();
        let pod = scene.wait(&pod, "it has a node", LIMIT, scheduled).await.unwrap();
        play_kubelet(scene, &pod).await;
        case.shows(scene, name, "Running", "").await;
    }

    cases.iter_mut().for_each(Case::cause);
    nodes.delete(label, &DeleteParams::default()).await.unwrap();
    for (case, name) in cases.iter_mut().zip(LOST) {
        case.shows(scene, name, "Replacing", "The Pod was lost").await;
    }
    label_node(nodes, REAL_NODE, json!(label)).await;
    let [of_carla, of_game] = cases;
    finishes(of_carla, scene, LOST[0]).await;
    assert_exact(&of_game.ends(scene, LOST[1], LIMIT).await);
    for (case, name) in cases.iter_mut().zip(LOST) {
        let status = scene.api::<Submission>().get(name).await.unwrap().status.unwrap();
        let crashes: i32 = status.workers.iter().map(|worker| worker.crashes).sum();
        let (attempt, retry) = (status.attempt.unwrap_or_default(), status.retry);
        case.also(&format!("attempt {attempt}, try {retry}, crashes {crashes}"));
    }
}

async fn label_node(nodes: &Api<Node>, name: &str, value: Value) {
    let patch = Patch::Merge(json!({"metadata": {"labels": {NODE_LABEL: value}}}));
    nodes.patch(name, &PatchParams::default(), &patch).await.unwrap();
}

fn fake_node(label: &str) -> Node {
    let capacity = json!({"cpu": "4", "memory": "8Gi", "pods": "10", "ephemeral-storage": "10Gi"});
    let node = json!({
        "metadata": {"name": label, "labels": {NODE_LABEL: label, "kubernetes.io/arch": "amd64"}},
        // The taint keeps all other Pods away.
        "spec": {"taints": [{"key": NODE_LABEL, "effect": "NoSchedule"}]},
        "status": {
            "capacity": capacity,
            "allocatable": capacity,
            "conditions": [{"type": "Ready", "status": "True", "reason": "KubeletReady"}],
        },
    });
    serde_json::from_value(node).unwrap()
}

/// Reports of a Pod what its kubelet would: all of it runs.
async fn play_kubelet(scene: &Scene, pod: &Pod) {
    let spec = pod.spec.as_ref().unwrap();
    let (ended, running) = (played::ended(0, ""), played::running());
    let before = [CONTAINER_CONTENTS, CONTAINER_WORKSPACE];
    let runs = |container: &Container| {
        let is_over = before.contains(&container.name.as_str());
        played::container(&container.name, "", "", if is_over { &ended } else { &running })
    };
    let init: Vec<_> = spec.init_containers.iter().flatten().map(runs).collect();
    let containers: Vec<_> = spec.containers.iter().map(runs).collect();
    let status = played::pod("Running", &init, &containers);
    let patch = Patch::Merge(json!({"status": status}));
    let pods = scene.api::<Pod>();
    pods.patch_status(&pod.name_any(), &PatchParams::default(), &patch)
        .await
        .unwrap();
}
