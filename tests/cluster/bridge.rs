//! Messages that come wrongly, often, early or again.

use std::collections::BTreeMap;
use std::time::Duration;

use evalai_stand_in::model::Status;
use leaderboard_api::{Attempt, FailureClass, State, Submission};
use serde_json::json;

use super::expected::SIX_ROUTES;
use crate::evalai::Evalai;
use crate::operator::{bridge, controller};
use crate::scene::{Scene, names, reason, scenario, score, state};

/// Patience with a busy machine; each wait ends with its event.
const LIMIT: Duration = Duration::from_mins(3);
const UNKNOWN_AFTER_SECONDS: i64 = 3;
/// How often an AWS client tries a request whose connection breaks.
const TRIES: u32 = 3;

#[tokio::test]
async fn bad_messages_land_in_the_dead_letter_queue_with_their_reasons() {
    scenario("dead-letters", async |scene: &Scene| {
        let evalai = Evalai::start(scene).await;
        let queue = json!({"queue": {"sqs": {"unknownAfterSeconds": UNKNOWN_AFTER_SECONDS}}});
        scene.evalai_leaderboard("lb", &evalai, queue).await;
        let _bridge = bridge(scene);
        let foreign = r#"{"challenge_pk": "999", "phase_pk": "1", "submission_pk": 5}"#;
        let unknown = r#"{"challenge_pk": 1, "phase_pk": 77, "submission_pk": 6}"#;
        let mut sent = BTreeMap::new();
        for body in ["not { json", foreign, unknown] {
            sent.insert(body, scene.cloud.send(body).await);
        }

        let mut reasons = BTreeMap::new();
        for _ in 0..sent.len() {
            let letter = scene.cloud.dead_letter(LIMIT).await;
            let waited = letter.sent_ms - sent[letter.body.as_str()];
            let (reason, detail) = (&letter.attributes["reason"], &letter.attributes["detail"]);
            if reason == "UnknownPhase" {
                assert!(
                    waited > UNKNOWN_AFTER_SECONDS * 1000,
                    "given up after {waited} ms: {letter:?}"
                );
            }
            assert_eq!(letter.attributes["queue"], scene.cloud.queue_url);
            reasons.insert(letter.body.clone(), (reason.clone(), detail.clone()));
        }
        let reason = |body: &str| (reasons[body].0.as_str(), reasons[body].1.as_str());
        let nobody = "no Leaderboard that reads this queue serves";
        assert_eq!(reason("not { json").0, "Malformed");
        assert!(reason("not { json").1.contains("not JSON"), "{reasons:?}");
        assert_eq!(
            reason(foreign),
            ("UnknownPhase", format!("{nobody} challenge 999, phase 1").as_str())
        );
        assert_eq!(
            reason(unknown),
            ("UnknownPhase", format!("{nobody} challenge 1, phase 77").as_str())
        );
        scene.cloud.await_messages([0, 0], LIMIT).await;
        assert_eq!(scene.all::<Submission>().await.len(), 0);
    })
    .await;
}

/// Its message comes again and again, before and after its end, and it has one Job, which failed.
async fn fails_once(scene: &Scene, name: &str) {
    scene.gate.await_kept_back(3 * TRIES, LIMIT).await;
    let failed = scene.settled(name, LIMIT).await;
    let failure = failed.status.clone().unwrap().failure.unwrap();
    assert_eq!(
        (failure.class, failure.reason.as_str()),
        (FailureClass::Participant, "AgentCrashed")
    );
    // The message that began it comes again although the run has ended; each deletion is tried three times.
    scene.gate.await_kept_back(2 * TRIES, LIMIT).await;
    assert_eq!(names(&scene.all::<Submission>().await), [name]);
    assert_eq!(scene.jobs().await, [format!("{name}-1")]);
    let still = scene.api::<Submission>().get(name).await.unwrap();
    assert_eq!((still.spec.attempt, state(&still)), (Attempt(1), Some(State::Failed)));
}

/// Its second attempt goes on from the first one's results, and finishes.
async fn finishes_resumed(scene: &Scene, name: &str) {
    let resumed = |s: &Submission| s.status.as_ref().and_then(|status| status.attempt) == Some(Attempt(2));
    scene
        .submission(name, "the second attempt begins", LIMIT, resumed)
        .await;
    let running = scene.running(name, LIMIT).await;
    assert_eq!(
        (state(&running), reason(&running).as_str()),
        (Some(State::Resumed), "Resumed")
    );
    let finished = scene.settled(name, LIMIT).await;
    assert_eq!(
        (state(&finished), score(&finished)),
        (Some(State::Finished), SIX_ROUTES)
    );
    assert_eq!(scene.jobs().await, [format!("{name}-1"), format!("{name}-2")]);
}

#[tokio::test]
async fn a_message_delivered_again_and_again_runs_once_and_only_a_resume_runs_again() {
    scenario("redelivery", async |scene: &Scene| {
        let evalai = Evalai::start(scene).await;
        scene.cloud.set_visibility(3).await;
        let change = json!({
            "evaluation": {"carla": {"pairs": 2, "routes": 6}},
            "retries": {"perWorker": 0},
            // At every start: what it has left takes less time than a stop needs to reach it.
            "agent": {"env": [{"name": "AGENT_KNOBS", "value": "pair=2,crash@3"}]},
        });
        scene.evalai_leaderboard("lb", &evalai, change).await;
        scene.gate.keep_back("AmazonSQS.DeleteMessage");
        let (_controller, _bridge) = (controller(scene), bridge(scene));
        let pk = evalai.submit(&scene.lab.challenge("agent:standard"), 1).await;
        let name = format!("submission-{pk}");
        fails_once(scene, &name).await;

        scene.gate.reopen();
        scene.cloud.await_messages([0, 0], LIMIT).await;
        evalai.await_status(pk, Status::Failed, LIMIT).await;
        scene.change_leaderboard("lb", &json!({"agent": {"env": []}})).await;
        evalai.resume(pk).await;
        finishes_resumed(scene, &name).await;
        assert_eq!(evalai.submission(pk).status, Status::Finished);
        let row = scene.cloud.row(&scene.cloud.table).await;
        assert_eq!(
            (row["submission_status"].as_str(), row["attempt"].as_str()),
            ("FINISHED", "2")
        );
    })
    .await;
}

#[tokio::test]
async fn a_leaderboard_applied_after_its_message_still_serves_it() {
    scenario("late-board", async |scene: &Scene| {
        let evalai = Evalai::start(scene).await;
        let tracks = |name: &str, phase: u64| {
            json!({
                "evaluation": {"carla": {"pairs": 2, "routes": 6}},
                "tracks": [{"name": name, "carla": {"codename": name.to_uppercase()}, "phase": phase}],
                "storage": {"s3": {"prefix": format!("{}{name}/", scene.cloud.prefix)}},
            })
        };
        scene.evalai_leaderboard("early", &evalai, tracks("map", 2)).await;
        let (_controller, _bridge) = (controller(scene), bridge(scene));
        let pk = evalai.submit(&scene.lab.challenge("agent:standard"), 1).await;
        scene.cloud.await_messages([0, 1], LIMIT).await;
        scene.evalai_leaderboard("late", &evalai, tracks("sensors", 1)).await;
        let finished = scene.settled(&format!("submission-{pk}"), LIMIT).await;
        assert_eq!(
            (state(&finished), score(&finished)),
            (Some(State::Finished), SIX_ROUTES)
        );
        assert_eq!(finished.spec.leaderboard_name, "late");
        assert_eq!(evalai.rows(pk).len(), 1);
    })
    .await;
}
