//! The matrix: what participants may write into their own rows in EvalAI, to their own advantage. It waits for two sweeps of
//! messages that never come, so it takes longest.

use std::time::Duration;

use jiff::Timestamp;
use leaderboard_api::{Attempt, Reason, Submission, conditions};
use serde_json::json;

use super::matrix::Case;
use super::matrix_evalai::board;
use crate::evalai::{Evalai, FIRST_PHASE, PARTICIPANT};
use crate::operator::{bridge, controller};
use crate::scene::{Scene, scenario};

const LIMIT: Duration = Duration::from_mins(4);
/// A message that has not come after two minutes is lost; the next sweep finds its submission.
const LOST: Duration = Duration::from_mins(5);

/// EvalAI keeps resuming for hosts, but lets a participant write the fields of the own row that a resume writes.
#[tokio::test]
async fn a_participant_who_edits_the_own_row_gets_one_attempt_at_most() {
    scenario("abuse", async |scene: &Scene| {
        let evalai = Evalai::start_wide(scene, 1).await;
        let (evalai, phase) = (&evalai, FIRST_PHASE);
        let _operator = (controller(scene), bridge(scene));
        let mut case = Case::open(
            "the participant resumes by editing the own row",
            "Failed AgentCrashed (participant, charged); Failed AgentCrashed (participant, charged); attempt 2 is the last",
        );
        let crashes = json!({
            "retries": {"perWorker": 0},
            "evalai": {"sweepSeconds": 10},
            "agent": {"env": [{"name": "AGENT_KNOBS", "value": "crash@1"}]},
        });
        board(scene, evalai, phase, crashes).await;
        let pk = evalai.submit(&scene.lab.challenge("agent:standard"), phase).await;
        let name = format!("submission-{pk}");
        case.ends(scene, &name, LIMIT).await;
        let resume = || json!({"status": "resuming", "rerun_resumed_at": Timestamp::now().to_string()});
        evalai.edit_as(PARTICIPANT, pk, &resume()).await;
        // The message of an honest resume may be lost, so one attempt begins; EvalAI's row looks the same.
        let begun = |s: &Submission| s.spec.attempt == Attempt(2);
        scene.submission(&name, "the sweep has begun an attempt", LOST, begun).await;
        case.ends(scene, &name, LIMIT).await;
        evalai.edit_as(PARTICIPANT, pk, &resume()).await;
        let refused = |s: &Submission| {
            let conditions = s.status.as_ref().map(|status| status.conditions.as_slice());
            let stalled = conditions::get(conditions.unwrap_or_default(), conditions::STALLED);
            stalled.is_some_and(|c| c.status == "True" && c.reason == Reason::AttemptWithoutMessage)
        };
        let after = scene.submission(&name, "another attempt is refused", LOST, refused).await;
        case.also(&format!("attempt {} is the last", after.spec.attempt));
        case.close();
    })
    .await;
}
