//! The Job of one attempt: names, labels, deadlines, volumes, and which container gets what.
//!
//! Pure: no client, no clock, no error. Called by the controller when an attempt starts, and for the dry run that checks a
//! Leaderboard. It owns everything the Pod is made of; what the containers then do is in `pod` and in the runner.

mod disk;
mod failed_nodes;
mod gpu;
mod gpu_count;
mod init;
mod members;
mod own_uid;
mod security;
mod volumes;
mod workers;

#[cfg(test)]
mod command_tests;
#[cfg(test)]
mod container_tests;
#[cfg(test)]
mod evaluator_tests;
#[cfg(test)]
mod gpu_tests;
#[cfg(test)]
mod hardening_tests;
#[cfg(test)]
mod mode_tests;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::time::Duration;

pub use gpu::unclear;
use jiff::Timestamp;
use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::core::v1::EnvVar;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::ObjectMeta;
use kube::core::{DynamicObject, TypeMeta};
use serde_json::{Value, json};

use crate::gpu_claims::source;
use crate::layout::ANNOTATION_SKIP_CONTAINERS;
use crate::overlay as pod_overlay;
use crate::owner::owner_reference;
pub use gpu_count::gpus;
use leaderboard_api::{
    Agents, Attempt, Deadlines, Enforcement, FailedNode, GpuSource, JobNumber, Leaderboard, LeaderboardSpec,
    PolicySource, Reason, RunPlan, Submission, SubmittedFile, Track, Verify, conditions, effective, names,
};
use leaderboard_contract::run::{Isolation, Run, SCHEMA};
use leaderboard_evaluation::Evaluation;
use leaderboard_evaluation::workload::{Asked, Workload, literal};

/// Seconds the containers have between SIGTERM and SIGKILL: the agents' 20 s, then logcopy's last upload.
const GRACE_SECONDS: i64 = 600;
/// Seconds a Pod stays on a node that is not ready or not reachable; Kubernetes' own default is 300.
const LOST_NODE_SECONDS: i64 = 60;
/// Seconds that the Pod's `activeDeadlineSeconds` allows beyond the sum of the other deadlines.
const NET_SECONDS: i64 = 1800;
/// Restarts beyond those of the workers that do not end the Job: those of our own init containers and of the host's count too.
const SPARE_RESTARTS: i32 = 20;
/// A policy that a Pod has found not to be enforced is taken for such so long; after that each Pod waits its full time again.
const KNOWN_OPEN_FOR: Duration = Duration::from_hours(1);

/// The operator's own image, with `workspace` and `logcopy` in it, and what of its environment their containers get.
#[derive(Clone, Debug, Default)]
pub struct OwnImage {
    pub image: String,
    pub pull_policy: Option<String>,
    /// AWS region.
    pub region: Option<String>,
    /// When S3 is sent checksums.
    pub checksums: Option<String>,
}

/// Input of a Job.
#[derive(Clone, Copy, Debug)]
pub struct JobInput<'a> {
    /// Whose attempt it is; name, namespace and UID are used.
    pub submission: &'a Submission,
    /// How it is run.
    pub leaderboard: &'a Leaderboard,
    /// The images and routes of the run, pinned at acceptance.
    pub plan: &'a RunPlan,
    /// Which Job it is.
    pub number: JobNumber,
    /// The submitted file, of a run of the mode Predictions.
    pub input: Option<&'a SubmittedFile>,
    pub own: &'a OwnImage,
    /// Nodes that have failed earlier Jobs of the attempt.
    pub failed_nodes: &'a [FailedNode],
    /// When it is made.
    pub now: Timestamp,
}

impl JobInput<'_> {
    fn spec(&self) -> &LeaderboardSpec {
        &self.leaderboard.spec
    }

    fn deadlines(&self) -> Deadlines {
        effective::deadlines(self.spec(), self.track())
    }

    fn kind(&self) -> &'static dyn Evaluation {
        leaderboard_evaluation::of_plan(self.plan)
    }

    fn asked(&self) -> Asked<'_> {
        Asked {
            spec: self.spec(),
            track: self.track(),
            plan: self.plan,
            attempt: self.number.attempt,
            deadlines: self.deadlines(),
            resume: is_resumed(self),
            has_gpus: source(self.spec()) != GpuSource::None,
        }
    }

    fn submission_name(&self) -> &str {
        self.submission.metadata.name.as_deref().unwrap_or_default()
    }

    /// The track; `None` if an edit of the Leaderboard has taken it away since.
    fn track(&self) -> Option<&Track> {
        self.spec().tracks.iter().find(|track| track.name == self.plan.track)
    }
}

/// The Job as it is created: ours, with the Leaderboard's `podOverrides` laid over its template. As JSON, since newer Pod fields
/// survive there.
pub fn build_object(input: &JobInput<'_>) -> DynamicObject {
    let workloads = members::workloads(input);
    let mut spec = ours(input, &workloads);
    let template = &mut spec["template"];
    pod_overlay::lay(template, input.spec());
    settle(template, input, &workloads);
    skip_strangers(template);
    DynamicObject {
        types: Some(TypeMeta::resource::<Job>()),
        metadata: metadata(input),
        // A value as it is: `json!` would copy all of it.
        data: Value::Object([("spec".to_owned(), spec)].into_iter().collect()),
    }
}

/// The content of `LEADERBOARD_RUN`.
fn run_document(input: &JobInput<'_>) -> Run {
    let unsigned = |seconds: i64| u64::try_from(seconds).unwrap_or_default();
    let (spec, meta) = (input.spec(), &input.submission.metadata);
    Run {
        schema: SCHEMA,
        namespace: meta.namespace.clone().unwrap_or_default(),
        submission: input.submission_name().to_owned(),
        uid: input
            .plan
            .submission_uid
            .clone()
            .or_else(|| meta.uid.clone())
            .unwrap_or_default(),
        attempt: input.number.attempt,
        plan: input.plan.clone(),
        input: input.input.cloned(),
        // Other kinds of evaluation have nothing to recompute.
        verify: spec.evaluation.carla().map_or(Verify::Disabled, |carla| carla.verify),
        period_seconds: unsigned(spec.sync_period_seconds),
        flush_seconds: unsigned(spec.deadlines.flush_seconds),
        cancel_seconds: unsigned(spec.deadlines.cancel_seconds),
        logs: spec.logs.clone(),
        isolation: isolation(input.leaderboard, input.now),
    }
}

/// How the Pod measures whether its policy is enforced. None if it is not to measure, and for an external policy: the operator does
/// not know what that one forbids.
fn isolation(leaderboard: &Leaderboard, now: Timestamp) -> Option<Isolation> {
    let network = &leaderboard.spec.network;
    if network.policy == PolicySource::External || network.enforcement == Enforcement::Disabled {
        return None;
    }
    let is_open = leaderboard.condition(conditions::ISOLATED).is_some_and(|found| {
        let age = now.duration_since(found.last_transition_time.0).unsigned_abs();
        found.reason == Reason::NotEnforced
            && found.observed_generation == leaderboard.metadata.generation
            && age < KNOWN_OPEN_FOR
    });
    Some(Isolation {
        enforcement: network.enforcement,
        probe: network.probe.clone(),
        egress: network.egress.iter().map(|egress| egress.cidr.clone()).collect(),
        // A run that must not go on is given every chance.
        is_known_open: is_open && network.enforcement == Enforcement::Warn,
    })
}

fn ours(input: &JobInput<'_>, workloads: &[Workload]) -> Value {
    let mut spec = json!({
        "completions": 1,
        "parallelism": 1,
        "backoffLimit": backoff_limit(input),
        // The default starts the next Pod while the old one still writes.
        "podReplacementPolicy": "Failed",
        "ttlSecondsAfterFinished": input.spec().job_seconds(),
    });
    // Here and below a large part is moved in: `json!` would copy all of it.
    spec["template"] = template(input, workloads);
    pod_overlay::drop_nulls(&mut spec);
    spec
}

fn metadata(input: &JobInput<'_>) -> ObjectMeta {
    ObjectMeta {
        name: Some(names::job(input.submission_name(), input.number)),
        namespace: input.submission.metadata.namespace.clone(),
        labels: Some(job_labels(input)),
        annotations: Some(BTreeMap::from([(
            names::ANNOTATION_RETRY.into(),
            input.number.retry.to_string(),
        )])),
        owner_references: Some(vec![owner_reference(input.submission)]),
        ..ObjectMeta::default()
    }
}

/// The host's labels are on the Job alone: Kueue reads them there, and would queue a Pod with them by itself.
fn job_labels(input: &JobInput<'_>) -> BTreeMap<String, String> {
    let mut all = input.spec().job_labels.clone();
    all.extend(labels(input));
    all
}

fn labels(input: &JobInput<'_>) -> BTreeMap<String, String> {
    let leaderboard = input.leaderboard.metadata.name.clone().unwrap_or_default();
    BTreeMap::from([
        (names::LABEL_MANAGED_BY.into(), names::OPERATOR.into()),
        (names::LABEL_SUBMISSION.into(), input.submission_name().to_owned()),
        (names::LABEL_ATTEMPT.into(), input.number.attempt.to_string()),
        (names::LABEL_LEADERBOARD.into(), leaderboard),
        (names::LABEL_RUN.into(), input.plan.run_id.to_string()),
    ])
}

/// A net only: the controller counts the crashes of each worker itself. This limit is one budget over all containers, and
/// at it the Pod is deleted with its statuses.
fn backoff_limit(input: &JobInput<'_>) -> i32 {
    let members = i32::try_from(members::members(input.plan).count()).unwrap_or(i32::MAX);
    members
        .saturating_mul(input.spec().retries.per_worker.saturating_add(1))
        .saturating_add(SPARE_RESTARTS)
}

/// The net for an absent controller; none without a limit on the run. It belongs to the Pod and not to the Job, whose own
/// would count the wait for a node.
fn active_deadline(input: &JobInput<'_>) -> Option<i64> {
    let deadlines = input.deadlines();
    let start = deadlines.pull_seconds.saturating_add(deadlines.start_seconds);
    // Evaluators that start after an agent pull their images then.
    let second = if input.plan.agents() == Agents::First { start } else { 0 };
    let seconds = [
        start,
        second,
        deadlines.run_seconds?,
        deadlines.cancel_seconds,
        deadlines.flush_seconds,
    ]
    .into_iter()
    .fold(NET_SECONDS, i64::saturating_add);
    Some(seconds.min(i32::MAX.into()))
}

fn template(input: &JobInput<'_>, workloads: &[Workload]) -> Value {
    let mut template = json!({
        "metadata": {
            "labels": labels(input),
            // Moving a run to another node costs hours of simulation.
            "annotations": {
                "cluster-autoscaler.kubernetes.io/safe-to-evict": "false",
                "karpenter.sh/do-not-disrupt": "true",
                (names::ANNOTATION_GENERATION): generation(input).to_string(),
            },
        },
    });
    template["spec"] = pod(input, workloads);
    template
}

fn generation(input: &JobInput<'_>) -> i64 {
    input.leaderboard.metadata.generation.unwrap_or_default()
}

fn pod(input: &JobInput<'_>, workloads: &[Workload]) -> Value {
    let identity = input.spec().pod_identity.as_ref();
    // `workspace` is first, since it makes the folders and the runner that the others have.
    let init = [Some(init::workspace(input)), init::contents(input)]
        .into_iter()
        .flatten();
    let init = init.chain(init::data(input)).chain([init::logcopy(input)]);
    // The kubelet's own order keeps an agent that runs first from what follows it.
    let first = workers::first(input, workloads).into_iter();
    let first = first.flat_map(|agent| [agent, init::collect(input)]);
    let mut pod = json!({
        "restartPolicy": "OnFailure",
        "activeDeadlineSeconds": active_deadline(input),
        "terminationGracePeriodSeconds": GRACE_SECONDS,
        "serviceAccountName": identity.and_then(|identity| identity.service_account_name.as_ref()),
        "automountServiceAccountToken": false,
        "enableServiceLinks": false,
        "shareProcessNamespace": false,
        "priorityClassName": input.track().and_then(|track| track.priority_class_name.as_ref()),
        "runtimeClassName": input.spec().runtime_class_name,
        "resourceClaims": gpu::claims(input),
        "nodeSelector": node_selector(input),
        "tolerations": tolerations(input),
    });
    pod["initContainers"] = init.chain(first).collect();
    pod["containers"] = workers::all(input, workloads).into();
    pod["volumes"] = volumes::all(input, workloads).into();
    pod
}

/// Images of participants, and mostly of hosts, are for one kind of machine. A track can choose another.
fn node_selector(input: &JobInput<'_>) -> BTreeMap<String, String> {
    let mut nodes = BTreeMap::from([("kubernetes.io/arch".into(), "amd64".into())]);
    nodes.extend(
        input
            .track()
            .map(|track| track.node_selector.clone())
            .unwrap_or_default(),
    );
    nodes
}

fn tolerations(input: &JobInput<'_>) -> Vec<Value> {
    let lost_node = ["not-ready", "unreachable"].map(|what| {
        json!({
            "key": format!("node.kubernetes.io/{what}"), "operator": "Exists", "effect": "NoExecute",
            "tolerationSeconds": LOST_NODE_SECONDS,
        })
    });
    let of_track = input.track().into_iter().flat_map(|track| &track.tolerations);
    lost_node.into_iter().chain(of_track.map(|one| json!(one))).collect()
}

/// Fills in the fields that depend on the host's: where the host sets none, and in the containers of the overlay too.
fn settle(template: &mut Value, input: &JobInput<'_>, workloads: &[Workload]) {
    let pod = &mut template["spec"];
    let gpus = source(input.spec());
    for list in ["initContainers", "containers"] {
        for container in pod[list].as_array_mut().into_iter().flatten() {
            gpu::hide(container, gpus);
            workers::settle(container, workloads);
            security::settle(container);
        }
    }
    gpu::place(pod, gpus);
    failed_nodes::avoid(pod, input.failed_nodes);
    disk::fill(pod, volumes::disk_limit(input));
}

/// Names every container but those two that have an identity for EKS, those of the overlay too.
fn skip_strangers(template: &mut Value) {
    let strangers: Vec<&str> = ["/spec/initContainers", "/spec/containers"]
        .into_iter()
        .filter_map(|list| template.pointer(list)?.as_array())
        .flatten()
        .filter_map(|container| container["name"].as_str())
        .filter(|name| ![names::CONTAINER_WORKSPACE, names::CONTAINER_LOGCOPY].contains(name))
        .collect();
    let strangers = strangers.join(",");
    template["metadata"]["annotations"][ANNOTATION_SKIP_CONTAINERS] = strangers.into();
}

/// A variable with a literal value: what Kubernetes would expand in it stays as it is.
fn variable(name: &str, value: &str) -> EnvVar {
    EnvVar {
        name: name.into(),
        value: Some(literal(value)),
        value_from: None,
    }
}

fn is_resumed(input: &JobInput<'_>) -> bool {
    input.plan.resume || input.number.attempt > Attempt::FIRST
}
