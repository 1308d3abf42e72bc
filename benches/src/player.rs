//! Plays the kubelets, and in some cases the Job controller. A Pod of 11 containers runs as soon as it exists, and its report is in S3.
//! After its time all of its containers have ended well.

use std::collections::HashSet;
use std::sync::Arc;
use std::time::{Duration, Instant};

use jiff::Timestamp;
use kube::Client;
use leaderboard_api::names;
use serde::Deserialize;
use serde_json::{Value, json};
use tokio::sync::Semaphore;
use tokio::task::JoinHandle;

use crate::api::{self, Meta, Slim};
use crate::bench::Outcome;
use crate::observed::{JobStatus, Observed, endless};
use crate::played::{self, now};
use crate::storage::{PAIRS, Storage};

/// The node of all Pods.
pub const NODE: &str = "played";
/// Writes under way at once.
const AT_ONCE: usize = 16;
const LAG: Duration = Duration::from_secs(10);

/// The course of the Pods.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pods {
    /// They run so long and end well.
    Last(Duration),
    /// They run on.
    Run,
    /// No node accepts them.
    Wait,
}

#[derive(Deserialize, Clone, Debug)]
struct PodStatus {
    #[serde(default)]
    phase: String,
}

/// A running play.
pub struct Player {
    pods: Pods,
    tasks: Vec<JoinHandle<()>>,
}

struct Stage {
    client: Client,
    storage: Arc<Storage>,
    observed: Observed,
    pods: Pods,
    makes_pods: bool,
    turns: Semaphore,
}

impl Drop for Player {
    fn drop(&mut self) {
        for task in &self.tasks {
            task.abort();
        }
    }
}

impl Player {
    /// `makes_pods` where no Job controller runs.
    pub fn start(client: &Client, storage: &Arc<Storage>, observed: &Observed, pods: Pods, makes_pods: bool) -> Self {
        let stage = Arc::new(Stage {
            client: client.clone(),
            storage: Arc::clone(storage),
            observed: observed.clone(),
            pods,
            makes_pods,
            turns: Semaphore::new(AT_ONCE),
        });
        let mut tasks = vec![tokio::spawn(watch_pods(Arc::clone(&stage)))];
        if makes_pods {
            tasks.push(tokio::spawn(watch_jobs(stage)));
        }
        Self { pods, tasks }
    }

    /// True if no Pod comes to its end.
    pub fn is_endless(&self) -> bool {
        !matches!(self.pods, Pods::Last(_))
    }
}

async fn watch_pods(stage: Arc<Stage>) {
    let mut known = HashSet::new();
    let client = stage.client.clone();
    endless(&client, "pods", |pod: Slim<PodStatus>| {
        let phase = pod.status.map(|status| status.phase).unwrap_or_default();
        if phase == "Succeeded" {
            stage.ended(&pod.metadata);
        } else if known.insert(pod.metadata.uid.clone()) {
            let stage = Arc::clone(&stage);
            tokio::spawn(async move {
                if let Err(error) = stage.play(&pod.metadata).await {
                    eprintln!("bench: the Pod {} cannot be played: {error}", pod.metadata.name);
                }
            });
        }
    })
    .await;
}

/// Makes the Pod of each Job, all after the template of the first: they differ in their names alone.
async fn watch_jobs(stage: Arc<Stage>) {
    let mut known = HashSet::new();
    let (sender, mut jobs) = tokio::sync::mpsc::unbounded_channel();
    let client = stage.client.clone();
    let watching = tokio::spawn(async move {
        endless(&client, "jobs", |job: Slim<JobStatus>| _ = sender.send(job.metadata)).await;
    });
    let mut first = None;
    while let Some(job) = jobs.recv().await {
        if !known.insert(job.uid.clone()) {
            continue;
        }
        if first.is_none() {
            first = stage.template(&job).await.ok();
        }
        let Some(template) = &first else { continue };
        let pod = template.of(&job);
        let stage = Arc::clone(&stage);
        tokio::spawn(async move {
            if let Err(error) = stage.make(&job, pod).await {
                eprintln!("bench: no Pod of the Job {} can be made: {error}", job.name);
            }
        });
    }
    watching.abort();
}

/// A Pod as text, and what in it is its Job's own.
struct Template {
    text: String,
    job: Meta,
}

impl Template {
    fn of(&self, job: &Meta) -> String {
        let submission = |meta: &Meta| meta.labels.get(names::LABEL_SUBMISSION).cloned().unwrap_or_default();
        let text = self
            .text
            .replace(&self.job.uid, &job.uid)
            .replace(&self.job.name, &job.name);
        text.replace(&submission(&self.job), &submission(job))
    }
}

impl Stage {
    async fn template(&self, job: &Meta) -> Outcome<Template> {
        let object: Value = api::get(&self.client, &format!("{}/{}", api::path("jobs"), job.name)).await?;
        let template = &object["spec"]["template"];
        let mut pod =
            json!({"apiVersion": "v1", "kind": "Pod", "metadata": template["metadata"], "spec": template["spec"]});
        pod["metadata"]["name"] = json!(job.name);
        pod["metadata"]["ownerReferences"] = json!([{
            "apiVersion": "batch/v1", "kind": "Job", "name": job.name, "uid": job.uid, "controller": true,
        }]);
        Ok(Template {
            text: pod.to_string(),
            job: job.clone(),
        })
    }

    async fn make(&self, job: &Meta, pod: String) -> Outcome<()> {
        let _turn = self.turns.acquire().await?;
        api::create(&self.client, &api::path("pods"), pod.into_bytes()).await?;
        let active = json!({"status": {"active": 1, "startTime": now()}}).to_string();
        api::set_status(&self.client, "jobs", &job.name, active.into_bytes()).await?;
        Ok(())
    }

    async fn play(&self, pod: &Meta) -> Outcome<()> {
        if self.pods == Pods::Wait {
            return self.set(pod, unschedulable()).await;
        }
        let label = |name: &str| pod.labels.get(name).cloned().unwrap_or_default();
        let (submission, run) = (label(names::LABEL_SUBMISSION), label(names::LABEL_RUN));
        // The Job is observed by another watch, which may lag a little.
        self.observed
            .until(LAG, |moments| moments.uids.contains_key(&submission))
            .await;
        let uid = self
            .observed
            .get()
            .uids
            .get(&submission)
            .cloned()
            .ok_or("its submission is not known")?;
        self.storage.begin(&run, &uid, &pod.uid);
        self.set(pod, status(false)).await?;
        let Pods::Last(time) = self.pods else { return Ok(()) };
        tokio::time::sleep(time).await;
        self.storage.end(&run);
        self.set(pod, status(true)).await?;
        self.ended(pod);
        if self.makes_pods {
            self.complete(pod).await?;
        }
        Ok(())
    }

    async fn set(&self, pod: &Meta, status: Value) -> Outcome<()> {
        let _turn = self.turns.acquire().await?;
        let body = json!({"status": status}).to_string().into_bytes();
        api::set_status(&self.client, "pods", &pod.name, body).await?;
        Ok(())
    }

    /// As the Job controller does. Here a Pod has the name of its Job.
    async fn complete(&self, pod: &Meta) -> Outcome<()> {
        let _turn = self.turns.acquire().await?;
        let status = json!({"status": played::job_complete()});
        api::set_status(&self.client, "jobs", &pod.name, status.to_string().into_bytes()).await?;
        Ok(())
    }

    /// The answer and the event of the same write come in any order: the earlier one is next to its commit.
    fn ended(&self, pod: &Meta) {
        let Some(submission) = pod.labels.get(names::LABEL_SUBMISSION).cloned() else {
            return;
        };
        self.observed.note(|moments| {
            moments
                .ended
                .entry(submission)
                .or_insert_with(|| (Instant::now(), Timestamp::now()));
        });
    }
}

fn unschedulable() -> Value {
    json!({"phase": "Pending", "conditions": [{
        "type": "PodScheduled", "status": "False", "reason": "Unschedulable", "lastTransitionTime": now(),
        "message": "0/3 nodes are available: 3 Insufficient nvidia.com/gpu.",
    }]})
}

/// A Pod that runs, or that has ended well.
fn status(has_ended: bool) -> Value {
    let (over, running) = (played::ended(0, ""), played::running());
    let container = |name: &str, is_over: bool| {
        let (image, id) = ("registry.example/played:1", "registry.example/played@sha256:1");
        played::container(name, image, id, if is_over { &over } else { &running })
    };
    let sides = [names::simulator_container, names::agent_container];
    let pairs = (1..=PAIRS as usize).flat_map(|pair| sides.map(|side| side(pair)));
    let containers: Vec<Value> = pairs.map(|name| container(&name, has_ended)).collect();
    let init = [
        container(names::CONTAINER_WORKSPACE, true),
        container(names::CONTAINER_CONTENTS, true),
        container(names::CONTAINER_LOGCOPY, has_ended),
    ];
    let phase = if has_ended { "Succeeded" } else { "Running" };
    played::pod(phase, &init, &containers)
}
