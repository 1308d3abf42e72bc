//! The matrix: what the real EvalAI server and its users do that a friendly server would not. Two servers with the same ids,
//! cancels at the worst moment, connections that close, deletions, images that can never be one.

use std::time::Duration;

use evalai_stand_in::model::Status;
use futures::FutureExt;
use futures::future::join_all;
use jiff::Timestamp;
use leaderboard_api::{State, Submission};
use serde_json::{Value, json};

use super::matrix::{Case, together};
use crate::evalai::{Evalai, FIRST_PHASE};
use crate::operator::{bridge, controller};
use crate::scene::{Scene, lay_over, reason, scenario, state};

const WIDTH: usize = 5;
const LIMIT: Duration = Duration::from_mins(4);
/// A message that has not come after two minutes is lost; the next sweep finds its submission.
const LOST: Duration = Duration::from_mins(5);
/// How long a deletion may go unnoticed.
const NOTICED: Duration = Duration::from_mins(1);
const CANCELS: usize = 40;
/// Keys of the second server, so that both servers' submissions have names of their own in one namespace.
const OTHER_KEYS: u64 = 5000;

#[tokio::test]
async fn evalai_and_its_users_do_what_they_may() {
    scenario("matrix-evalai", async |scene: &Scene| {
        let evalai = Evalai::start_wide(scene, 3).await;
        let _operator = (controller(scene), bridge(scene));
        let cases = vec![
            cancelled_after_a_read(scene, &evalai, FIRST_PHASE).boxed_local(),
            deleted_by_the_participant(scene, &evalai, FIRST_PHASE + 1).boxed_local(),
            images_that_are_none(scene, &evalai, FIRST_PHASE + 2).boxed_local(),
        ];
        together(WIDTH, cases).await;
    })
    .await;
}

pub async fn board(scene: &Scene, evalai: &Evalai, phase: u64, change: Value) {
    let mut base = json!({
        "evaluation": {"carla": {"pairs": 1, "routes": 2}},
        "retries": {"infrastructure": 0},
        "evalai": {"requestsPerMinute": 600},
        "tracks": [{"name": "sensors", "carla": {"codename": "SENSORS"}, "phase": phase}],
    });
    lay_over(&mut base, change);
    scene.evalai_leaderboard(&format!("lb-{phase}"), evalai, base).await;
}

/// Each cancel comes when a read has shown the submission as waiting and nothing of it was written yet.
async fn cancelled_after_a_read(scene: &Scene, evalai: &Evalai, phase: u64) {
    let mut case = Case::open("40 cancels between a read and the PATCH", "40 of 40 stay cancelled");
    board(scene, evalai, phase, json!({"paused": true})).await;
    scene.ready(&format!("lb-{phase}")).await;
    let cancels = (0..CANCELS).map(|_| cancelled_at_the_worst_moment(scene, evalai, phase));
    let kept: usize = join_all(cancels).await.into_iter().map(usize::from).sum();
    case.also(&format!("{kept} of {CANCELS} stay cancelled"));
    case.close();
}

/// True if EvalAI shows `cancelled` at the end, or if a write of the operator was being worked on when the cancel came.
async fn cancelled_at_the_worst_moment(scene: &Scene, evalai: &Evalai, phase: u64) -> bool {
    let before = evalai.requests().last().map_or(0, |entry| entry.id);
    let pk = evalai.submit(&scene.lab.challenge("agent:standard"), phase).await;
    let row = format!("/submission/{pk}");
    let read = evalai.handle.wait_until(|_, log| {
        let mut reads = log.entries().filter(|entry| entry.id > before && entry.method == "GET");
        reads.any(|entry| {
            let shows_it = entry.path.ends_with(&row) || entry.path.contains("submission/?status=submitted");
            shows_it && entry.answered.is_some()
        })
    });
    tokio::time::timeout(LIMIT, read).await.expect("its row is not read");
    let cancelled_at = evalai.handle.with_state(|state| {
        state.submissions.get_mut(&pk).unwrap().status = Status::Cancelled;
        Timestamp::now()
    });
    let ended = |s: &Submission| state(s).is_some_and(State::is_terminal) || reason(s) == "Paused";
    scene
        .submission(
            &format!("submission-{pk}"),
            "its cancel was observed or undone",
            LIMIT,
            ended,
        )
        .await;
    let writes = evalai
        .requests()
        .into_iter()
        .filter(|entry| entry.method != "GET" && entry.body["submission"] == pk);
    let mut under_way = writes.filter(|write| write.time <= cancelled_at);
    evalai.submission(pk).status == Status::Cancelled || under_way.next().is_some()
}

/// A deleted submission counts as being evaluated until it has an end, and its team can push no more.
async fn deleted_by_the_participant(scene: &Scene, evalai: &Evalai, phase: u64) {
    let mut case = Case::open(
        "the participant deletes it while it runs",
        "Cancelled EndedInEvalAI; EvalAI cancelled; noticed within 60 s",
    );
    // Its own deadline must not come first.
    let hangs = json!({
        "agent": {"env": [{"name": "AGENT_KNOBS", "value": "hang@1"}]},
        "deadlines": {"idleSeconds": 600},
    });
    board(scene, evalai, phase, hangs).await;
    let pk = evalai.submit(&scene.lab.challenge("agent:standard"), phase).await;
    let name = format!("submission-{pk}");
    scene.running(&name, LIMIT).await;
    evalai.await_status(pk, Status::Running, LIMIT).await;
    case.cause();
    let begun = tokio::time::Instant::now();
    evalai.delete(pk).await;
    let stopping = |s: &Submission| s.status.as_ref().is_some_and(|s| s.times.stopping.is_some());
    scene
        .submission(&name, "its deletion is observed", LIMIT, stopping)
        .await;
    let noticed = begun.elapsed() <= NOTICED;
    case.ends(scene, &name, LIMIT).await;
    evalai.await_status(pk, Status::Cancelled, LIMIT).await;
    case.evalai(evalai.submission(pk).status);
    case.also(if noticed { "noticed within 60 s" } else { "noticed late" });
    case.close();
}

/// EvalAI checks only that the uploaded file has the key.
async fn images_that_are_none(scene: &Scene, evalai: &Evalai, phase: u64) {
    let mut case = Case::open(
        "images that can never be one",
        "5 Failed ImageInvalid; 5 EvalAI failed; 0 Jobs",
    );
    board(scene, evalai, phase, json!({})).await;
    scene.ready(&format!("lb-{phase}")).await;
    let images = [
        "",
        "   ",
        "registry.example/Team-A/Agent:1",
        "registry.example/téam/agent:1",
        "a b",
    ];
    let ends = images.map(|image| async move {
        let pk = evalai.submit(image, phase).await;
        let settled = scene.settled(&format!("submission-{pk}"), LIMIT).await;
        (
            pk,
            reason(&settled) == "ImageInvalid" && state(&settled) == Some(State::Failed),
        )
    });
    let ends = join_all(ends).await;
    let failed = ends.iter().filter(|(_, failed)| *failed).count();
    let published = ends
        .iter()
        .filter(|(pk, _)| evalai.submission(*pk).status == Status::Failed)
        .count();
    let jobs = scene.jobs().await;
    let made = ends
        .iter()
        .filter(|(pk, _)| jobs.contains(&format!("submission-{pk}-1")))
        .count();
    case.also(&format!("{failed} Failed ImageInvalid"));
    case.also(&format!("{published} EvalAI failed"));
    case.also(&format!("{made} Jobs"));
    case.close();
}

#[tokio::test]
async fn two_servers_with_the_same_ids_stay_apart() {
    scenario("matrix-servers", async |scene: &Scene| {
        let mut case = Case::open(
            "two EvalAI servers with the same challenge and phase",
            "Finished; Finished; each published where it was submitted",
        );
        let one = Evalai::start_wide(scene, 1).await;
        let other = Evalai::start_from(scene, OTHER_KEYS).await;
        for (name, evalai) in [("one", &one), ("other", &other)] {
            let change = json!({
                "evaluation": {"carla": {"pairs": 1, "routes": 2}},
                "evalai": {"requestsPerMinute": 600, "sweepSeconds": 10},
                "tracks": [{"name": "sensors", "carla": {"codename": "SENSORS"}, "phase": FIRST_PHASE}],
                "storage": {"s3": {"prefix": format!("{}{name}/", scene.cloud.prefix)}},
                // Without a queue, the sweep finds the submissions.
                "queue": null,
            });
            scene.evalai_leaderboard(name, evalai, change).await;
        }
        let _controller = controller(scene);
        scene.ready("one").await;
        scene.ready("other").await;
        let image = scene.lab.challenge("agent:standard");
        let (first, second) = tokio::join!(one.submit(&image, FIRST_PHASE), other.submit(&image, FIRST_PHASE));
        let apart = first < OTHER_KEYS && second >= OTHER_KEYS;
        for (evalai, pk) in [(&one, first), (&other, second)] {
            let exists = |found: Option<&Submission>| found.is_some();
            let name = format!("submission-{pk}");
            scene.wait(&name, "the sweep has made it", LOST, exists).await;
            case.ends(scene, &name, LIMIT).await;
            evalai.await_status(pk, Status::Finished, LIMIT).await;
        }
        let boards: Vec<_> = scene
            .all::<Submission>()
            .await
            .into_iter()
            .map(|s| s.spec.leaderboard_name)
            .collect();
        let right =
            apart && boards.len() == 2 && boards.contains(&"one".to_owned()) && boards.contains(&"other".to_owned());
        case.also(if right {
            "each published where it was submitted"
        } else {
            "mixed up"
        });
        case.close();
    })
    .await;
}

#[tokio::test]
async fn a_server_that_closes_idle_connections_loses_no_write() {
    scenario("matrix-idle", async |scene: &Scene| {
        let mut case = Case::open(
            "EvalAI closes idle connections as they are used again",
            "Finished; EvalAI finished; 1 queued, 1 running, 1 finished",
        );
        let evalai = Evalai::start_wide(scene, 1).await;
        evalai.close_idle_connections();
        // Long enough for several periods, whose lists leave connections idle, and for EvalAI's turn to hear that it runs.
        let slow = json!({"agent": {"env": [{"name": "ROUTE_MS", "value": "10000"}]}});
        board(scene, &evalai, FIRST_PHASE, slow).await;
        let _operator = (controller(scene), bridge(scene));
        scene.ready(&format!("lb-{FIRST_PHASE}")).await;
        let pk = evalai.submit(&scene.lab.challenge("agent:standard"), FIRST_PHASE).await;
        case.ends(scene, &format!("submission-{pk}"), LIMIT).await;
        case.evalai(evalai.submission(pk).status);
        let updates = ["queued", "running"].map(|status| format!("{} {status}", evalai.updates("PATCH", status)));
        case.also(&format!(
            "{}, {} finished",
            updates.join(", "),
            evalai.updates("PUT", "finished")
        ));
        case.close();
    })
    .await;
}
