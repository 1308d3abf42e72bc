//! Every name that more than one module writes or reads: labels, annotations, finalizers, field managers, Jobs.
//!
//! Pure. A name changed here is an API change.

use crate::JobNumber;

/// The group once, for names that begin with it. The derives of both kinds, which take a literal, repeat it, and a test compares.
macro_rules! group {
    () => {
        "leaderboard.carla.org"
    };
}

/// API group of both kinds, and prefix of labels, annotations and finalizers.
pub const GROUP: &str = group!();
/// API version that is served and stored.
pub const VERSION: &str = "v1alpha1";

/// Address of the documents of this version, with its last slash: messages name a page by it.
pub const DOCUMENTS: &str = concat!(
    env!("CARGO_PKG_REPOSITORY"),
    "/blob/v",
    env!("CARGO_PKG_VERSION"),
    "/docs/"
);

/// Label: name of the Submission, on Jobs and Pods.
pub const LABEL_SUBMISSION: &str = concat!(group!(), "/submission");
/// Label: attempt, on Jobs and Pods.
pub const LABEL_ATTEMPT: &str = concat!(group!(), "/attempt");
/// Label: name of the Leaderboard, on Submissions made by the bridge, Jobs, Pods and policies.
pub const LABEL_LEADERBOARD: &str = concat!(group!(), "/leaderboard");
/// Label: run id, on Jobs and Pods.
pub const LABEL_RUN: &str = concat!(group!(), "/run");
/// Label: EvalAI phase, on Submissions made by the bridge.
pub const LABEL_PHASE: &str = concat!(group!(), "/phase");
/// Label of everything the operator makes.
pub const LABEL_MANAGED_BY: &str = "app.kubernetes.io/managed-by";
/// Value of the label above.
pub const OPERATOR: &str = "leaderboard-operator";

/// Annotation on a Submission: which message made or bumped it; see [`super::Ingested`].
pub const ANNOTATION_INGESTED: &str = concat!(group!(), "/ingested");
/// Annotation on a Submission, `true`: a person hands it over that is held back for another program; it takes up what is stored.
pub const ANNOTATION_ADOPT: &str = concat!(group!(), "/adopt");
/// Annotation on a Pod: why it is to stop, `Cancel`, `Retries` or `RunDeadline`.
pub const ANNOTATION_STOP: &str = concat!(group!(), "/stop");
/// Annotation on a Job: which infrastructure retry of the attempt it is.
pub const ANNOTATION_RETRY: &str = concat!(group!(), "/retry");

/// Annotation on a Pod: generation of the Leaderboard that its Job was made from.
pub const ANNOTATION_GENERATION: &str = concat!(group!(), "/leaderboard-generation");

/// Finalizer of a Submission: held until its end is published and recorded.
pub const FINALIZER_SUBMISSION: &str = concat!(group!(), "/publish");
/// Finalizer of a Leaderboard: held while live or unpublished Submissions refer to it.
pub const FINALIZER_LEADERBOARD: &str = concat!(group!(), "/in-use");

/// Field manager of Submission status.
pub const MANAGER_STATUS: &str = "leaderboard-operator/status";
/// Field manager of what `ingest` creates and bumps.
pub const MANAGER_INGEST: &str = "leaderboard-operator/ingest";
/// Field manager of Jobs, Pods' annotations and policies.
pub const MANAGER_CHILDREN: &str = "leaderboard-operator/children";
/// Field manager of finalizers.
pub const MANAGER_FINALIZER: &str = "leaderboard-operator/finalizer";

/// Label of Kueue on a Job: name of the LocalQueue that admits it.
pub const LABEL_KUEUE_QUEUE: &str = "kueue.x-k8s.io/queue-name";

/// Name of the init container with the private contents.
pub const CONTAINER_CONTENTS: &str = "contents";
/// Name of the init container that prepares the volumes.
pub const CONTAINER_WORKSPACE: &str = "workspace";
/// Name of the sidecar that merges, uploads and reports.
pub const CONTAINER_LOGCOPY: &str = "logcopy";
/// Name of the init container that copies the dataset of `evaluation.container`.
pub const CONTAINER_DATASET: &str = "dataset";
/// Name of the init container that copies the labels of `evaluation.container`.
pub const CONTAINER_LABELS: &str = "labels";
/// Name of the init container that copies what an agent has left, for the evaluators. It runs after the agent.
pub const CONTAINER_COLLECT: &str = "collect";
/// The init containers of a Pod that start before its agents, in this order. `logcopy` goes on while the workers run.
pub const INIT_CONTAINERS: [&str; 5] = [
    CONTAINER_WORKSPACE,
    CONTAINER_CONTENTS,
    CONTAINER_DATASET,
    CONTAINER_LABELS,
    CONTAINER_LOGCOPY,
];

/// Key of the log that explains a failure, below the run's prefix. The controller writes no other text below that prefix.
pub const FAILURE_LOG_KEY: &str = "evalai/environment_log.txt";

/// Name of an agent's container; pairs count from 1.
pub fn agent_container(pair: usize) -> String {
    format!("agent-{pair}")
}

/// True for the name of an agent's container.
pub fn is_agent_container(name: &str) -> bool {
    name.starts_with("agent-")
}

/// Name of a simulator's container; pairs count from 1.
pub fn simulator_container(pair: usize) -> String {
    format!("simulator-{pair}")
}

/// Name of the container of a host's evaluator; workers count from 1.
pub fn evaluator_container(worker: usize) -> String {
    format!("evaluator-{worker}")
}

/// Name of the Submission of an EvalAI submission.
pub fn submission(id: i64) -> String {
    format!("submission-{id}")
}

/// Id of the EvalAI submission whose Submission has this name.
pub fn id_of_submission(name: &str) -> Option<i64> {
    let id = name.strip_prefix("submission-")?.parse().ok()?;
    (submission(id) == name).then_some(id)
}

/// Name of a Job of a submission.
pub fn job(submission: &str, number: JobNumber) -> String {
    format!("{submission}-{}", number.suffix())
}

#[cfg(test)]
mod tests {
    use kube::Resource;

    use super::*;
    use crate::{Leaderboard, Submission};

    #[test]
    fn both_kinds_are_of_the_group_and_the_version() {
        for found in [
            [Leaderboard::group(&()), Leaderboard::version(&())],
            [Submission::group(&()), Submission::version(&())],
        ] {
            assert_eq!(found, [GROUP, VERSION]);
        }
    }

    #[test]
    fn the_documents_are_those_of_this_version() {
        let address = DOCUMENTS.strip_prefix("https://").expect("a link");
        assert!(address.ends_with(concat!("/blob/v", env!("CARGO_PKG_VERSION"), "/docs/")));
    }
}
