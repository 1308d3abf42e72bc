//! Plays what a cluster has besides its API server: the Job controller, kubelets, and the programs in the Pods as S3 and the
//! controller see them. Each Job gets a Pod that runs at once, reports a route more in every round, and ends when the curtain
//! falls or when its Pod is asked to stop.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use futures::{Stream, StreamExt};
use jiff::Timestamp;
use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::core::v1::{Container, Node, Pod};
use kube::api::{Api, Patch, PatchParams, PostParams};
use kube::runtime::{WatchStreamExt, watcher};
use kube::{Client, Resource, ResourceExt};
use leaderboard_api::{Attempt, PairState, names};
use leaderboard_operator::pod::report::{REPORT_KEY, Report, ReportPair, SCHEMA};
use leaderboard_operator::pod::run::Stop;
use leaderboard_operator::services::archive::Archive;
use serde_json::{Value, json};
use tokio::sync::{oneshot, watch};
use tokio::task::JoinHandle;

/// The node of all Pods.
const NODE: &str = "played";
/// Routes of every run.
pub const ROUTES: u32 = 1000;

/// What the play needs.
pub struct Props {
    pub client: Client,
    pub namespace: String,
    pub s3: aws_sdk_s3::Client,
    pub bucket: String,
    /// Time between two reports.
    pub period: Duration,
    /// Metrics of a result.
    pub labels: Vec<String>,
}

/// When what was seen, by name of the Submission.
#[derive(Clone, Debug, Default)]
pub struct Seen {
    /// The stop reached the Pod.
    pub asked_to_stop: BTreeMap<String, Timestamp>,
    /// The last container has ended, and the Job with it.
    pub ended: BTreeMap<String, Timestamp>,
}

/// A running play.
pub struct Player {
    stage: Arc<Stage>,
    watches: [JoinHandle<()>; 2],
}

struct Stage {
    props: Props,
    curtain: watch::Sender<bool>,
    /// Receivers of a stop, by name of the Pod.
    cues: Mutex<BTreeMap<String, oneshot::Sender<()>>>,
    seen: Mutex<Seen>,
}

impl Player {
    pub fn start(props: Props) -> Self {
        let stage = Arc::new(Stage {
            props,
            curtain: watch::Sender::new(false),
            cues: Mutex::default(),
            seen: Mutex::default(),
        });
        let jobs = tokio::spawn(watch_jobs(Arc::clone(&stage)));
        let pods = tokio::spawn(watch_pods(Arc::clone(&stage)));
        Self {
            stage,
            watches: [jobs, pods],
        }
    }

    /// Every run that is left comes to its own end.
    pub fn fall_the_curtain(&self) {
        self.stage.curtain.send_replace(true);
    }

    pub fn seen(&self) -> Seen {
        self.stage.seen.lock().unwrap().clone()
    }
}

impl Drop for Player {
    fn drop(&mut self) {
        for watch in &self.watches {
            watch.abort();
        }
    }
}

/// Every object as it appears and changes.
fn all<K>(api: Api<K>) -> impl Stream<Item = K> + Send
where
    K: Resource + Clone + std::fmt::Debug + serde::de::DeserializeOwned + Send + 'static,
{
    let events = watcher(api, watcher::Config::default()).default_backoff();
    events.applied_objects().filter_map(async |event| event.ok())
}

/// A node whose kubelet speaks. It stays for the next player.
async fn make_node(client: &Client) {
    let node = json!({
        "metadata": {"name": NODE},
        "status": {"conditions": [{"type": "Ready", "status": "True", "reason": "KubeletReady"}]},
    });
    let node: Node = serde_json::from_value(node).unwrap();
    match Api::all(client.clone()).create(&PostParams::default(), &node).await {
        Err(kube::Error::Api(status)) if status.is_already_exists() => {}
        made => drop(made.unwrap()),
    }
}

async fn watch_jobs(stage: Arc<Stage>) {
    make_node(&stage.props.client).await;
    let mut known = std::collections::BTreeSet::new();
    let mut jobs = std::pin::pin!(all(stage.jobs()));
    while let Some(job) = jobs.next().await {
        if known.insert(job.uid()) {
            tokio::spawn(play(Arc::clone(&stage), job));
        }
    }
}

async fn watch_pods(stage: Arc<Stage>) {
    let mut pods = std::pin::pin!(all(stage.pods()));
    while let Some(pod) = pods.next().await {
        if !pod.annotations().contains_key(names::ANNOTATION_STOP) {
            continue;
        }
        let cue = stage.cues.lock().unwrap().remove(&pod.name_any());
        if let Some(cue) = cue {
            let submission = pod.labels()[names::LABEL_SUBMISSION].clone();
            let mut seen = stage.seen.lock().unwrap();
            seen.asked_to_stop.insert(submission, Timestamp::now());
            drop(seen);
            let _ = cue.send(());
        }
    }
}

impl Stage {
    fn jobs(&self) -> Api<Job> {
        Api::namespaced(self.props.client.clone(), &self.props.namespace)
    }

    fn pods(&self) -> Api<Pod> {
        Api::namespaced(self.props.client.clone(), &self.props.namespace)
    }
}

async fn play(stage: Arc<Stage>, job: Job) {
    let name = job.name_any();
    let (cue, mut stop) = oneshot::channel();
    stage.cues.lock().unwrap().insert(name.clone(), cue);
    let pod = stage
        .pods()
        .create(&PostParams::default(), &pod_of(&job))
        .await
        .unwrap();
    let running = json!({"status": pod_status("Running", &pod, &running_state())});
    set_status(&stage.pods(), &name, &running).await;
    let started = json!({"status": {"active": 1, "ready": 1, "startTime": Timestamp::now().to_string()}});
    set_status(&stage.jobs(), &name, &started).await;

    let archive = Archive::new(
        stage.props.s3.clone(),
        &stage.props.bucket,
        format!("{}/", job.labels()[names::LABEL_RUN]),
    );
    let mut curtain = stage.curtain.subscribe();
    // Not all at the same moment, as Pods are not.
    let first = tokio::time::Instant::now() + stage.props.period.mul_f64(fastrand::f64());
    let mut tick = tokio::time::interval_at(first, stage.props.period);
    let mut report = first_report(&stage, &job, &pod);
    let stopped = loop {
        tokio::select! {
            biased;
            _ = &mut stop => break Some(Stop::Cancel),
            _ = curtain.wait_for(|down| *down) => break None,
            _ = tick.tick() => {}
        }
        report.round += 1;
        report.done = u32::try_from(report.round).unwrap().min(ROUTES - 1);
        put(&stage, &archive, &mut report).await;
    };
    report.is_final = true;
    report.round += 1;
    report.stopped = stopped;
    if stopped.is_none() {
        report.done = ROUTES;
    }
    put(&stage, &archive, &mut report).await;
    end(&stage, &job, &pod).await;
}

fn pod_of(job: &Job) -> Pod {
    let template = serde_json::to_value(&job.spec.as_ref().unwrap().template).unwrap();
    let mut pod = json!({"metadata": template["metadata"], "spec": template["spec"]});
    pod["metadata"]["name"] = json!(job.name_any());
    pod["metadata"]["ownerReferences"] = json!([job.controller_owner_ref(&())]);
    pod["spec"]["nodeName"] = json!(NODE);
    serde_json::from_value(pod).unwrap()
}

fn running_state() -> Value {
    json!({"running": {"startedAt": Timestamp::now().strftime("%Y-%m-%dT%H:%M:%SZ").to_string()}})
}

fn ended_state() -> Value {
    let now = Timestamp::now().strftime("%Y-%m-%dT%H:%M:%SZ").to_string();
    json!({"terminated": {"exitCode": 0, "reason": "Completed", "startedAt": now, "finishedAt": now}})
}

/// A status in which all init containers but the sidecar are done.
fn pod_status(phase: &str, pod: &Pod, state: &Value) -> Value {
    let spec = pod.spec.as_ref().unwrap();
    let container = |container: &Container, state: &Value| {
        let repository = container
            .image
            .as_deref()
            .and_then(|image| image.split(['@', ':']).next());
        json!({
            "name": container.name, "image": container.image, "restartCount": 0,
            "imageID": format!("{}@sha256:{}", repository.unwrap_or_default(), "a".repeat(64)),
            "ready": state.get("running").is_some(), "started": state.get("running").is_some(), "state": state,
        })
    };
    let init = spec.init_containers.iter().flatten().map(|c| {
        let is_sidecar = c.name == names::CONTAINER_LOGCOPY;
        let ended = ended_state();
        container(c, if is_sidecar { state } else { &ended })
    });
    let now = Timestamp::now().strftime("%Y-%m-%dT%H:%M:%SZ").to_string();
    json!({
        "phase": phase,
        "startTime": now,
        "conditions": [{"type": "PodScheduled", "status": "True", "lastTransitionTime": now}],
        "initContainerStatuses": init.collect::<Vec<_>>(),
        "containerStatuses": spec.containers.iter().map(|c| container(c, state)).collect::<Vec<_>>(),
    })
}

async fn set_status<K>(api: &Api<K>, name: &str, status: &Value)
where
    K: Resource + Clone + std::fmt::Debug + serde::de::DeserializeOwned,
{
    let patched = async || {
        api.patch_status(name, &PatchParams::default(), &Patch::Merge(status))
            .await
    };
    let answer = match patched().await {
        // The server may close a connection while a request is on its way; the same patch twice is one.
        Err(kube::Error::Service(_)) => patched().await,
        answer => answer,
    };
    answer.unwrap();
}

fn first_report(stage: &Stage, job: &Job, pod: &Pod) -> Report {
    let report = Report {
        schema: SCHEMA,
        submission_uid: job.owner_references()[0].uid.clone(),
        attempt: Attempt(1),
        pod_uid: pod.uid().unwrap(),
        round: 0,
        done: 0,
        total: ROUTES,
        pairs: Vec::new(),
        score: None,
        route_completion: None,
        infraction_penalty: None,
        is_final: false,
        eligible: true,
        entry_status: "Started".into(),
        stopped: None,
        why: None,
        warnings: Vec::new(),
        logs: None,
        results: String::new(),
        partial_results: None,
        agents_fill_disk: false,
        files: BTreeMap::new(),
    };
    assert!(!stage.props.labels.is_empty());
    report
}

async fn put(stage: &Stage, archive: &Archive, report: &mut Report) {
    let score = f64::from(report.done) * 100.0 / f64::from(ROUTES);
    let accuracies: BTreeMap<_, _> = stage.props.labels.iter().map(|label| (label.clone(), score)).collect();
    report.score = Some(score);
    report.results =
        json!([{"split": "leaderboard", "show_to_participant": true, "accuracies": accuracies}]).to_string();
    report.pairs = vec![ReportPair {
        id: 1,
        done: report.done,
        total: ROUTES,
        crashes: 0,
        state: PairState::Running,
        names_crash: false,
    }];
    if report.is_final && report.stopped.is_none() {
        report.entry_status = "Finished".into();
    }
    let bytes = serde_json::to_vec(report).unwrap();
    archive.put(REPORT_KEY, bytes).await.unwrap();
}

async fn end(stage: &Stage, job: &Job, pod: &Pod) {
    let name = job.name_any();
    let ended = json!({"status": pod_status("Succeeded", pod, &ended_state())});
    set_status(&stage.pods(), &name, &ended).await;
    let now = Timestamp::now();
    let time = now.strftime("%Y-%m-%dT%H:%M:%SZ").to_string();
    let condition = |kind: &str| json!({"type": kind, "status": "True", "reason": "CompletionsReached", "lastTransitionTime": time, "lastProbeTime": time});
    let complete = json!({"status": {
        "active": null, "ready": 0, "succeeded": 1, "completionTime": time, "uncountedTerminatedPods": {},
        "conditions": [condition("SuccessCriteriaMet"), condition("Complete")],
    }});
    set_status(&stage.jobs(), &name, &complete).await;
    let mut seen = stage.seen.lock().unwrap();
    seen.ended.insert(job.labels()[names::LABEL_SUBMISSION].clone(), now);
}
