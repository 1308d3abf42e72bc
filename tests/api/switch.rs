//! The switch from another program that shares table, bucket and queue: the whole controller against a real API server, EvalAI's
//! stand-in and AWS's.
#![cfg(test)]

use aws_sdk_dynamodb::types::AttributeValue;
use evalai_stand_in::model::Status;
use futures::{StreamExt, TryStreamExt};
use k8s_openapi::api::batch::v1::Job;
use kube::api::{ListParams, Patch, PatchParams};
use kube::runtime::wait::await_condition;
use leaderboard_api::{Leaderboard, State, Submission, SubmissionStatus, conditions, names, reasons};
use serde_json::{Value, json};
use tokio::time::timeout;

use super::boards::make_table;
use super::bridge::LIMIT;
use super::world::World;
use crate::support::throttle::Throttle;

/// Id of the team that submits.
const TEAM: &str = "1";

/// What the old pipeline writes of a submission.
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

async fn adopt(world: &World, name: &str) {
    let patch = json!({"metadata": {"annotations": {names::ANNOTATION_ADOPT: "true"}}});
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
    status.reason.as_deref() == Some(reasons::FOREIGN)
}

/// What the agent of a Job gets as RESUME.
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
    let spec = json!({"table": {"name": table, "endpoint": world.aws.endpoint}});
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
    let ended = |status: &SubmissionStatus| {
        status.state == Some(State::Cancelled) && status.reason.as_deref() == Some(reasons::ENDED_IN_EVALAI)
    };
    world.until(&finishes.1, "EvalAI has its end already", ended).await;
    assert_eq!(resume(&world.job(&fails.1, 0).await), "1", "it takes up what is stored");
    assert_eq!(jobs(&world).await, 1);
    assert_eq!(row_status(&world, &table, finishes.0).await, ("FINISHED".into(), false));
    assert_eq!(of(finishes.0), Status::Finished);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_another_program_stores_is_left_alone_until_a_person_hands_it_over() {
    let world = World::new().await;
    world.leaderboard("lb", 1, "Hosts").await;
    let (pk, name) = world.submit("lb", 1).await;
    let log = world.archive(pk);
    log.put("agent/agent1/leaderboard.log", b"route 1".to_vec())
        .await
        .unwrap();
    let _controller = world.controller();
    world.until(&name, "it waits for the other program", is_foreign).await;
    assert_eq!(jobs(&world).await, 0);
    adopt(&world, &name).await;
    assert_eq!(resume(&world.job(&name, 0).await), "1", "it takes up what is stored");
}

/// What an agent stores comes first in a list, and the marks of both pipelines come behind it.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn marks_behind_thousands_of_objects_are_found_with_four_requests() {
    const OBJECTS: usize = 2100;
    let world = World::new().await;
    let gate = Throttle::start(&world.aws.endpoint, "SlowDown").await;
    world
        .leaderboard_with("lb", 1, "Hosts", &json!({"storage": {"endpoint": gate.endpoint()}}))
        .await;
    let (others, ours) = (world.submit("lb", 1).await, world.submit("lb", 1).await);
    for (pk, _) in [&others, &ours] {
        let archive = world.archive(*pk);
        let stored = (0..OBJECTS).map(async |n| archive.put(&format!("agent/agent1/{n:05}.png"), vec![0]).await);
        let stored = futures::stream::iter(stored)
            .buffer_unordered(32)
            .try_collect::<Vec<_>>();
        assert_eq!(stored.await.unwrap().len(), OBJECTS);
    }
    world
        .archive(ours.0)
        .put("logcopy/owner", b"a Pod".to_vec())
        .await
        .unwrap();
    let _controller = world.controller();
    world
        .until(&others.1, "it waits for the other program", is_foreign)
        .await;
    let looked = |pk: u64| gate.asked(&format!("prefix={pk}%2F"));
    assert_eq!(
        looked(others.0),
        4,
        "two pages of a thousand, and a list of each folder of marks"
    );
    assert_eq!(
        resume(&world.job(&ours.1, 0).await),
        "1",
        "it takes up what it has stored itself"
    );
    assert_eq!(looked(ours.0), 4);
    assert_eq!(jobs(&world).await, 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_submission_that_nobody_has_begun_starts_with_one_look() {
    let world = World::new().await;
    let table = world.aws.name("new-rows");
    make_table(&world.aws, &table).await;
    let spec: Value = json!({"table": {"name": table, "endpoint": world.aws.endpoint}});
    world.leaderboard_with("lb", 1, "Hosts", &spec).await;
    let _controller = world.controller();
    let (_, name) = world.submit("lb", 1).await;
    assert_eq!(resume(&world.job(&name, 0).await), "");
    // A Leaderboard whose table does not exist yet: nobody's row is there, and its status names the fault.
    let gone = json!({"table": {"name": world.aws.name("gone"), "endpoint": world.aws.endpoint}});
    world.leaderboard_with("other", 2, "Hosts", &gone).await;
    let (_, name) = world.submit("other", 2).await;
    world.job(&name, 0).await;
}

/// Edits the Leaderboard, with which its queue is read at once, and waits until the reading is taken in. Hands back the reason of
/// `Ready` and its message.
async fn read_again(world: &World, round: usize) -> (String, String) {
    let api = world.api::<Leaderboard>();
    let patch = json!({"spec": {"concurrency": {"total": round + 10}}});
    let edited = api
        .patch("lb", &PatchParams::default(), &Patch::Merge(&patch))
        .await
        .unwrap();
    let generation = edited.metadata.generation;
    let is_taken = |board: Option<&Leaderboard>| {
        let status = board.and_then(|board| board.status.as_ref());
        status.is_some_and(|status| status.observed_generation == generation)
    };
    let taken = timeout(LIMIT, Box::pin(await_condition(api, "lb", is_taken))).await;
    let board = taken.expect("it is reconciled").unwrap().unwrap();
    let status = board.status.unwrap();
    let ready = conditions::get(&status.conditions, conditions::READY).unwrap();
    (ready.reason.to_string(), ready.message.to_string())
}

/// Edits until `Ready` shows this reason. Readings count only if they lie further apart than a message stays invisible, which is a
/// second here.
async fn read_until(world: &World, reason: &str) -> (usize, String) {
    let read = async {
        for round in 1.. {
            let (found, message) = read_again(world, round).await;
            if found == reason {
                return (round, message);
            }
            tokio::task::yield_now().await;
        }
        unreachable!("the rounds do not end")
    };
    timeout(LIMIT, read)
        .await
        .unwrap_or_else(|_| panic!("Ready never shows {reason}"))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn another_reader_of_the_queue_is_shown_until_it_has_gone() {
    let world = World::new().await;
    let url = world.aws.queue("shared").await;
    world.aws.set_visibility(&url, 1).await;
    world.aws.send(&url, "{}").await;
    // The other reader keeps what it has received.
    let sqs = world.aws.sqs();
    let receive = sqs.receive_message().queue_url(&url).visibility_timeout(3600);
    let taken = receive
        .wait_time_seconds(20)
        .send()
        .await
        .unwrap()
        .messages
        .unwrap()
        .remove(0);
    let spec = json!({"queue": {"url": url, "endpoint": world.aws.endpoint}});
    world.leaderboard_with("lb", 1, "Hosts", &spec).await;
    let controller = world.controller();

    let (rounds, message) = read_until(&world, reasons::QUEUE_SHARED).await;
    assert!(rounds >= 2, "one reading shows nothing: {rounds}");
    for part in [url.as_str(), "aws pipes list-pipes", "arn:aws:sqs:", "queue.foreign"] {
        assert!(message.contains(part), "{message}");
    }
    // A new process does not forget it.
    drop(controller);
    let _controller = world.controller();
    assert_eq!(read_again(&world, 1).await.0, reasons::QUEUE_SHARED);
    let delete = sqs
        .delete_message()
        .queue_url(&url)
        .receipt_handle(taken.receipt_handle.unwrap());
    delete.send().await.unwrap();
    read_until(&world, reasons::READY).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_only_observed_is_run_and_compared_and_never_written_to_evalai() {
    let world = World::new().await;
    let spec = json!({"evalai": {"mode": "Observe"}, "storage": {"prefix": "observe/"}});
    world.leaderboard_with("lb", 1, "Hosts", &spec).await;
    let (pk, name) = world.submit("lb", 1).await;
    // The other program was faster.
    set(&world, pk, Status::Finished);
    let results = json!({"_checkpoint": {"progress": [2, 2], "records": []}}).to_string();
    world
        .archive(pk)
        .put("agent/agent_results.json", results.into_bytes())
        .await
        .unwrap();
    let _controller = world.controller();
    world.run_that_crashes(pk, &name).await;
    let differs = |status: &SubmissionStatus| {
        let compared = conditions::get(&status.conditions, conditions::COMPARED);
        compared.is_some_and(|c| c.status == "False" && c.reason == reasons::DIFFERENT_END)
    };
    world.until(&name, "the ends are compared", differs).await;
    let status = world.api::<Submission>().get(&name).await.unwrap().status.unwrap();
    assert_eq!(status.state, Some(State::Failed));
    let compared = conditions::get(&status.conditions, conditions::COMPARED).unwrap();
    let words = "and the other program's results have 2 of 2.";
    assert!(compared.message.ends_with(words), "{}", compared.message);
    assert_eq!(
        status.results_url.as_deref(),
        Some(format!("s3://{}/observe/{pk}", world.bucket).as_str())
    );
    assert_eq!(world.evalai.state().submissions[&pk].status, Status::Finished);
    let written: Vec<_> = world
        .evalai
        .requests()
        .into_iter()
        .filter(|entry| entry.method != "GET")
        .collect();
    assert!(written.is_empty(), "{written:?}");
}
