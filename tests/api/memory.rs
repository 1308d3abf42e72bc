//! The memory of the controller's own process while many results with the largest texts are published, all of them stored while it
//! was away; and while it copies files that participants have uploaded.
#![cfg(test)]

use evalai_stand_in::model::Status;
use futures::StreamExt;
use kube::ResourceExt;
use kube::api::{Patch, PatchParams};
use leaderboard_api::{Submission, SubmissionStatus, SubmittedFile, conditions};
use leaderboard_contract::report::{REPORT_KEY, Report, StoredFile};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use tokio::time::Instant;

use super::intake::program::Program;
use super::rule_cases::container::by_container;
use super::world::{World, ago};
use crate::support::player::{self, ROUTES};

/// Results at once.
const RESULTS: usize = 50;
/// The largest text that is passed on.
const LARGEST: usize = 4 << 20;
/// Half of the chart's limit of the controller's memory, in KiB.
const LIMIT_KIB: u64 = 128 << 10;
const METADATA: &str = "evalai/metadata.json";

/// JSON of so many bytes in which each fourth is a quotation mark.
fn metadata(bytes: usize) -> String {
    let text = r#""a","#.repeat(bytes / 4 - 1);
    format!("[{text}1 ]")
}

/// A run that has finished and is stored, with the controller away since.
async fn ended(world: &World, text: &str) -> (u64, String) {
    let (pk, name) = world.submit("lb", 1).await;
    let api = world.api::<Submission>();
    let uid = api.get(&name).await.unwrap().uid().unwrap();
    let archive = world.archive(pk);
    archive.put(METADATA, text.as_bytes().to_vec()).await.unwrap();
    archive.put(REPORT_KEY, report(uid, text).into_bytes()).await.unwrap();
    let condition = |type_: &str, status: &str, reason: &str| json!({"type": type_, "status": status, "reason": reason, "message": "", "lastTransitionTime": ago(60)});
    let status = json!({"status": {
        "attempt": 1, "jobName": format!("{name}-1"), "track": "sensors",
        "times": {"submitted": ago(600), "accepted": ago(500), "started": ago(400), "finished": ago(60)},
        "plan": {
            "runId": pk.to_string(),
                "carla": {"version": "V2", "codename": "SENSORS", "slices": [{"first": 0, "last": 0}],
                    "routes": 1, "repetitions": 1, "contentsImage": "contents:1", "simulatorImage": "simulator:1"},
                "track": "sensors", "phase": 1,
            "storage": {"s3": {"bucket": world.bucket, "endpoint": world.aws.endpoint}},
            "image": "r/team-a:1",
        },
        "conditions": [
            condition("Accepted", "True", "Accepted"), condition("Archived", "True", "Stored"),
            condition("Finished", "True", "Finished"), condition("Published", "False", "Waiting"),
        ],
    }});
    let patched = api
        .patch_status(&name, &PatchParams::default(), &Patch::Merge(status))
        .await;
    patched.unwrap();
    (pk, name)
}

fn report(submission_uid: String, text: &str) -> String {
    let file = StoredFile {
        size: text.len() as u64,
        sha256: hex::encode(Sha256::digest(text.as_bytes())),
    };
    let report = Report {
        done: 1,
        total: 1,
        workers: Vec::new(),
        files: [(METADATA.to_owned(), file)].into(),
        ..player::report(submission_uid, "pod".into(), ROUTES)
    };
    serde_json::to_string(&report).unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn fifty_results_with_the_largest_texts_are_published_within_the_charts_limit_of_memory() {
    let world = World::new().await;
    world.leaderboard("lb", 1, "Hosts").await;
    let largest = metadata(LARGEST);
    assert_eq!(largest.len(), LARGEST);
    let too_large = format!("{largest} ");
    let all: Vec<_> = (0..RESULTS).map(|_| ended(&world, &largest)).collect();
    let all: Vec<(u64, String)> = futures::stream::iter(all).buffered(4).collect().await;
    let (_, left_out) = ended(&world, &too_large).await;

    let controller = Program::start("controller", "controller-0", &world.namespace).await;
    let is_published = |s: &SubmissionStatus| conditions::is_true(&s.conditions, conditions::PUBLISHED);
    let says = |s: &SubmissionStatus| {
        let published = conditions::get(&s.conditions, conditions::PUBLISHED);
        published.is_some_and(|c| {
            c.status == "True"
                && c.message
                    .starts_with("evalai/metadata.json was left out: it has 4194305 bytes")
        })
    };
    world
        .until(&left_out, "it is published without its text at once", says)
        .await;
    for (_, name) in &all {
        world.until(name, "it is published", is_published).await;
    }
    let most = controller.most_memory();
    println!(
        "{RESULTS} results with texts of {} MiB: at most {} MiB",
        LARGEST >> 20,
        most >> 10
    );
    assert!(
        most < LIMIT_KIB,
        "{most} KiB, more than the chart allows; {}",
        controller.log()
    );
    let is_finished = |pk: u64| {
        world
            .evalai
            .with_state(|state| state.submissions[&pk].status == Status::Finished)
    };
    assert!(all.iter().all(|(pk, _)| is_finished(*pk)));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_row_that_its_participant_has_filled_takes_no_memory_and_holds_nobody_up() {
    let world = World::new().await;
    world.leaderboard("lb", 1, "Hosts").await;
    let (filled, name) = world.submit("lb", 1).await;
    world.evalai.with_state(|state| {
        let row = state.submissions.get_mut(&filled).unwrap();
        row.job_name = vec![String::new(); 2_000_000];
    });
    let (_, other) = world.submit("lb", 1).await;

    let controller = Program::start("controller", "controller-0", &world.namespace).await;
    let is_accepted = |s: &SubmissionStatus| conditions::is_true(&s.conditions, conditions::ACCEPTED);
    world.until(&other, "the other one is accepted", is_accepted).await;
    // A list with the row is read, and the row alone is not: either may be the first to come.
    let is_unread = |s: &SubmissionStatus| s.message.as_deref().is_some_and(|m| m.contains("more than is read"));
    let is_known = |s: &SubmissionStatus| is_accepted(s) || is_unread(s);
    world.until(&name, "its row was asked for", is_known).await;
    let most = controller.most_memory();
    assert!(
        most < LIMIT_KIB,
        "{most} KiB, more than the chart allows; {}",
        controller.log()
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn two_uploaded_files_at_once_are_copied_within_the_charts_limit_of_memory() {
    two_uploads(96 << 20).await;
}

/// 1 GiB each, the default bound of an input. `make measure-uploads`.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "it takes 6 GiB of memory for the stand-ins, and minutes"]
async fn two_uploaded_files_of_a_gibibyte_at_once_are_copied_within_the_charts_limit_of_memory() {
    two_uploads(1 << 30).await;
}

async fn two_uploads(bytes: usize) {
    let world = World::new().await;
    world.evalai.with_state(|state| {
        state.seed.challenges[0].is_docker_based = false;
    });
    let spec = by_container(&json!({
        "evaluation": {"container": {"mode": "Predictions"}},
        "tracks": [{"name": "test", "phase": 1, "container": {"score": {"metric": "Driving score"}}}],
    }));
    world.leaderboard_with("lb", 1, "Hosts", &spec).await;
    let controller = Program::start("controller", "controller-0", &world.namespace).await;
    let began = Instant::now();
    let mut all = Vec::new();
    for fill in [1, 2] {
        let pk = world.upload(1, vec![fill; bytes]);
        all.push((world.object("lb", 1, pk, &Value::Null).await, fill));
    }
    for (name, fill) in all {
        let is_copied = |s: &SubmissionStatus| s.input.is_some() && s.job_name.is_some();
        world
            .until(&name, "its file is copied and its Job made", is_copied)
            .await;
        let status = world.api::<Submission>().get(&name).await.unwrap().status.unwrap();
        let expected = SubmittedFile {
            sha256: hex::encode(Sha256::digest(vec![fill; bytes])),
            size: i64::try_from(bytes).unwrap(),
        };
        assert_eq!(status.input, Some(expected), "{name}");
    }
    let most = controller.most_memory();
    println!(
        "two files of {} MiB in {:.1} s: at most {} MiB",
        bytes >> 20,
        began.elapsed().as_secs_f64(),
        most >> 10
    );
    assert!(
        most < LIMIT_KIB,
        "{most} KiB, more than the chart allows; {}",
        controller.log()
    );
}
