//! A submission that a host's own evaluator evaluates, as the whole controller runs it: its Job, its score, its row, its place in EvalAI, in
//! the words of its kind. Without its own words nobody would know what to look at.
#![cfg(test)]

use std::time::Duration;

use aws_sdk_dynamodb::types::ScalarAttributeType;
use evalai_stand_in::model::{LeaderboardRow, Status};
use k8s_openapi::api::core::v1::Container;
use leaderboard_api::{Metric, Reason, State, SubmissionStatus, conditions};
use leaderboard_contract::report::Report;
use serde_json::{Value, json};

use super::rule_cases::container::by_container;
use super::standings::{change_board, tracks, until};
use super::table::{rows, table};
use super::world::{World, is_settled};
use crate::support::player::ROUTES;

/// Words that a host without CARLA does not know.
const OF_CARLA: [&str; 4] = ["carla", "simulator", "route", "pair"];
/// Labels of the phase in EvalAI, in place of CARLA's.
const LABELS: [&str; 2] = ["accuracy", "games"];

/// The same report, as logcopy writes it of an evaluator's result with a metric that EvalAI does not list.
fn of_evaluator(report: Report) -> Report {
    let value = f64::from(report.done) / f64::from(ROUTES);
    let accuracies = json!({"accuracy": value, "games": report.done, "seconds": 1.5});
    let results = json!([{"split": "leaderboard", "show_to_participant": true, "accuracies": accuracies}]).to_string();
    Report {
        unit: "units".into(),
        score: Some(Metric::new("accuracy", value, 3)),
        metrics: vec![Metric::new("games", report.done.into(), 0)],
        results: if report.is_final { results.clone() } else { "[]".into() },
        partial_results: (!report.is_final).then_some(results),
        ..report
    }
}

/// A Leaderboard whose phase in EvalAI has these labels.
async fn world(labels: &[&str]) -> World {
    let world = World::new().await;
    change_board(&world, 1, |split| {
        split.schema.labels = labels.iter().map(|label| (*label).to_owned()).collect();
        split.schema.default_order_by = labels[0].to_owned();
        split.schema.metadata = json!({(labels[0]): {"sort_ascending": true}});
    });
    let keys = [
        ("team_id", ScalarAttributeType::S),
        ("submission_id", ScalarAttributeType::S),
    ];
    let table = table(&world.aws, "games", &keys).await;
    let spec = by_container(&json!({
        "agent": {"images": []},
        "tracks": [{"name": "games", "phase": 1, "container": {"score": {"metric": "accuracy"}}}],
        "table": {"dynamoDB": table},
    }));
    world.leaderboard_with("lb", 1, "Hosts", &spec).await;
    world
}

fn names(containers: &[Container]) -> Vec<&str> {
    containers.iter().map(|container| container.name.as_str()).collect()
}

fn in_evalai(world: &World, pk: u64) -> (Status, Vec<LeaderboardRow>) {
    world.evalai.with_state(|state| {
        let rows = state.rows.values().filter(|row| row.submission == pk);
        (state.submissions[&pk].status, rows.cloned().collect())
    })
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_submission_of_a_hosts_evaluator_comes_to_its_score_in_every_system_without_a_word_of_carla() {
    let world = world(&LABELS).await;
    let _controller = world.controller();
    let (pk, name) = world.submit("lb", 1).await;
    let job = world.job(&name, 0).await;
    let pod = job.spec.unwrap().template.spec.unwrap();
    assert_eq!(names(&pod.containers), ["evaluator-1", "agent-1"]);
    assert_eq!(names(pod.init_containers.as_deref().unwrap()), ["workspace", "logcopy"]);
    let player = world.play_as(Duration::from_millis(500), of_evaluator);
    let runs = |status: &SubmissionStatus| status.progress.as_ref().is_some_and(|progress| progress.done > 0);
    world.until(&name, "a unit is done", runs).await;
    player.fall_the_curtain();
    world.until(&name, "every system has its end", is_settled).await;

    let board = until(&world, "its result leads", |board| {
        tracks(board).iter().any(|track| !track.standings.is_empty())
    })
    .await;
    let track = &tracks(Some(&board))[0];
    let leads = &track.standings[0];
    assert_eq!(
        (leads.submission.as_str(), leads.score.value.as_str()),
        (name.as_str(), "1.000")
    );
    let ranking = track.ranking.as_ref().unwrap().to_string();
    assert_eq!(ranking, "accuracy, the lowest first", "as EvalAI has it");
    assert_eq!(track.container.as_ref().map(|shape| shape.workers), Some(1));

    let (status, found) = in_evalai(&world, pk);
    let results: Vec<Value> = found.iter().map(|row| json!(row.result)).collect();
    assert_eq!(
        (status, results),
        (Status::Finished, vec![json!({"accuracy": 1.0, "games": ROUTES})])
    );
    let table = board.spec.dynamo_table().unwrap();
    let row = rows(&world.aws, &table.name).await.remove(0);
    let column = |name: &str| row.get(name).map(String::as_str);
    for (name, value) in [
        ("submission_status", "FINISHED"),
        ("track_name", "games"),
        ("accuracy", "1.0"),
        ("games", "1000"),
        ("seconds", "1.5"),
        ("progress", "1000/1000"),
    ] {
        assert_eq!(column(name), Some(value), "{name}");
    }
    let shown = world.shown(&name).await + &serde_json::to_string(&board.status).unwrap();
    let shown = shown.replace("leaderboard.carla.org", "").to_lowercase();
    let found: Vec<_> = OF_CARLA.into_iter().filter(|word| shown.contains(word)).collect();
    assert!(found.is_empty(), "{found:?} in {shown}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_result_without_a_label_that_evalai_lists_is_not_sent_and_its_host_reads_which() {
    let world = world(&["accuracy", "games", "loss"]).await;
    let _controller = world.controller();
    let (pk, name) = world.submit("lb", 1).await;
    let player = world.play_as(Duration::from_mins(10), of_evaluator);
    let runs = |status: &SubmissionStatus| status.state_of_conditions() == State::Running;
    world.until(&name, "it runs", runs).await;
    player.fall_the_curtain();
    let lacks = |status: &SubmissionStatus| {
        let published = conditions::get(&status.conditions, conditions::PUBLISHED);
        published.is_some_and(|c| c.reason == Reason::Refused && c.message.contains("lacks the metrics loss"))
    };
    world.until(&name, "the label is named", lacks).await;
    assert_eq!(in_evalai(&world, pk), (Status::Running, vec![]));
    let finished = |status: &SubmissionStatus| status.state_of_conditions() == State::Finished;
    world.until(&name, "it is no failure of the run", finished).await;
}
