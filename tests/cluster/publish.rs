//! EvalAI's message in, the score out: status, S3, DynamoDB and EvalAI's leaderboard show the same.

use std::time::Duration;

use evalai_stand_in::log::Entry;
use evalai_stand_in::model::Status;
use leaderboard_api::Submission;
use serde_json::{Value, json};

use super::audit::assert_few_writes;
use super::expected::{assert_finished, assert_results, assert_row, metrics};
use crate::evalai::Evalai;
use crate::operator::{bridge, controller};
use crate::scene::{Scene, names, scenario};

/// Requests a minute that the operator allows itself by default.
const BUDGET: usize = 54;

#[tokio::test]
async fn a_message_becomes_the_same_score_in_all_four_places() {
    scenario("message", async |scene: &Scene| {
        let evalai = Evalai::start(scene).await;
        let first_phase_shows_partials = |state: &mut evalai_stand_in::State| {
            state.seed.challenges[0].phases[0].is_partial_submission_evaluation_enabled = true;
        };
        evalai.handle.with_state(first_phase_shows_partials);
        // A run that is over at once would be finished before its turn comes to report that it runs.
        let change = json!({"agent": {"env": [{"name": "ROUTE_MS", "value": "5000"}]}});
        scene.evalai_leaderboard("lb", &evalai, change).await;
        let (_controller, _bridge) = (controller(scene), bridge(scene));
        // A controller that has just begun has other questions first.
        scene.ready("lb").await;
        let pk = evalai.submit(&scene.lab.challenge("agent:standard"), 1).await;
        let message = evalai.handle.state().published[0].body.clone();
        assert_eq!(
            message["challenge_pk"],
            json!("1"),
            "EvalAI's first message has its keys as texts"
        );
        let name = format!("submission-{pk}");
        let submission = scene.settled(&name, Duration::from_mins(3)).await;

        assert_finished(&submission);
        assert_eq!(names(&scene.all::<Submission>().await), [name.as_str()]);
        assert_eq!(scene.jobs().await, [format!("{name}-1")]);
        assert_published(scene, &evalai, pk).await;
        assert_requests(&evalai.requests());
        assert_partials(&evalai.requests());
        // Each PATCH starts EvalAI's clock again. `queued` is left out if the agents run before it was sent.
        assert!(evalai.updates("PATCH", "queued") <= 1);
        assert_eq!(evalai.updates("PATCH", "running"), 1);
        assert_eq!(evalai.updates("PUT", "finished"), 1);

        assert_recorded(scene, pk).await;
        assert_eq!(
            scene.cloud.messages().await,
            [0, 0],
            "the message is gone from the queue"
        );
    })
    .await;
}

/// The table has the one submission, with its metrics.
async fn assert_recorded(scene: &Scene, pk: u64) {
    let row = scene.cloud.row(&scene.cloud.table).await;
    assert_row(&row);
    for (column, text) in [
        ("team_id", "1"),
        ("submission_id", pk.to_string().as_str()),
        ("team_name", "team-a"),
        ("submission_status", "FINISHED"),
        ("track_id", "1"),
        ("track_name", "SENSORS"),
        ("attempt", "1"),
        ("progress", "20/20"),
    ] {
        assert_eq!(row.get(column).map(String::as_str), Some(text), "{column} of {row:?}");
    }
}

/// EvalAI's row, its leaderboard and its files are what S3 holds.
async fn assert_published(scene: &Scene, evalai: &Evalai, pk: u64) {
    let run = pk.to_string();
    assert_results(&scene.cloud.text(&run, "evalai/results.json").await);
    let row = evalai.submission(pk);
    assert_eq!(row.status, Status::Finished);
    let rows = evalai.rows(pk);
    assert_eq!(rows.len(), 1, "{rows:?}");
    assert_eq!(rows[0].result, metrics());
    let shown = evalai.leaderboard(1).await;
    assert_eq!(shown.len(), 1);
    assert_eq!(shown[0]["submission__id"], json!(pk));
    assert_eq!(shown[0]["filtering_score"], metrics()["Driving score"]);
    for (path, key) in [
        (&row.stdout_file, "evalai/stdout.txt"),
        (&row.submission_metadata_file, "evalai/metadata.json"),
    ] {
        assert_eq!(evalai.file(path.as_ref()), scene.cloud.text(&run, key).await, "{key}");
    }
    assert_eq!(evalai.file(row.stderr_file.as_ref()).trim(), "", "nothing went wrong");
}

/// Before the end EvalAI gets the metrics over the routes so far where its phase shows them, not the zeros of the stored file.
fn assert_partials(requests: &[Entry]) {
    let is_partial = |entry: &&Entry| entry.method == "PUT" && entry.path.contains("partially_evaluated");
    for partial in requests.iter().filter(is_partial) {
        let results: Value = serde_json::from_str(partial.body["result"].as_str().unwrap()).unwrap();
        let accuracies = results[0]["accuracies"].as_object().unwrap();
        assert!(accuracies.keys().eq(metrics().keys()), "{accuracies:?}");
        assert!(accuracies["Driving score"].as_f64() > Some(0.0), "{accuracies:?}");
    }
}

/// No minute holds more requests than the budget, and none was refused.
fn assert_requests(requests: &[Entry]) {
    for first in requests {
        let minute = requests.iter().filter(|other| {
            let age = other.time.duration_since(first.time).as_secs();
            other.id >= first.id && age < 60
        });
        assert!(
            minute.count() <= BUDGET,
            "too many requests a minute from {}",
            first.time
        );
    }
    let refused: Vec<_> = requests
        .iter()
        .filter(|r| r.status.is_none_or(|status| status >= 400))
        .collect();
    assert!(refused.is_empty(), "{refused:?}");
}

#[tokio::test]
async fn a_table_keyed_with_hyphens_gets_its_row_too_and_a_submission_costs_few_api_writes() {
    scenario("hyphens", async |scene: &Scene| {
        let evalai = Evalai::start(scene).await;
        let change = json!({"evaluation": {"carla": {"pairs": 2, "routes": 6}}, "table": {"dynamoDB": {"name": scene.cloud.hyphen_table}}});
        scene.evalai_leaderboard("lb", &evalai, change).await;
        let (_controller, _bridge) = (controller(scene), bridge(scene));
        let pk = evalai.submit(&scene.lab.challenge("agent:standard"), 2).await;
        scene.settled(&format!("submission-{pk}"), Duration::from_mins(3)).await;

        let row = scene.cloud.row(&scene.cloud.hyphen_table).await;
        let column = |name: &str| row.get(name).map(String::as_str);
        assert_eq!(
            (column("team-id"), column("submission-id")),
            (Some("1"), Some(pk.to_string().as_str()))
        );
        assert_eq!(
            (column("submission_status"), column("track_name")),
            (Some("FINISHED"), Some("MAP"))
        );
        assert_eq!(column("progress"), Some("6/6"));
        assert_eq!(
            scene.cloud.rows(&scene.cloud.table).await.len(),
            0,
            "the other table is not named"
        );
        assert_few_writes(scene);
    })
    .await;
}
