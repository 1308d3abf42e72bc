//! Plays what a cluster has besides its API server: scheduler, kubelet and Job controller. A test that plays a Pod step by step
//! uses [`Cluster`]; a [`Player`] plays each Job by a script, such as [`reports`].

mod reports;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Debug;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use futures::{Stream, StreamExt};
use jiff::Timestamp;
use k8s_openapi::NamespaceResourceScope;
use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::core::v1::{Container, Node, Pod};
use kube::api::{Api, DeleteParams, Patch, PatchParams, PostParams};
use kube::runtime::wait::await_condition;
use kube::runtime::{WatchStreamExt, watcher};
use kube::{Client, Resource, ResourceExt};
use leaderboard_api::names;
use leaderboard_contract::run::Stop;
use serde::de::DeserializeOwned;
use serde_json::{Value, json};
use tokio::sync::{oneshot, watch};
use tokio::task::JoinHandle;
use tokio::time::timeout;

pub use self::reports::{ROUTES, report, reports, reports_as};
use super::played;

/// The node of Pods where a test names no other.
const NODE: &str = "played";
/// Longest wait for something that the controller does.
const LIMIT: Duration = Duration::from_mins(2);
/// Begins the name of each agent's container.
const AGENT: &str = "agent-";

/// A namespace in which a test acts for the cluster.
#[derive(Clone)]
pub struct Cluster {
    client: Client,
    namespace: String,
    /// The node of its Pods.
    node: &'static str,
}

impl Cluster {
    pub fn new(client: &Client, namespace: &str) -> Self {
        Self {
            client: client.clone(),
            namespace: namespace.to_owned(),
            node: NODE,
        }
    }

    /// A cluster with a node of this name.
    pub fn on_node(self, node: &'static str) -> Self {
        Self { node, ..self }
    }

    /// Makes the node, with this condition. One that is there already stays as it is.
    pub async fn node(&self, condition: Value) {
        let node = json!({"metadata": {"name": self.node}, "status": {"conditions": [condition]}});
        let node: Node = serde_json::from_value(node).unwrap();
        match Api::all(self.client.clone())
            .create(&PostParams::default(), &node)
            .await
        {
            Err(kube::Error::Api(status)) if status.is_already_exists() => {}
            made => drop(made.unwrap()),
        }
    }

    fn api<K>(&self) -> Api<K>
    where
        K: Resource<Scope = NamespaceResourceScope, DynamicType = ()>,
    {
        Api::namespaced(self.client.clone(), &self.namespace)
    }

    /// Waits for a Job.
    pub async fn job(&self, name: &str) -> Job {
        let is_there = |job: Option<&Job>| job.is_some();
        let job = timeout(LIMIT, await_condition(self.api(), name, is_there)).await;
        job.unwrap_or_else(|_| panic!("no Job {name}")).unwrap().unwrap()
    }

    /// Makes the Pod of a Job, on the node. It has the Job's name.
    pub async fn pod(&self, job: &Job) -> Pod {
        let template = serde_json::to_value(&job.spec.as_ref().unwrap().template).unwrap();
        let mut pod = json!({"metadata": template["metadata"], "spec": template["spec"]});
        pod["metadata"]["name"] = json!(job.name_any());
        pod["metadata"]["ownerReferences"] = json!([job.controller_owner_ref(&())]);
        pod["spec"]["nodeName"] = json!(self.node);
        let pod = serde_json::from_value(pod).unwrap();
        self.api().create(&PostParams::default(), &pod).await.unwrap()
    }

    /// Makes the Pod of a Job with all of its containers running.
    pub async fn running_pod(&self, job: &Job) -> Pod {
        let pod = self.pod(job).await;
        self.set_pod(&pod.name_any(), &running(&pod)).await;
        pod
    }

    pub async fn set_pod(&self, name: &str, status: &Value) {
        set_status(&self.api::<Pod>(), name, status).await;
    }

    pub async fn set_job(&self, job: &Job, status: &Value) {
        set_status(&self.api::<Job>(), &job.name_any(), status).await;
    }

    /// Waits until a Pod is asked to stop, and deletes its Job.
    pub async fn stops(&self, job: &Job) {
        let pod = job.name_any();
        let asked = timeout(LIMIT, await_condition(self.api(), &pod, is_asked_to_stop)).await;
        asked.expect("the Pod is asked to stop").unwrap();
        let jobs = self.api::<Job>();
        jobs.delete(&pod, &DeleteParams::background()).await.unwrap();
    }
}

fn is_asked_to_stop(pod: Option<&Pod>) -> bool {
    pod.is_some_and(|pod| pod.annotations().contains_key(names::ANNOTATION_STOP))
}

/// Status of a Pod all of whose containers run, of images that no registry has named.
pub fn running(pod: &Pod) -> Value {
    status(pod, "Running", |_| String::new(), &played::running())
}

/// Status of a Pod whose init containers have ended well, and all of whose other containers have this state.
pub fn status(pod: &Pod, phase: &str, image_id: impl Fn(&str) -> String, state: &Value) -> Value {
    let over = played::ended(0, "");
    status_of_each(pod, phase, image_id, |container, is_init| {
        let is_sidecar = container.restart_policy.is_some();
        if is_init && !is_sidecar { &over } else { state }
    })
}

/// Status of a Pod whose agent runs before the evaluators; `None` where it has no such agent.
pub fn agent_first(pod: &Pod, image_id: impl Fn(&str) -> String) -> Option<Value> {
    let init = pod.spec.as_ref()?.init_containers.as_ref()?;
    let agent = init.iter().position(|container| container.name.starts_with(AGENT))?;
    let before: Vec<&str> = init[..agent].iter().map(|container| container.name.as_str()).collect();
    let (over, running) = (played::ended(0, ""), played::running());
    let waiting = json!({"waiting": {"reason": "PodInitializing"}});
    let state = |container: &Container, _: bool| {
        let runs = container.restart_policy.is_some() || container.name == init[agent].name;
        match (runs, before.contains(&container.name.as_str())) {
            (true, _) => &running,
            (false, true) => &over,
            (false, false) => &waiting,
        }
    };
    Some(status_of_each(pod, "Pending", image_id, state))
}

/// Status of a Pod whose containers have the states that `state` gives; it is asked whether one is an init container.
fn status_of_each<'a>(
    pod: &Pod,
    phase: &str,
    image_id: impl Fn(&str) -> String,
    state: impl Fn(&Container, bool) -> &'a Value,
) -> Value {
    let spec = pod.spec.as_ref().unwrap();
    let status = |container: &Container, is_init| {
        let image = container.image.as_deref().unwrap_or_default();
        played::container(&container.name, image, &image_id(image), state(container, is_init))
    };
    let init: Vec<_> = spec
        .init_containers
        .iter()
        .flatten()
        .map(|one| status(one, true))
        .collect();
    let containers: Vec<_> = spec.containers.iter().map(|one| status(one, false)).collect();
    played::pod(phase, &init, &containers)
}

async fn set_status<K>(api: &Api<K>, name: &str, status: &Value)
where
    K: Resource + Clone + Debug + DeserializeOwned,
{
    let patch = Patch::Merge(json!({ "status": status }));
    let patched = async || api.patch_status(name, &PatchParams::default(), &patch).await;
    let answer = match patched().await {
        // The server may close a connection while a request is on its way; the same patch twice is one.
        Err(kube::Error::Service(_)) => patched().await,
        answer => answer,
    };
    answer.unwrap();
}

/// Moments by name of the Submission.
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
    curtain: watch::Sender<bool>,
    /// Receivers of a stop, by name of the Pod.
    cues: Mutex<BTreeMap<String, oneshot::Sender<()>>>,
    seen: Mutex<Seen>,
}

/// One Job of the play, with its Pod.
pub struct Part {
    pub cluster: Cluster,
    pub job: Job,
    pub pod: Pod,
    pub cue: Cue,
    stage: Arc<Stage>,
}

/// The cue that ends a part.
pub struct Cue {
    stop: oneshot::Receiver<()>,
    curtain: watch::Receiver<bool>,
}

impl Cue {
    /// Waits until the Pod is asked to stop, or the curtain falls: then there is no stop.
    pub async fn comes(&mut self) -> Option<Stop> {
        tokio::select! {
            biased;
            _ = &mut self.stop => Some(Stop::Cancel),
            _ = self.curtain.wait_for(|is_down| *is_down) => None,
        }
    }
}

impl Part {
    /// Notes that the run has ended.
    pub fn has_ended(&self) {
        let submission = self.job.labels()[names::LABEL_SUBMISSION].clone();
        let mut seen = self.stage.seen.lock().unwrap();
        seen.ended.insert(submission, Timestamp::now());
    }
}

impl Player {
    /// Plays every Job of the namespace by this script.
    pub fn start<F, P>(cluster: Cluster, script: F) -> Self
    where
        F: Fn(Part) -> P + Send + Sync + 'static,
        P: Future<Output = ()> + Send + 'static,
    {
        let stage = Arc::new(Stage {
            curtain: watch::Sender::new(false),
            cues: Mutex::default(),
            seen: Mutex::default(),
        });
        let pods = tokio::spawn(watch_pods(cluster.clone(), Arc::clone(&stage)));
        let jobs = tokio::spawn(watch_jobs(cluster, Arc::clone(&stage), script));
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
    K: Resource + Clone + Debug + DeserializeOwned + Send + 'static,
{
    let events = watcher(api, watcher::Config::default()).default_backoff();
    events.applied_objects().filter_map(async |event| event.ok())
}

async fn watch_jobs<F, P>(cluster: Cluster, stage: Arc<Stage>, script: F)
where
    F: Fn(Part) -> P + Send + Sync + 'static,
    P: Future<Output = ()> + Send + 'static,
{
    cluster
        .node(json!({"type": "Ready", "status": "True", "reason": "KubeletReady"}))
        .await;
    let script = Arc::new(script);
    let mut known = BTreeSet::new();
    let mut jobs = std::pin::pin!(all(cluster.api::<Job>()));
    while let Some(job) = jobs.next().await {
        if !known.insert(job.uid()) {
            continue;
        }
        let (cluster, stage, script) = (cluster.clone(), Arc::clone(&stage), Arc::clone(&script));
        tokio::spawn(async move {
            let (cue, stop) = oneshot::channel();
            stage.cues.lock().unwrap().insert(job.name_any(), cue);
            let pod = cluster.pod(&job).await;
            let curtain = stage.curtain.subscribe();
            let cue = Cue { stop, curtain };
            script(Part {
                cluster,
                job,
                pod,
                cue,
                stage,
            })
            .await;
        });
    }
}

async fn watch_pods(cluster: Cluster, stage: Arc<Stage>) {
    let mut pods = std::pin::pin!(all(cluster.api::<Pod>()));
    while let Some(pod) = pods.next().await {
        if !is_asked_to_stop(Some(&pod)) {
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
