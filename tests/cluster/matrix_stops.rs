//! The matrix: cancels at every stage, ends that EvalAI had first, and how fast a stop and an end are passed on.

use std::time::{Duration, Instant};

use evalai_stand_in::model::Status;
use futures::FutureExt;
use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::core::v1::Pod;
use kube::ResourceExt;
use leaderboard_api::{State, Submission, conditions};
use serde_json::{Value, json};

use super::matrix::{Case, measured, together};
use super::matrix_runs::await_pull_error;
use crate::evalai::{Evalai, FIRST_PHASE};
use crate::operator::{bridge, controller};
use crate::processes;
use crate::scene::{Scene, containers, lay_over, scenario, state};

const WIDTH: usize = 5;
const LIMIT: Duration = Duration::from_mins(4);
const CANCEL_SECONDS: u64 = 20;
/// How long a Pod may be there after a cancel: its containers get a SIGTERM, then it is deleted, then removed by force.
const POD_GONE: Duration = Duration::from_secs(CANCEL_SECONDS + 105);

#[tokio::test]
async fn a_cancel_ends_a_submission_at_every_stage() {
    scenario("matrix-stops", async |scene: &Scene| {
        let evalai = Evalai::start_wide(scene, 3).await;
        let _operator = (controller(scene), bridge(scene));
        let cases = vec![
            between_tries(scene).boxed_local(),
            in_line(scene).boxed_local(),
            while_an_image_is_pulled(scene).boxed_local(),
            in_the_contents(scene).boxed_local(),
            ended_in_evalai_in_line(scene, &evalai, FIRST_PHASE).boxed_local(),
            archived_while_it_runs(scene, &evalai, FIRST_PHASE + 1).boxed_local(),
            while_the_end_is_published(scene, &evalai, FIRST_PHASE + 2).boxed_local(),
        ];
        together(WIDTH, cases).await;
    })
    .await;
}

fn small(change: Value) -> Value {
    let mut base = json!({
        "evaluation": {"carla": {"pairs": 1, "routes": 2}},
        "retries": {"infrastructure": 0},
        "deadlines": {"cancelSeconds": CANCEL_SECONDS},
    });
    lay_over(&mut base, change);
    base
}

async fn board(scene: &Scene, name: &str, change: Value) {
    scene.leaderboard(name, small(change)).await;
}

async fn cancel(scene: &Scene, name: &str) {
    scene.change_submission(name, &json!({"cancel": true})).await;
}

/// Cancels it, and sees it end with its Pods gone.
async fn cancelled(case: &mut Case, scene: &Scene, name: &str) {
    let pods: Vec<_> = scene.pods_of(name).await;
    // A node that pulls an image or copies contents may let go of the Pod only when it is removed by force.
    case.cause_within(POD_GONE);
    cancel(scene, name).await;
    case.ends(scene, name, LIMIT).await;
    for pod in pods {
        let ended = |pod: Option<&Pod>| {
            let phase = pod.and_then(|pod| pod.status.as_ref()?.phase.as_deref());
            matches!(phase, None | Some("Succeeded" | "Failed"))
        };
        scene.wait(&pod, "its Pod has ended", POD_GONE, ended).await;
    }
}

/// No Job of a submission was ever made.
async fn assert_no_job(scene: &Scene, submission: &str) {
    let jobs = scene.all::<Job>().await;
    let first = format!("{submission}-1");
    assert!(!jobs.iter().any(|job| job.name_any() == first), "{first} was made");
    assert!(!scene.jobs().await.contains(&first), "{first} was made");
}

async fn in_line(scene: &Scene) {
    let mut case = Case::open("cancel in line", "Pending Paused; Cancelled");
    board(scene, "in-line", json!({"paused": true})).await;
    scene.submit_to("in-line", "in-line", "agent:standard").await;
    case.shows(scene, "in-line", "Paused", "").await;
    cancelled(&mut case, scene, "in-line").await;
    assert_no_job(scene, "in-line").await;
    case.close();
}

async fn while_an_image_is_pulled(scene: &Scene) {
    let mut case = Case::open("cancel while an image can't be pulled", "Pending ImagePull; Cancelled");
    // Simulator and logcopy run. Nothing waits for what they could store: the test would not.
    board(scene, "pulling", json!({"deadlines": {"cancelSeconds": 600}})).await;
    scene.submit_to("pulling", "pulling", "agent:nobody-pushed-this").await;
    await_pull_error(scene, "pulling").await;
    case.shows(scene, "pulling", "ImagePull", "").await;
    cancelled(&mut case, scene, "pulling").await;
    case.close();
}

async fn in_the_contents(scene: &Scene) {
    let mut case = Case::open("cancel in the contents", "Pending Preparing; Cancelled");
    // Reads a pipe without a writer: there is no `sleep` in the image.
    let waits = json!({"evaluation": {"carla": {"contents": {"command": ["/bin/bash", "-c", "trap 'exit 143' TERM; read -r <> <(:)"]}}}});
    board(scene, "contents", waits).await;
    scene.submit_to("contents", "contents", "agent:standard").await;
    let pod = scene.first_pod("contents", LIMIT).await.name_any();
    let copies = |pod: Option<&Pod>| {
        let running = |pod: &Pod| containers(pod).iter().any(|c| c.name == "contents" && is_running(c));
        pod.is_some_and(running)
    };
    scene.wait(&pod, "its contents are copied", LIMIT, copies).await;
    case.shows(scene, "contents", "Preparing", "").await;
    cancelled(&mut case, scene, "contents").await;
    case.close();
}

fn is_running(container: &k8s_openapi::api::core::v1::ContainerStatus) -> bool {
    container.state.as_ref().is_some_and(|state| state.running.is_some())
}

async fn between_tries(scene: &Scene) {
    let mut case = Case::open("cancel between two tries", "Pending Replacing; Cancelled");
    let crashes = json!({
        "retries": {"perWorker": 0, "infrastructure": 4},
        "evaluation": {"carla": {
            "simulator": {"env": [{"name": "SIM_KNOBS", "value": "crash@1"}]},
        }},
    });
    board(scene, "tries", crashes).await;
    scene.submit_to("tries", "tries", "agent:standard").await;
    case.shows(scene, "tries", "Replacing", "The submission is tried again in 10 s")
        .await;
    cancelled(&mut case, scene, "tries").await;
    case.close();
}

async fn evalai_board(scene: &Scene, evalai: &Evalai, phase: u64, change: Value) {
    let mut base = small(json!({
        "evalai": {"requestsPerMinute": 600},
        "tracks": [{"name": "sensors", "carla": {"codename": "SENSORS"}, "phase": phase}],
    }));
    lay_over(&mut base, change);
    scene.evalai_leaderboard(&format!("lb-{phase}"), evalai, base).await;
}

async fn ended_in_evalai_in_line(scene: &Scene, evalai: &Evalai, phase: u64) {
    let mut case = Case::open(
        "EvalAI cancelled it by hand in line",
        "Pending Paused; Cancelled EndedInEvalAI; EvalAI cancelled; 0 PUTs",
    );
    evalai_board(scene, evalai, phase, json!({"paused": true})).await;
    scene.ready(&format!("lb-{phase}")).await;
    let pk = evalai.submit(&scene.lab.challenge("agent:standard"), phase).await;
    let name = format!("submission-{pk}");
    case.shows(scene, &name, "Paused", "").await;
    // A later update of ours must not hide the cancel.
    evalai.await_status(pk, Status::Queued, LIMIT).await;
    case.cause();
    evalai.cancel(pk).await;
    case.ends(scene, &name, LIMIT).await;
    case.evalai(evalai.submission(pk).status);
    case.also(&format!("{} PUTs", puts(evalai, pk)));
    assert_no_job(scene, &name).await;
    case.close();
}

async fn archived_while_it_runs(scene: &Scene, evalai: &Evalai, phase: u64) {
    let mut case = Case::open(
        "EvalAI archived it by hand while it ran",
        "Cancelled EndedInEvalAI; EvalAI archived; 0 PUTs",
    );
    // Without a route that is done there is nothing to put before the end.
    evalai_board(
        scene,
        evalai,
        phase,
        json!({
            "agent": {"env": [{"name": "AGENT_KNOBS", "value": "hang@1"}]},
            // Its own deadline must not come first.
            "deadlines": {"idleSeconds": 600},
        }),
    )
    .await;
    let pk = evalai.submit(&scene.lab.challenge("agent:standard"), phase).await;
    let name = format!("submission-{pk}");
    scene.running(&name, LIMIT).await;
    // A later update of ours must not hide what follows.
    evalai.await_status(pk, Status::Running, LIMIT).await;
    evalai.set_status(pk, Status::Archived).await;
    scene
        .change_leaderboard(
            &format!("lb-{phase}"),
            &json!({"deadlines": {"runSeconds": 4, "idleSeconds": 3, "readySeconds": 1}}),
        )
        .await;
    let amended = |s: &Submission| state(s) == Some(State::Cancelled);
    scene.submission(&name, "EvalAI's word counts", LIMIT, amended).await;
    case.ends(scene, &name, LIMIT).await;
    case.evalai(evalai.submission(pk).status);
    case.also(&format!("{} PUTs", puts(evalai, pk)));
    case.close();
}

fn finals(evalai: &Evalai, pk: u64) -> usize {
    let all = evalai.requests().into_iter();
    all.filter(|request| request.body["submission"] == pk && request.body["submission_status"] == "finished")
        .count()
}

fn puts(evalai: &Evalai, pk: u64) -> usize {
    let all = evalai.requests().into_iter();
    all.filter(|request| request.method == "PUT" && request.body["submission"] == pk)
        .count()
}

/// The cancel comes when EvalAI works on the final result: the result wins, in all systems.
async fn while_the_end_is_published(scene: &Scene, evalai: &Evalai, phase: u64) {
    let mut case = Case::open(
        "cancel while the end is published",
        "Finished; EvalAI finished; row FINISHED; 1 final PUT",
    );
    evalai.hold_puts();
    // So long that its processes are seen while it runs.
    evalai_board(
        scene,
        evalai,
        phase,
        json!({"agent": {"env": [{"name": "ROUTE_MS", "value": "6000"}]}}),
    )
    .await;
    let pk = evalai.submit(&scene.lab.challenge("agent:standard"), phase).await;
    let name = format!("submission-{pk}");
    scene.running(&name, LIMIT).await;
    let processes = processes::of_pod(&scene.pod(&name).await);
    let terminal = async {
        let ended = |s: &Submission| state(s).is_some_and(State::is_terminal);
        scene.submission(&name, "it has ended", LIMIT, ended).await;
        Instant::now()
    };
    let put = async {
        evalai.await_final_put(0, LIMIT).await;
        Instant::now()
    };
    let (exit, terminal, put) = tokio::join!(processes::ended(&processes, LIMIT), terminal, put);
    if !processes.is_empty() {
        measured("last container's exit → terminal status", terminal - exit, "aim < 2 s");
        measured("last container's exit → EvalAI's final PUT", put - exit, "aim < 10 s");
    }
    cancel(scene, &name).await;
    let cancelled = scene.api::<Submission>().get(&name).await.unwrap().metadata.generation;
    let observed = move |s: &Submission| s.status.as_ref().and_then(|status| status.observed_generation) >= cancelled;
    scene.submission(&name, "its cancel is observed", LIMIT, observed).await;
    evalai.release_puts();
    case.ends(scene, &name, LIMIT).await;
    let published = |s: &Submission| {
        let conditions = s.status.as_ref().map_or(&[][..], |status| &status.conditions);
        conditions::is_true(conditions, conditions::PUBLISHED) && conditions::is_true(conditions, conditions::RECORDED)
    };
    scene
        .submission(&name, "its end is published and recorded", LIMIT, published)
        .await;
    case.evalai(evalai.submission(pk).status);
    let rows = scene.cloud.rows(&scene.cloud.table).await;
    let row = rows.iter().find(|row| row["submission_id"] == pk.to_string()).unwrap();
    case.also(&format!("row {}", row["submission_status"]));
    case.also(&format!("{} final PUT", finals(evalai, pk)));
    case.close();
}
