//! Memory that an object of real size takes in a cache.

use kube::ResourceExt;
use serde_json::{Value, json};

use crate::fixtures::{leaderboard, settings, with_job};
use crate::kubernetes::objects::{Job, Pod, Texts};
use crate::kubernetes::{Index, Item, Store, Watchable};
use crate::runtime::stores::owner_uid;
use leaderboard_api::{Attempt, JobNumber, Leaderboard, Submission};
use leaderboard_pod_spec::job::{JobInput, build_object};

/// As many as one page of a list has.
const COUNT: usize = 100;
/// A uid has so many characters.
const UID: &str = "1b4e28ba-2fa1-11d2-883f-0016d3cca427";

/// A Leaderboard with four pairs.
fn board() -> Leaderboard {
    let mut board = leaderboard("carla-2", "http://127.0.0.1:9");
    board.spec.evaluation.carla_mut().unwrap().pairs = 4;
    board
}

fn uid(number: usize) -> String {
    format!("{}{number:06}", &UID[..30])
}

/// An object as the API server stores it, with the fields that the server adds.
fn stored(mut object: Value, number: usize) -> Value {
    let meta = &mut object["metadata"];
    meta["uid"] = json!(uid(number));
    meta["resourceVersion"] = json!((1_000_000 + number).to_string());
    meta["creationTimestamp"] = json!("2026-01-01T00:00:00Z");
    let fields: Value = (0..60)
        .map(|n| (format!("f:field-{n}"), json!({})))
        .collect::<serde_json::Map<_, _>>()
        .into();
    meta["managedFields"] = json!([{"manager": "leaderboard-operator", "operation": "Apply", "fieldsV1": fields}]);
    object
}

fn submission(number: usize) -> Value {
    let (submission, _) = with_job(&format!("evalai-{number:06}"), &board());
    let mut object = json!(submission);
    object["status"]["conditions"] = ["Accepted", "Running", "Finished", "Published", "Recorded", "Stalled"]
        .map(|type_| {
            json!({"type": type_, "status": "False", "reason": "WaitingForAgents", "message": "Agents are started, one for each pair.",
                   "lastTransitionTime": "2026-01-01T00:00:00Z", "observedGeneration": 1})
        })
        .into();
    stored(object, number)
}

fn job(number: usize) -> Value {
    let (submission, _) = with_job(&format!("evalai-{number:06}"), &board());
    let plan = submission
        .status
        .as_ref()
        .and_then(|status| status.plan.as_ref())
        .unwrap();
    let mut object = json!(build_object(&JobInput {
        submission: &submission,
        leaderboard: &board(),
        plan,
        number: JobNumber::first(Attempt(1)),
        input: None,
        own: &settings().own,
        failed_nodes: &[],
        now: jiff::Timestamp::now(),
    }));
    object["status"] = json!({"active": 1, "ready": 1, "startTime": "2026-01-01T00:00:00Z"});
    stored(object, number)
}

fn pod(number: usize) -> Value {
    let mut template = job(number)["spec"]["template"].take();
    template["metadata"]["name"] = json!(format!("evalai-{number:06}-1-abcde"));
    template["metadata"]["namespace"] = json!("one");
    template["metadata"]["ownerReferences"] = json!([{"apiVersion": "batch/v1", "kind": "Job", "name": format!("evalai-{number:06}-1"), "uid": uid(number), "controller": true}]);
    template["spec"]["nodeName"] = json!("node-17");
    let statuses = |field: &str| -> Vec<Value> {
        let containers = template["spec"][field].as_array().unwrap().iter();
        let running = json!({"running": {"startedAt": "2026-01-01T00:00:05Z"}});
        let status = |container: &Value| {
            // Pods have all images in common but their agents'.
            let of_team = container["name"].as_str().unwrap().starts_with("agent-");
            let image_id = format!(
                "registry.example/images@sha256:{:064x}",
                if of_team { number } else { 0 }
            );
            json!({"name": container["name"], "image": container["image"], "imageID": image_id,
                   "containerID": format!("containerd://{UID}{UID}"), "ready": true, "restartCount": 0, "started": true,
                   "state": running, "lastState": {}})
        };
        containers.map(status).collect()
    };
    let (init, main) = (statuses("initContainers"), statuses("containers"));
    assert_eq!(init.len() + main.len(), 11);
    let condition =
        |type_: &str| json!({"type": type_, "status": "True", "lastTransitionTime": "2026-01-01T00:00:03Z"});
    let conditions = [
        "PodReadyToStartContainers",
        "Initialized",
        "Ready",
        "ContainersReady",
        "PodScheduled",
    ]
    .map(condition);
    template["status"] = json!({
        "phase": "Running", "hostIP": "10.0.0.1", "podIP": "10.1.0.1", "startTime": "2026-01-01T00:00:03Z",
        "conditions": conditions,
        "initContainerStatuses": init, "containerStatuses": main,
    });
    stored(template, number)
}

/// Decodes a page of a list as a watch does.
fn page<K: Watchable>(texts: &mut Texts, page: &str) -> Vec<K> {
    let items: Vec<Item<K>> = serde_json::from_str(page).unwrap();
    let read = items.into_iter().map(|item| {
        let mut object = item.object.unwrap();
        object.share(texts);
        object
    });
    read.collect()
}

fn text(of: fn(usize) -> Value) -> String {
    Value::Array((0..COUNT).map(of).collect()).to_string()
}

/// Bytes that the program has asked for and keeps, for each object of a cache.
fn kept<K: Watchable>(of: fn(usize) -> Value, index: Index<K>) -> (usize, u64) {
    let text = text(of);
    let (mut texts, mut cache) = (Texts::default(), None);
    let memory = allocation_counter::measure(|| {
        cache = Some(Store::of(page::<K>(&mut texts, &text), index));
    });
    assert_eq!(cache.unwrap().len(), COUNT);
    (
        text.len() / COUNT,
        u64::try_from(memory.bytes_current).unwrap() / COUNT as u64,
    )
}

#[test]
fn an_object_takes_little_in_a_cache() {
    let (job_text, job) = kept::<Job>(job, |_| None);
    let (pod_text, pod) = kept::<Pod>(pod, owner_uid);
    let (submission_text, submission) = kept::<Submission>(submission, |_| None);
    println!("Job: {job_text} -> {job}; Pod: {pod_text} -> {pod}; Submission: {submission_text} -> {submission} bytes");
    assert!(job_text > 15_000 && pod_text > 15_000, "{job_text} {pod_text}");
    assert!(job < 500, "a Job takes {job} bytes");
    assert!(pod < 1_900, "a Pod takes {pod} bytes");
    assert!(submission < 3_000, "a Submission takes {submission} bytes");
}

#[test]
fn submissions_have_one_copy_of_the_texts_of_their_conditions() {
    let read = page::<Submission>(&mut Texts::default(), &text(submission));
    let conditions = |submission: &Submission| submission.status.clone().unwrap().conditions;
    for (mut one, mut other) in conditions(&read[0]).into_iter().zip(conditions(&read[1])) {
        let texts = one.shared_texts().into_iter().zip(other.shared_texts());
        assert!(texts.into_iter().all(|(one, other)| one.is_copy_of(other)));
    }
}

/// `cargo test --release -- --ignored --nocapture what_5000` prints the memory of the process.
#[test]
#[ignore = "prints figures of this machine"]
fn what_5000_objects_of_each_kind_take() {
    let resident = || {
        let status = std::fs::read_to_string("/proc/self/status").unwrap();
        let line = status
            .lines()
            .find(|line| line.starts_with("RssAnon"))
            .unwrap()
            .to_owned();
        line.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap() / 1024
    };
    let (jobs, pods, submissions) = (text(job), text(pod), text(submission));
    let before = resident();
    let (mut texts, mut all) = (Texts::default(), (Vec::new(), Vec::new(), Vec::new()));
    for _ in 0..5000 / COUNT {
        all.0.extend(page::<Job>(&mut texts, &jobs.clone()));
        all.1.extend(page::<Pod>(&mut texts, &pods.clone()));
        all.2.extend(page::<Submission>(&mut texts, &submissions.clone()));
    }
    let name = all.2.first().map(ResourceExt::name_any);
    println!(
        "5,000 Jobs, Pods and Submissions ({name:?} …): {} MB, {before} MB before they were decoded",
        resident()
    );
}
