//! `retention.finishedSeconds`: what is deleted after its end, and what becomes of messages and resumes that come later.
#![cfg(test)]

use std::collections::HashMap;

use aws_sdk_dynamodb::types::AttributeValue;
use evalai_stand_in::model::{Status, User};
use evalai_stand_in::submissions::resume;
use jiff::Timestamp;
use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::core::v1::Pod;
use kube::ResourceExt;
use kube::api::DeleteParams;
use kube::runtime::wait::{await_condition, conditions};
use leaderboard_api::{Attempt, JobNumber, Reason, State, Submission, SubmissionStatus, names};
use serde_json::{Value, json};
use tokio::time::timeout;

use super::boards::make_table;
use super::bridge::LIMIT;
use super::world::World;

async fn table(world: &World) -> Value {
    let name = world.aws.name("rows");
    make_table(&world.aws, &name).await;
    json!({"name": name, "endpoint": world.aws.endpoint})
}

/// Attempt and status of the only row.
async fn row(world: &World, table: &Value) -> (String, String) {
    let client = world.aws.aws.dynamodb(None, Some(&world.aws.endpoint));
    let scan = client.scan().table_name(table["name"].as_str().unwrap());
    let mut rows: Vec<HashMap<String, AttributeValue>> = scan.send().await.unwrap().items.unwrap();
    assert_eq!(rows.len(), 1, "{rows:?}");
    let row = rows.remove(0);
    let attempt = row["attempt"].as_n().unwrap().clone();
    (attempt, row["submission_status"].as_s().unwrap().clone())
}

async fn until_deleted(world: &World, name: &str, uid: &str) {
    let gone = await_condition(world.api::<Submission>(), name, conditions::is_deleted(uid));
    timeout(LIMIT, gone).await.expect("it is deleted").unwrap();
}

async fn uid_of(world: &World, name: &str) -> String {
    world.api::<Submission>().get(name).await.unwrap().uid().unwrap()
}

fn resumed_by_a_host(world: &World, pk: u64) {
    let resumed = world.evalai.with_state(|state| {
        let host = User {
            staff: true,
            ..state.user(1).unwrap().clone()
        };
        resume(state, &host, pk, Timestamp::now())
    });
    assert!(resumed.is_ok());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_has_ended_is_deleted_after_its_time_and_only_a_resume_runs_again() {
    let world = World::new().await;
    let table = table(&world).await;
    let short =
        json!({"table": {"dynamoDB": table}, "ttlSecondsAfterFinished": 1, "retention": {"finishedSeconds": 1}});
    world.leaderboard_with("short", 1, "Hosts", &short).await;
    world.leaderboard("long", 2, "Hosts").await;
    let _controller = world.controller();
    let (kept, kept_name) = world.submit("long", 2).await;
    world.run_that_crashes(kept, &kept_name).await;
    let is_published = |s: &SubmissionStatus| s.times.published.is_some();
    world.until(&kept_name, "EvalAI has the end", is_published).await;

    let (pk, name) = world.submit("short", 1).await;
    let uid = uid_of(&world, &name).await;
    world.run_that_crashes(pk, &name).await;
    until_deleted(&world, &name, &uid).await;
    let in_evalai = || world.evalai.with_state(|state| state.submissions[&pk].status);
    assert_eq!(in_evalai(), Status::Failed);
    assert_eq!(row(&world, &table).await, ("1".to_owned(), "FAILED".to_owned()));

    // A repeat of the message: EvalAI shows the end, so no Job is made and no write is sent.
    let image = json!("r/team-a:1");
    world.object("short", 1, pk, &image).await;
    let uid = uid_of(&world, &name).await;
    let ended = |s: &SubmissionStatus| s.state == Some(State::Cancelled) && s.shows(Reason::EndedInEvalAI);
    world.until(&name, "it shows that it has ended", ended).await;
    until_deleted(&world, &name, &uid).await;
    let job = names::job(&name, JobNumber::first(Attempt(1)));
    assert_eq!(world.api::<Job>().get_opt(&job).await.unwrap(), None);
    assert_eq!(in_evalai(), Status::Failed);
    assert_eq!(row(&world, &table).await, ("1".to_owned(), "FAILED".to_owned()));

    // The cluster's garbage collector, which does not run here.
    let (pods, now) = (world.api::<Pod>(), DeleteParams::default().grace_period(0));
    pods.delete(&job, &now).await.unwrap();

    // It goes on from the stored results, and the table counts on.
    resumed_by_a_host(&world, pk);
    world.object("short", 1, pk, &image).await;
    let uid = uid_of(&world, &name).await;
    let is_resumed = |s: &SubmissionStatus| s.plan.as_ref().is_some_and(|p| p.resume && p.earlier_attempts == 1);
    world.until(&name, "it takes up what is stored", is_resumed).await;
    world.run_that_crashes(pk, &name).await;
    until_deleted(&world, &name, &uid).await;
    assert_eq!(in_evalai(), Status::Failed);
    assert_eq!(row(&world, &table).await, ("2".to_owned(), "FAILED".to_owned()));

    let status = world.api::<Submission>().get(&kept_name).await.unwrap().status.unwrap();
    assert_eq!(status.state, Some(State::Failed), "without retention all are kept");
}
