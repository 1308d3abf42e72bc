//! The switch from another program that shares table, bucket and queue: the whole controller against a real API server, EvalAI's
//! stand-in and AWS's.
#![cfg(test)]

use aws_sdk_dynamodb::types::AttributeValue;
use evalai_stand_in::model::Status;
use k8s_openapi::api::batch::v1::Job;
use kube::api::{ListParams, Patch, PatchParams};
use leaderboard_api::{Reason, State, Submission, SubmissionStatus, conditions, names};
use serde_json::{Value, json};

use super::boards::make_table;
use super::bridge::eventually;
use super::world::World;

/// Id of the team that submits.
const TEAM: &str = "1";

/// Writes the old pipeline's row of a submission.
async fn write_row(world: &World, table: &str, pk: u64, status: &str) {
    let text = |text: &str| AttributeValue::S(text.into());
    let client = world.aws.aws.dynamodb(None, Some(&world.aws.endpoint));
    let put = client.put_item().table_name(table).item("team_id", text(TEAM));
    let put = put.item("submission_id", text(&pk.to_string()));
    let put = put
        .item("submission_status", text(status))
        .item("start_time", text("2026-11-20 10:00:00 UTC"));
    put.item("parallelization_workers", text("4")).send().await.unwrap();
}

async fn row_status(world: &World, table: &str, pk: u64) -> (String, bool) {
    let text = |text: &str| AttributeValue::S(text.into());
    let client = world.aws.aws.dynamodb(None, Some(&world.aws.endpoint));
    let get = client.get_item().table_name(table).key("team_id", text(TEAM));
    let answer = get.key("submission_id", text(&pk.to_string())).send().await.unwrap();
    let item = answer.item.unwrap();
    (
        item["submission_status"].as_s().unwrap().clone(),
        item.contains_key("attempt"),
    )
}

fn set(world: &World, pk: u64, status: Status) {
    world.evalai.with_state(|state| {
        let submission = state.submissions.get_mut(&pk).unwrap();
        submission.status = status;
    });
}

async fn adopt(world: &World, name: &str, text: &str) {
    let patch = json!({"metadata": {"annotations": {names::ANNOTATION_ADOPT: text}}});
    let api = world.api::<Submission>();
    api.patch(name, &PatchParams::default(), &Patch::Merge(&patch))
        .await
        .unwrap();
}

async fn jobs(world: &World) -> usize {
    world
        .api::<Job>()
        .list(&ListParams::default())
        .await
        .unwrap()
        .items
        .len()
}

fn is_foreign(status: &SubmissionStatus) -> bool {
    status.shows(Reason::Foreign)
}

/// The value of RESUME for the agent of a Job.
fn resume(job: &Job) -> String {
    let pod = job.spec.as_ref().unwrap().template.spec.as_ref().unwrap();
    let agent = pod.containers.iter().find(|c| c.name == "agent-1").unwrap();
    let resume = agent.env.iter().flatten().find(|variable| variable.name == "RESUME");
    // An empty value is not stored.
    resume.unwrap().value.clone().unwrap_or_default()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_the_old_pipeline_runs_is_left_alone_until_it_has_ended_there() {
    let world = World::new().await;
    let table = world.aws.name("old-rows");
    make_table(&world.aws, &table).await;
    let spec = json!({"table": {"dynamoDB": {"name": table, "endpoint": world.aws.endpoint}}});
    world.leaderboard_with("lb", 1, "Hosts", &spec).await;
    // The pipeline takes both messages before the operator begins.
    let (finishes, fails) = (world.submit("lb", 1).await, world.submit("lb", 1).await);
    for (pk, status) in [(finishes.0, "RUNNING"), (fails.0, "SUBMITTED")] {
        write_row(&world, &table, pk, status).await;
    }
    let _controller = world.controller();
    for (_, name) in [&finishes, &fails] {
        world.until(name, "it waits for the other program", is_foreign).await;
        let status = world.api::<Submission>().get(name).await.unwrap().status.unwrap();
        assert!(status.message.unwrap().contains("since 2026-11-20 10:00:00 UTC"));
    }
    assert_eq!(jobs(&world).await, 0);
    assert_eq!(row_status(&world, &table, finishes.0).await, ("RUNNING".into(), false));
    let of = |pk| world.evalai.state().submissions[&pk].status;
    assert_eq!((of(finishes.0), of(fails.0)), (Status::Submitted, Status::Submitted));

    // One run ends well; the other one fails, and a host resumes it.
    write_row(&world, &table, finishes.0, "FINISHED").await;
    set(&world, finishes.0, Status::Finished);
    write_row(&world, &table, fails.0, "FAILED").await;
    set(&world, fails.0, Status::Resuming);
    let ended =
        |status: &SubmissionStatus| status.state == Some(State::Cancelled) && status.shows(Reason::EndedInEvalAI);
    world.until(&finishes.1, "EvalAI has its end already", ended).await;
    assert_eq!(resume(&world.job(&fails.1, 0).await), "1", "it takes up what is stored");
    assert_eq!(jobs(&world).await, 1);
    assert_eq!(row_status(&world, &table, finishes.0).await, ("FINISHED".into(), false));
    assert_eq!(of(finishes.0), Status::Finished);
}

/// Number of requests that have changed a submission in EvalAI.
fn written(world: &World) -> usize {
    let all = world.evalai.requests();
    all.into_iter().filter(|entry| entry.method != "GET").count()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_prefix_in_use_holds_a_submission_back_until_a_person_hands_it_over() {
    let world = World::new().await;
    let table = world.aws.name("rows");
    make_table(&world.aws, &table).await;
    let spec = json!({"table": {"dynamoDB": {"name": table, "endpoint": world.aws.endpoint}}});
    world.leaderboard_with("lb", 1, "Hosts", &spec).await;
    let (pk, name) = world.submit("lb", 1).await;
    let _controller = world.controller();
    let of_evalai = async || world.evalai.state().submissions[&pk].status == Status::Queued;
    eventually("EvalAI shows that it is in line", of_evalai).await;
    world.finds_its_prefix_in_use(&name).await;
    let status = world.api::<Submission>().get(&name).await.unwrap().status.unwrap();
    assert_eq!(
        (status.state, status.retry, status.job_name),
        (Some(State::Pending), 0, None)
    );
    let before = (written(&world), row_status(&world, &table, pk).await);
    assert_eq!(jobs(&world).await, 0);
    // Another reconcile brings nothing new.
    adopt(&world, &name, "false").await;
    adopt(&world, &name, "true").await;
    assert_eq!(resume(&world.job(&name, 0).await), "1", "it takes up what is stored");
    assert_eq!((written(&world), row_status(&world, &table, pk).await), before);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_submission_that_nobody_has_begun_starts_with_one_look() {
    let world = World::new().await;
    let table = world.aws.name("new-rows");
    make_table(&world.aws, &table).await;
    let spec: Value = json!({"table": {"dynamoDB": {"name": table, "endpoint": world.aws.endpoint}}});
    world.leaderboard_with("lb", 1, "Hosts", &spec).await;
    let _controller = world.controller();
    let (_, name) = world.submit("lb", 1).await;
    assert_eq!(resume(&world.job(&name, 0).await), "");
    // The table of this Leaderboard does not exist yet: it has no row of another program, and the status names the fault.
    let gone = json!({"table": {"dynamoDB": {"name": world.aws.name("gone"), "endpoint": world.aws.endpoint}}});
    world.leaderboard_with("other", 2, "Hosts", &gone).await;
    let (_, name) = world.submit("other", 2).await;
    world.job(&name, 0).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_only_observed_is_run_and_never_written_to_evalai() {
    let world = World::new().await;
    let spec = json!({"evalai": {"mode": "Observe"}, "storage": {"s3": {"prefix": "observe/"}}});
    world.leaderboard_with("lb", 1, "Hosts", &spec).await;
    let (pk, name) = world.submit("lb", 1).await;
    // The other program was faster.
    set(&world, pk, Status::Finished);
    let _controller = world.controller();
    world.run_that_crashes(pk, &name).await;
    let has_failed = |status: &SubmissionStatus| {
        let published = conditions::get(&status.conditions, conditions::PUBLISHED);
        status.state == Some(State::Failed) && published.is_some_and(|c| c.reason == Reason::NotRequired)
    };
    world
        .until(&name, "it has failed, and nothing is published", has_failed)
        .await;
    let status = world.api::<Submission>().get(&name).await.unwrap().status.unwrap();
    assert_eq!(
        status.results_url.as_deref(),
        Some(format!("s3://{}/observe/{pk}", world.bucket).as_str())
    );
    assert_eq!(world.evalai.state().submissions[&pk].status, Status::Finished);
    assert_eq!(written(&world), 0);
}
