//! The operator dies, or is stopped in mid-step and goes on next to its successor: the run does not notice.

use std::time::Duration;

use evalai_stand_in::model::Status;
use fastrand::Rng;
use k8s_openapi::api::coordination::v1::Lease;
use leaderboard_api::Submission;
use serde_json::{Value, json};
use tokio::time::sleep;

use super::expected::{assert_finished, assert_row, metrics};
use super::matrix::Case;
use crate::evalai::Evalai;
use crate::operator::{LEASE, Process, bridge, bridge_process, controller_process};
use crate::scene::{Scene, names, say, scenario};

/// How slowly EvalAI saves a result while two controllers run.
const PUT_DELAY: Duration = Duration::from_secs(10);
/// Kills from the moment of the message on; the run takes a minute.
const KILLS_IN_RUN: u64 = 8;
/// Kills of the controller while EvalAI works on the final result.
const KILLS_IN_PUT: u64 = 2;
/// How long such a kill may wait: far less than the controller waits for an answer.
const IN_PUT: Duration = Duration::from_secs(10);
/// A Lease runs out (15 s), EvalAI is left alone (75 s), and the machine is slow.
const TAKEOVER: Duration = Duration::from_mins(6);

/// Agents that take so long for a route.
fn slow(milliseconds: u32) -> Value {
    json!({"agent": {"env": [{"name": "ROUTE_MS", "value": milliseconds.to_string()}]}})
}

#[tokio::test]
async fn ten_kills_of_controller_and_bridge_change_nothing() {
    let seed = std::env::var("LEADERBOARD_TEST_SEED")
        .ok()
        .and_then(|seed| seed.parse().ok());
    let seed = seed.unwrap_or_else(|| fastrand::u64(..1 << 32));
    say(&format!("kills: LEADERBOARD_TEST_SEED={seed} repeats them"));
    scenario("kills", async |scene: &Scene| {
        let evalai = Evalai::start(scene).await;
        // Results stay open until the controller is dead: an answer that came before would leave nothing to put again. They do so
        // from the start, as a run may end before the kills of a busy machine do.
        evalai.hold_puts();
        scene.evalai_leaderboard("lb", &evalai, slow(12_000)).await;
        let mut running = Running {
            scene,
            controller: controller_process(scene),
            bridge: bridge_process(scene),
        };
        let mut random = Rng::with_seed(seed);
        let pk = evalai.submit(&scene.lab.challenge("agent:standard"), 1).await;
        for number in 1..=KILLS_IN_RUN {
            sleep(Duration::from_millis(random.u64(500..9_000))).await;
            running.kill(number, random.u8(1..=3)).await;
        }
        let mut last = 0;
        for number in 1..=KILLS_IN_PUT {
            evalai.hold_puts();
            last = evalai.await_final_put(last, TAKEOVER).await;
            sleep(IN_PUT.mul_f64(random.f64())).await;
            running.kill(KILLS_IN_RUN + number, 1).await;
            evalai.release_puts();
            evalai.await_answer(last, TAKEOVER).await;
        }
        let mut case = Case::open(
            "controller and bridge killed ten times",
            "Finished; EvalAI finished; one Job, one row",
        );
        let submission = case.ends(scene, &format!("submission-{pk}"), TAKEOVER).await;
        case.evalai(evalai.submission(pk).status);
        assert_untouched(scene, &evalai, &submission, pk).await;
        case.also("one Job, one row");
        case.close();
    })
    .await;
}

struct Running<'a> {
    scene: &'a Scene,
    controller: Process,
    bridge: Process,
}

impl Running<'_> {
    /// Kills the controller (1), the bridge (2) or both, and starts them again as the kubelet would.
    async fn kill(&mut self, number: u64, which: u8) {
        let victims = ["controller", "bridge", "controller and bridge"][usize::from(which) - 1];
        say(&format!("kills: {number}: {victims}"));
        if which & 1 > 0 {
            self.controller.kill().await;
            self.controller = controller_process(self.scene);
        }
        if which & 2 > 0 {
            self.bridge.kill().await;
            self.bridge = bridge_process(self.scene);
        }
    }
}

/// One Submission, one Job, one Pod, one row here and there, and the standard score.
pub async fn assert_untouched(scene: &Scene, evalai: &Evalai, submission: &Submission, pk: u64) {
    assert_finished(submission);
    assert_eq!(names(&scene.all::<Submission>().await), [format!("submission-{pk}")]);
    assert_eq!(scene.jobs().await, [format!("submission-{pk}-1")]);
    let rows = evalai.rows(pk);
    assert_eq!(rows.len(), 1, "two rows are EvalAI's end for this split: {rows:?}");
    assert_eq!(rows[0].result, metrics());
    assert_eq!(evalai.submission(pk).status, Status::Finished);
    let row = scene.cloud.row(&scene.cloud.table).await;
    assert_row(&row);
    assert_eq!(row["submission_status"], "FINISHED");
    assert_never_two_puts(evalai, pk);
}

/// No two results of a submission are worked on at once: that is what makes EvalAI's two rows.
fn assert_never_two_puts(evalai: &Evalai, pk: u64) {
    let puts: Vec<_> = evalai
        .requests()
        .into_iter()
        .filter(|r| r.method == "PUT" && r.body["submission"] == pk)
        .collect();
    for pair in puts.windows(2) {
        // A client that was killed has no answer, but EvalAI works on, and notes when it was done.
        let end = pair[0]
            .answered
            .expect("EvalAI still works on the first of two results");
        assert!(
            end <= pair[1].time,
            "two results at once: {} and {}",
            pair[0].time,
            pair[1].time
        );
    }
}

#[tokio::test]
async fn a_controller_that_slept_while_another_took_over_ends_without_a_write() {
    scenario("overlap", async |scene: &Scene| {
        let evalai = Evalai::start(scene).await;
        evalai.set_put_delay(PUT_DELAY);
        scene.evalai_leaderboard("lb", &evalai, slow(8_000)).await;
        let (mut old, _bridge) = (controller_process(scene), bridge(scene));
        let pk = evalai.submit(&scene.lab.challenge("agent:standard"), 1).await;
        let name = format!("submission-{pk}");
        scene.running(&name, Duration::from_mins(2)).await;
        let holder = scene
            .api::<Lease>()
            .get(LEASE)
            .await
            .unwrap()
            .spec
            .unwrap()
            .holder_identity;

        let mut case = Case::open("two controllers at once", "Finished; EvalAI finished; one Job, one row");
        old.freeze();
        let _new = controller_process(scene);
        let overlap = sleep(Duration::from_secs(30));
        let moved = move |lease: Option<&Lease>| {
            let spec = lease.and_then(|lease| lease.spec.as_ref());
            spec.is_some_and(|spec| spec.holder_identity.is_some() && spec.holder_identity != holder)
        };
        scene.wait(LEASE, "the new controller leads", TAKEOVER, moved).await;
        overlap.await;
        old.thaw();
        let status = old.ended(Duration::from_mins(1)).await;
        assert!(!status.success(), "who has lost the Lease ends with an error: {status}");
        let submission = case.ends(scene, &name, TAKEOVER).await;
        case.evalai(evalai.submission(pk).status);
        assert_untouched(scene, &evalai, &submission, pk).await;
        case.also("one Job, one row");
        case.close();
    })
    .await;
}
