//! What participants try with the files that a host's evaluators read: those that an agent leaves, and uploaded ones. Each ends as it must:
//! state, reason, class, charge, and what must not have been read or started.
//!
//! local/games/README.md says what each agent does.

use std::fs;
use std::process::Command;
use std::time::Duration;

use evalai_stand_in::Knobs;
use evalai_stand_in::faults::{Failure, Fault, When};
use evalai_stand_in::log::Entry;
use evalai_stand_in::state::State as Rows;
use futures::FutureExt;
use jiff::Timestamp;
use k8s_openapi::api::core::v1::{ContainerStatus, Pod};
use kube::ResourceExt;
use leaderboard_api::Submission;
use serde_json::{Value, json};

use super::containers::assert_own_words;
use super::matrix::{Case, together};
use super::modes::{ACCURACY, LIMIT, assert_exact, example, image, phase, predictions, submit, submitted, tracks};
use crate::evalai::{Evalai, FIRST_PHASE};
use crate::operator::{bridge, controller};
use crate::scene::{Scene, containers, lay_over, reason, scenario, score};

const WIDTH: usize = 4;
/// Agents of a Leaderboard, each of which its track names.
const KINDS: [&str; 8] = [
    "link-labels",
    "link-dataset",
    "fifo",
    "nothing",
    "sparse",
    "many",
    "search",
    "forge",
];
const REFUSED: &str = "Failed InputInvalid (participant, charged); no evaluator has started";
/// Accuracy of a guess that is always the same: (40 + 38) / 200.
const BLIND: &str = "0.39";
/// How long the agent that forges stays when it has forged, as the kubelet's whole seconds show it.
const LINGERS: Duration = Duration::from_secs(1);
/// Most bytes of an uploaded file, as the example's Leaderboard has it.
const LARGEST: usize = 1 << 20;
/// What an address of a file has that the stand-in of EvalAI gives out once others have expired.
const SIGNATURE: &str = "signature=";

/// Runs a test with a Leaderboard of agents that leave files, at most 1000 of 16 MiB. A crash is the end.
async fn with_agents(name: &str, body: impl AsyncFnOnce(&Scene)) {
    scenario(name, async |scene: &Scene| {
        let change = json!({
            "evaluation": {"container": {"input": {"maxBytes": "16Mi", "maxFiles": 1000}}},
            "tracks": tracks(&KINDS, &json!({"metric": "accuracy"})),
            "retries": {"perWorker": 0},
        });
        let spec = example(&scene.lab, "classification", change);
        scene.leaderboard("lb", spec).await;
        let _controller = controller(scene);
        body(scene).await;
    })
    .await;
}

/// Submits an agent of this kind, under its name.
async fn submit_agent(scene: &Scene, kind: &str) {
    let agent = json!({"image": image(&scene.lab, "classification/agent:hostile")});
    submit(scene, kind, "lb", kind, agent).await;
}

/// The files of an agent are refused with these words.
async fn refused(scene: &Scene, kind: &str, name: &'static str, says: &str) {
    let mut case = Case::open(name, REFUSED);
    submit_agent(scene, kind).await;
    let ended = case.ends(scene, kind, LIMIT).await;
    let failure = ended.status.as_ref().and_then(|status| status.failure.as_ref());
    let message = failure.map_or("", |failure| failure.message.as_str());
    assert!(message.contains(says), "{kind}: {message}");
    let keys = scene.cloud.keys(kind).await;
    let is_evaluators = |key: &&String| key.starts_with("input/") || key.ends_with("console.log");
    let theirs: Vec<&String> = keys.keys().filter(is_evaluators).collect();
    let theirs = if theirs.is_empty() {
        "no evaluator has started".to_owned()
    } else {
        format!("{theirs:?}")
    };
    case.also(&theirs);
    assert_own_words(scene, kind, kind).await;
    case.close();
}

#[tokio::test]
async fn a_link_to_the_labels_is_refused() {
    with_agents("inputs-link", async |scene: &Scene| {
        let no_file = "can't be taken: it is neither a regular file nor a folder";
        let cases = [
            (
                "link-labels",
                "agent leaves a link to the labels",
                "predictions.csv in /submission",
            ),
            (
                "link-dataset",
                "agent leaves a link to the dataset",
                "data in /submission",
            ),
            ("fifo", "agent leaves a pipe", "predictions.csv in /submission"),
        ];
        let cases = cases.map(|(kind, name, file)| async move {
            refused(scene, kind, name, &format!("{file} {no_file}")).await;
        });
        let nothing = refused(scene, "nothing", "agent leaves nothing", "has left no file");
        let cases = cases
            .map(FutureExt::boxed_local)
            .into_iter()
            .chain([nothing.boxed_local()]);
        together(WIDTH, cases.collect()).await;
    })
    .await;
}

#[tokio::test]
async fn a_file_of_ten_gigabytes_is_refused() {
    with_agents("inputs-sparse", async |scene: &Scene| {
        let says = "10737418240 of them in predictions.csv";
        refused(scene, "sparse", "agent leaves ten gigabytes", says).await;
    })
    .await;
}

#[tokio::test]
async fn more_files_than_the_bound_are_refused() {
    with_agents("inputs-many", async |scene: &Scene| {
        let says = "/submission has 1001 files, more than the 1000 ";
        refused(scene, "many", "agent leaves 1001 files", says).await;
    })
    .await;
}

#[tokio::test]
async fn an_agent_of_a_batch_cannot_reach_labels_or_evaluators() {
    with_agents("inputs-search", async |scene: &Scene| {
        let mut case = Case::open(
            "agent that runs first looks for labels and evaluators",
            "Finished; found: nothing",
        );
        submit_agent(scene, "search").await;
        let ended = case.ends(scene, "search", LIMIT).await;
        assert_exact(&ended, ("accuracy", ACCURACY), "200/200");
        case.also(&printed(scene, "search", "found: ").await);
        case.close();
    })
    .await;
}

/// The line of an agent's log that begins so.
async fn printed(scene: &Scene, run: &str, begins: &str) -> String {
    let log = scene.cloud.text(run, "agent/agent1/leaderboard.log").await;
    let line = log.lines().find(|line| line.starts_with(begins));
    line.unwrap_or_else(|| panic!("{run}: no line begins with {begins}: {log}"))
        .to_owned()
}

#[tokio::test]
async fn a_forged_done_mark_starts_no_evaluator() {
    with_agents("inputs-forge", async |scene: &Scene| {
        let mut case = Case::open(
            "agent that runs first forges marks of the end and results",
            "Finished; 0.39; the evaluators have started after its end",
        );
        submit_agent(scene, "forge").await;
        let ended = case.ends(scene, "forge", LIMIT).await;
        case.also(score(&ended));
        assert_exact(&ended, ("accuracy", BLIND), "200/200");
        printed(scene, "forge", "forged: ").await;
        let all = containers(&scene.pod("forge").await);
        let [begun, end] = times(&all, "agent-1");
        let (begun, end) = (begun.unwrap(), end.unwrap());
        let lived: Duration = end.duration_since(begun).try_into().unwrap();
        assert!(lived >= LINGERS, "the agent was there for {lived:?}");
        let evaluators = ["evaluator-1", "evaluator-2"].map(|name| times(&all, name)[0].unwrap());
        case.also(if evaluators.iter().all(|start| *start >= end) {
            "the evaluators have started after its end"
        } else {
            "an evaluator has started before its end"
        });
        case.close();
    })
    .await;
}

/// When the only life of a container began and ended, as far as it has.
fn times(all: &[ContainerStatus], name: &str) -> [Option<Timestamp>; 2] {
    let found = all.iter().find(|container| container.name == name).unwrap();
    assert_eq!(found.restart_count, 0, "{name} has started once");
    let state = found.state.clone().unwrap_or_default();
    let (running, ended) = (state.running.unwrap_or_default(), state.terminated.unwrap_or_default());
    let start = running.started_at.or(ended.started_at);
    [start, ended.finished_at].map(|time| time.map(|time| time.0))
}

/// Runs a test with EvalAI and a Leaderboard of uploaded files; `change` is laid over that of the example.
async fn with_uploads(name: &str, change: Value, body: impl AsyncFnOnce(&Scene, &Evalai)) {
    scenario(name, async |scene: &Scene| {
        let evalai = Evalai::start_for_files(scene, false).await;
        let mut spec = example(&scene.lab, "predictions", json!({"tracks": phase()}));
        lay_over(&mut spec, change);
        scene.evalai_leaderboard("lb", &evalai, spec).await;
        let _operator = (controller(scene), bridge(scene));
        scene.ready("lb").await;
        body(scene, &evalai).await;
    })
    .await;
}

#[tokio::test]
async fn an_uploaded_file_that_is_too_large_is_the_participants() {
    with_uploads("inputs-large", json!({}), async |scene: &Scene, evalai: &Evalai| {
        let mut case = Case::open(
            "uploaded file that is too large",
            "Failed InputInvalid (participant, charged); EvalAI failed; no Job",
        );
        let pk = evalai.upload(&vec![b'x'; LARGEST + 1], FIRST_PHASE).await;
        let ended = case.ends(scene, &format!("submission-{pk}"), LIMIT).await;
        case.evalai(evalai.submission(pk).status);
        let failure = ended.status.unwrap().failure.unwrap();
        let says = format!("more than the {LARGEST} bytes");
        assert!(failure.message.contains(&says), "{}", failure.message);
        case.also(if scene.jobs().await.is_empty() {
            "no Job"
        } else {
            "a Job"
        });
        let keys = scene.cloud.keys(&pk.to_string()).await;
        assert!(!keys.contains_key("input/file"), "{keys:?}");
        case.close();
    })
    .await;
}

#[tokio::test]
async fn an_address_that_expired_is_read_anew() {
    let paused = json!({"paused": true});
    with_uploads("inputs-expired", paused, async |scene: &Scene, evalai: &Evalai| {
        let mut case = Case::open(
            "address of an uploaded file that has expired while it waited",
            "Pending FetchingInput; Finished; EvalAI finished; read twice, without a token",
        );
        let pk = evalai.upload(predictions(), FIRST_PHASE).await;
        let name = format!("submission-{pk}");
        let waits = |s: &Submission| reason(s) == "Paused";
        scene.submission(&name, "its row is known", LIMIT, waits).await;
        evalai.handle.with_state(Rows::expire_addresses);
        // Also if its row has been read again since.
        evalai.handle.set_knobs(Knobs {
            fail_next: vec![Fault {
                method: Some("GET".to_owned()),
                path_prefix: Some("/media/".to_owned()),
                answer: Failure::Status(403),
                times: 1,
                when: When::Before,
            }],
            ..Knobs::default()
        });
        scene.change_leaderboard("lb", &json!({"paused": false})).await;
        case.shows(scene, &name, "FetchingInput", "answers 403").await;
        let ended = case.ends(scene, &name, LIMIT).await;
        case.evalai(evalai.submission(pk).status);
        assert_exact(&ended, ("accuracy", ACCURACY), "1/1");
        let reads = evalai.handle.requests().into_iter();
        let reads: Vec<Entry> = reads.filter(|entry| entry.path.starts_with("/media/")).collect();
        let answers: Vec<_> = reads.iter().map(|read| (read.status, read.token.as_deref())).collect();
        case.also(if answers == [(Some(403), None), (Some(200), None)] {
            "read twice, without a token"
        } else {
            "read otherwise"
        });
        assert!(reads[1].path.contains(SIGNATURE), "{reads:?}");
        assert_nobody_reads_an_address(scene, &ended).await;
        case.close();
    })
    .await;
}

/// An address that gives a file out is in no status, event or log.
async fn assert_nobody_reads_an_address(scene: &Scene, submission: &Submission) {
    let mut texts = vec![json!(submission).to_string()];
    let events = scene.events(&submission.name_any()).await.into_iter();
    texts.extend(events.filter_map(|event| event.note));
    let logs = fs::read_dir(&scene.logs).unwrap().map(|entry| entry.unwrap().path());
    let logs: Vec<_> = logs.map(|path| fs::read_to_string(path).unwrap()).collect();
    assert!(logs.len() >= 2, "controller and bridge have logs");
    texts.extend(logs);
    for text in texts {
        let line = text.lines().find(|line| line.contains(SIGNATURE));
        assert_eq!(line, None, "a secret address is shown");
    }
}

/// The evaluator, which reads text, refuses it. No program of the operator unpacks it.
#[tokio::test]
async fn an_archive_bomb_reaches_no_program_of_the_operator() {
    with_uploads("inputs-bomb", json!({}), async |scene: &Scene, evalai: &Evalai| {
        let mut case = Case::open(
            "uploaded archive that unpacks to 900 MiB",
            "Failed InvalidResults (participant, charged); EvalAI failed; each container has started once",
        );
        let bomb = bomb();
        let pk = evalai.upload(&bomb, FIRST_PHASE).await;
        let name = format!("submission-{pk}");
        let pod = scene.first_pod(&name, LIMIT).await.name_any();
        let ended = case.ends(scene, &name, LIMIT).await;
        case.evalai(evalai.submission(pk).status);
        let status = ended.status.unwrap();
        assert_eq!(status.input, Some(submitted(&bomb)), "it is stored as it came");
        let size = scene.cloud.keys(&pk.to_string()).await.get("input/file").copied();
        assert_eq!(size, status.input.map(|input| input.size));
        // The second byte of an archive.
        let failure = status.failure.unwrap();
        let says = "can't decode byte 0x8b in position 1";
        assert!(failure.message.contains(says), "{}", failure.message);
        let pod = scene.api::<Pod>().get(&pod).await.unwrap();
        let has_crashed = containers(&pod).iter().any(|container| container.restart_count > 0);
        case.also(if has_crashed {
            "some have started again"
        } else {
            "each container has started once"
        });
        case.close();
    })
    .await;
}

/// 900 archives of a mebibyte of zeros each, which are one archive.
fn bomb() -> Vec<u8> {
    let program = "import gzip, sys; sys.stdout.buffer.write(gzip.compress(bytes(1 << 20)) * 900)";
    let made = Command::new("python3").args(["-c", program]).output().unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    assert!(made.stdout.len() < LARGEST, "it has {} bytes", made.stdout.len());
    made.stdout
}
