//! A host raises the attempt of a live run: it stores what it has reached, and goes on in another Job.

use std::time::Duration;

use evalai_stand_in::model::Status;
use leaderboard_api::{Attempt, State, Submission};
use serde_json::{Value, json};

use super::checks::plugin;
use super::losses::{REPEATED, assert_finished, half_way_of};
use super::matrix::Case;
use crate::evalai::Evalai;
use crate::operator::{bridge, controller};
use crate::scene::{Scene, done, scenario, state};

const SAYS: &str = "The run stops for attempt 2, which resumes from its results";

/// No failure is retried.
fn spec() -> Value {
    json!({"retries": {"infrastructure": 0}})
}

#[tokio::test]
async fn a_restarted_run_goes_on_in_the_higher_attempt() {
    scenario("restart", async |scene: &Scene| {
        let _controller = controller(scene);
        half_way_of(scene, "moved", spec()).await;
        let mut case = Case::open("a host restarts a run", REPEATED);
        let (code, text) = plugin(scene, &["resume", "moved", "--restart"]).await;
        assert_eq!(code, Some(0), "{text}");
        let says = |s: &Submission| {
            let message = s.status.as_ref().and_then(|status| status.message.as_deref());
            message.is_some_and(|message| message.starts_with(SAYS))
        };
        scene
            .submission("moved", "it says why it stops", Duration::from_mins(1), says)
            .await;
        assert_finished(&mut case, scene, "moved").await;
        assert_second_attempt(scene, "moved").await;
        case.close();
    })
    .await;
}

/// The second attempt has one Job, and nothing is left of how the first one ended.
async fn assert_second_attempt(scene: &Scene, name: &str) {
    let status = scene.api::<Submission>().get(name).await.unwrap().status.unwrap();
    assert_eq!((status.attempt, status.retry), (Some(Attempt(2)), 0));
    assert_eq!((status.failure, status.interruptions), (None, None));
    assert!(
        status.workers.iter().all(|pair| pair.crashes == 0),
        "{:?}",
        status.workers
    );
    assert_eq!(scene.jobs().await, [format!("{name}-1"), format!("{name}-2")]);
}

#[tokio::test]
async fn evalai_hears_of_no_end_between_the_attempts() {
    scenario("restart-evalai", async |scene: &Scene| {
        let evalai = Evalai::start(scene).await;
        let mut spec = spec();
        spec["evaluation"] = json!({"carla": {"pairs": 2, "routes": 20}});
        spec["agent"] = json!({"env": [{"name": "ROUTE_MS", "value": "4000"}]});
        scene.evalai_leaderboard("lb", &evalai, spec).await;
        let _operator = [controller(scene), bridge(scene)];
        let pk = evalai.submit(&scene.lab.challenge("agent:standard"), 1).await;
        let name = format!("submission-{pk}");
        let half = |s: &Submission| done(s) >= 2;
        scene
            .submission(&name, "two routes are done", Duration::from_mins(3), half)
            .await;
        let mut case = Case::open("a host restarts a run of EvalAI's", "Finished; EvalAI finished");
        scene.change_submission(&name, &json!({"attempt": 2})).await;
        let ended = case.ends(scene, &name, Duration::from_mins(5)).await;
        assert_eq!(state(&ended), Some(State::Finished));
        case.evalai(evalai.submission(pk).status);
        assert_eq!(evalai.submission(pk).status, Status::Finished);
        assert_second_attempt(scene, &name).await;
        for status in ["cancelled", "failed"] {
            assert_eq!(evalai.updates("PUT", status), 0, "{status}");
        }
        assert!(
            evalai.updates("PATCH", "queued") <= 2,
            "left out if the agents run before it is sent"
        );
        assert_eq!(evalai.updates("PATCH", "running"), 2);
        let row = scene.cloud.row(&scene.cloud.table).await;
        assert_eq!(row["submission_status"], "FINISHED");
        case.close();
    })
    .await;
}
