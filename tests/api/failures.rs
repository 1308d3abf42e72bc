//! Failures as the whole controller meets them. An agent prints the private routes and crashes: hosts find its log, and participants
//! don't. A node falls silent.
//!
//! The real controller against a real API server and both stand-ins; the test plays the Job controller, the kubelet and
//! logcopy.
#![cfg(test)]

use std::time::Duration;

use evalai_stand_in::model::Status;
use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::coordination::v1::Lease;
use k8s_openapi::api::core::v1::Pod;
use kube::ResourceExt;
use kube::api::{DeleteParams, PostParams};
use kube::runtime::wait::await_condition;
use leaderboard_api::names::FAILURE_LOG_KEY;
use leaderboard_api::{
    Attempt, JobNumber, Leaderboard, Reason, State, Submission, SubmissionStatus, conditions, names,
};
use leaderboard_aws::archive::Archive;
use leaderboard_contract::report::{OWNER_KEY, Owner};
use serde_json::json;
use tokio::time::timeout;

use super::bridge::{LIMIT, StandIn};
use super::world::{HOST, PARTICIPANT, ROUTE, World, ago};
use crate::support::player::ROUTES;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn routes_that_an_agent_prints_are_for_hosts_unless_they_want_it_otherwise() {
    let world = World::new().await;
    world.leaderboard("closed", 1, "Hosts").await;
    world.leaderboard("open", 2, "Participants").await;
    let _controller = world.controller();

    for (leaderboard, phase, is_open) in [("closed", 1, false), ("open", 2, true)] {
        let (pk, name) = world.submit(leaderboard, phase).await;
        world.run_that_crashes(pk, &name).await;
        let failed = world
            .evalai
            .wait_until(|state, _| state.submissions[&pk].status == Status::Failed);
        timeout(LIMIT, failed).await.expect("EvalAI hears of the failure");

        let (own, fetched) = world.fetched(pk, PARTICIPANT).await;
        assert!(own.get("environment_log_file").is_none());
        assert!(
            fetched.contains("AgentCrashed (participant): Agent 1 crashed once."),
            "{fetched}"
        );
        assert_eq!(fetched.contains("4711"), is_open, "{leaderboard}: {fetched}");
        assert!(
            !fetched.contains("leaderboard.log"),
            "only hosts can read it: {fetched}"
        );
        assert_eq!(own["stdout_file"].as_str().map(|_| ()), Some(()));

        let (row, all) = world.fetched(pk, HOST).await;
        assert!(row["environment_log_file"].is_string());
        let kept = world.archive(pk).get(FAILURE_LOG_KEY, 1 << 20).await.unwrap().unwrap();
        let kept = String::from_utf8(kept.bytes).unwrap();
        let text = format!("loading routes\n{ROUTE}\nTraceback: boom");
        assert!(
            kept.starts_with("The end of agent-1's log in attempt 1;") && kept.ends_with(&text),
            "{kept}"
        );
        assert!(all.contains(&kept), "{all}");
        let shown = world.shown(&name).await;
        assert!(
            shown.contains("Agent 1 crashed once") && !shown.contains("4711"),
            "{shown}"
        );
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_result_that_a_hosts_rerun_cancels_in_evalai_is_shown_so() {
    let world = World::new().await;
    world
        .leaderboard_with("lb", 1, "Hosts", &json!({"evaluation": {"carla": {"routes": ROUTES}}}))
        .await;
    let _controller = world.controller();
    let (pk, name) = finishes(&world).await;
    // The status has whole seconds, and a list within the same one may be older than the result.
    tokio::time::sleep(Duration::from_secs(2)).await;
    let (new, _) = world.rerun("lb", 1, pk).await;
    let statuses = [pk, new].map(|pk| world.evalai.with_state(|state| state.submissions[&pk].status));
    assert_eq!(statuses, [Status::Cancelled, Status::Submitted]);
    let published = |s: &SubmissionStatus| conditions::get(&s.conditions, conditions::PUBLISHED).cloned();
    let is_shown = |s: &SubmissionStatus| published(s).is_some_and(|c| c.reason == Reason::CancelledInEvalAI);
    world.until(&name, "its result counts no more", is_shown).await;
    let status = world.api::<Submission>().get(&name).await.unwrap().status.unwrap();
    assert_eq!(status.state, Some(State::Finished), "its result stays");
}

/// A submission whose result EvalAI has.
async fn finishes(world: &World) -> (u64, String) {
    let (pk, name) = world.submit("lb", 1).await;
    let player = world.play(Duration::from_millis(500));
    let runs = |status: &SubmissionStatus| status.progress.as_ref().is_some_and(|progress| progress.done > 0);
    world.until(&name, "a route is done", runs).await;
    player.fall_the_curtain();
    let is_published = |s: &SubmissionStatus| s.times.published.is_some();
    world.until(&name, "EvalAI has the end", is_published).await;
    (pk, name)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn after_a_controller_that_did_not_confirm_its_requests_everybody_reads_until_when_nothing_is_written() {
    let world = World::new().await;
    world.leaderboard("lb", 1, "Hosts").await;
    // It was killed: its Lease has a holder, and ends by itself.
    let lease = json!({
        "metadata": {"name": "operator"},
        "spec": {"holderIdentity": "gone", "leaseTransitions": 1},
    });
    let lease: Lease = serde_json::from_value(lease).unwrap();
    world.api().create(&PostParams::default(), &lease).await.unwrap();
    let _controller = world.controller();

    let text = "Nothing is written to EvalAI before ";
    let says = |board: Option<&Leaderboard>| {
        let status = board.and_then(|board| board.status.as_ref());
        let ready = status.and_then(|s| conditions::get(&s.conditions, conditions::READY));
        ready.is_some_and(|c| c.status == "True" && c.message.starts_with(text))
    };
    let seen = timeout(LIMIT, await_condition(world.api::<Leaderboard>(), "lb", says)).await;
    seen.expect("Ready stays True and has a note").unwrap();

    let (pk, name) = world.submit("lb", 1).await;
    world.run_that_crashes(pk, &name).await;
    let waits = |s: &SubmissionStatus| {
        let published = conditions::get(&s.conditions, conditions::PUBLISHED);
        published.is_some_and(|c| {
            c.status == "False" && c.reason == Reason::WaitingForPreviousController && c.message.starts_with(text)
        })
    };
    world.until(&name, "Published says until when", waits).await;
    let writes = world.evalai.requests().into_iter().filter(|r| r.method != "GET");
    assert_eq!(writes.count(), 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_silent_node_is_replaced_before_the_grace_and_costs_no_attempt() {
    let world = World::new().await;
    world.leaderboard("lb", 1, "Hosts").await;
    let _controller = world.controller_with_nodes();
    let cluster = world.cluster().on_node("silent");
    let silent = json!({
        "type": "Ready", "status": "Unknown", "reason": "NodeStatusUnknown", "lastTransitionTime": ago(100),
    });
    cluster.node(silent).await;

    let (pk, name) = world.submit("lb", 1).await;
    let job = world.job(&name, 0).await;
    let pod = cluster.running_pod(&job).await.name_any();
    let runs = |s: &SubmissionStatus| s.state == Some(State::Running);
    world.until(&name, "it runs", runs).await;
    let is_told = |status: &'static str| {
        world
            .evalai
            .wait_until(move |state, _| state.submissions[&pk].status.as_str() == status)
    };
    timeout(LIMIT, is_told("running"))
        .await
        .expect("EvalAI hears of the run");
    // The eviction by the node's taint deletes the Pod like this. No kubelet is there to end it; its grace is ten minutes.
    let deleted = world.api::<Pod>().delete(&pod, &DeleteParams::default()).await.unwrap();
    assert!(deleted.left().unwrap().metadata.deletion_timestamp.is_some());
    let next = world.job(&name, 1).await;

    let gone = world.api::<Pod>().get_opt(&pod).await.unwrap();
    assert_eq!(gone, None, "removed by force");
    let mark = world.archive(pk).get(OWNER_KEY, 1024).await.unwrap().unwrap();
    let mark = Owner::parse(&mark.bytes).unwrap();
    assert!(
        mark.owner.starts_with("controller-"),
        "what it may still write counts for nobody"
    );
    cluster.running_pod(&next).await;
    let job = next.name_any();
    let is_back = |s: &SubmissionStatus| runs(s) && s.job_name.as_ref() == Some(&job);
    world.until(&name, "it runs again", is_back).await;
    let status = world.api::<Submission>().get(&name).await.unwrap().status.unwrap();
    assert_eq!(
        (status.attempt, status.retry, status.failure),
        (Some(Attempt(1)), 1, None)
    );
    assert!(status.workers.iter().all(|pair| pair.crashes == 0));
    let patches = world.evalai.requests().into_iter().filter(|r| r.method == "PATCH");
    let told = patches.filter(|r| r.body["submission_status"] == json!("running"));
    assert_eq!(told.count(), 1, "EvalAI keeps saying running");
}

#[tokio::test]
async fn of_a_stored_log_only_the_end_is_read() {
    let stand_in = StandIn::start().await;
    let bucket = stand_in.name("tails");
    let s3 = stand_in.aws.s3(None, Some(&stand_in.endpoint));
    s3.create_bucket().bucket(&bucket).send().await.unwrap();
    let archive = Archive::new(s3, bucket, "runs/77/");
    let log: Vec<u8> = (0..100_000u32)
        .flat_map(|n| format!("line {n}\n").into_bytes())
        .collect();
    archive.put("long", log.clone()).await.unwrap();
    archive.put("short", b"one\n".to_vec()).await.unwrap();
    archive.put("empty", Vec::new()).await.unwrap();
    for (key, tail) in [
        ("long", Some(log[log.len() - 65_536..].to_vec())),
        ("short", Some(b"one\n".to_vec())),
        ("empty", Some(Vec::new())),
        ("missing", None),
    ] {
        assert_eq!(archive.tail(key, 65_536).await.unwrap(), tail, "{key}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_can_never_be_an_image_fails_at_once_and_the_participant_reads_why() {
    let world = World::new().await;
    world.leaderboard("lb", 1, "Hosts").await;
    let _controller = world.controller();
    let uploaded = [
        json!(null),
        json!(""),
        json!(5),
        json!({"a": 1}),
        json!("  "),
        json!("x".repeat(513)),
        json!("r/Team:1"),
        json!("r/té:1"),
        json!("two words"),
    ];
    let mut submitted = Vec::new();
    for uploaded in &uploaded {
        submitted.push(world.submit_image("lb", 1, uploaded, &json!(null)).await);
    }
    let (good, bad) = (json!("r/team-a:1"), json!("r/Team:1"));
    submitted.push(world.submit_image("lb", 1, &good, &bad).await);
    for (pk, name) in submitted {
        let failed = world
            .evalai
            .wait_until(|state, _| state.submissions[&pk].status == Status::Failed);
        timeout(LIMIT, failed).await.expect("EvalAI hears of the failure");
        let (_, fetched) = world.fetched(pk, PARTICIPANT).await;
        assert!(fetched.contains("ImageInvalid (participant): The subm"), "{fetched}");
        let is_published = |s: &SubmissionStatus| conditions::is_true(&s.conditions, conditions::PUBLISHED);
        world.until(&name, "it is published", is_published).await;
        let job = world
            .api::<Job>()
            .get_opt(&names::job(&name, JobNumber::first(Attempt(1))))
            .await
            .unwrap();
        assert_eq!(job, None);
    }
}
