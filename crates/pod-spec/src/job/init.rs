//! The init containers but for an agent's: `contents` and the data of the host, and our own `workspace`, `logcopy` and `collect`. Pure.
//!
//! Only `workspace` and `logcopy` ever get an identity towards AWS.

use k8s_openapi::api::core::v1::EnvVar;
use serde_json::{Value, json};

use super::security::{confined, context, resources};
use super::{JobInput, is_resumed, own_uid, run_document, variable, volumes};
use crate::layout::CONTENTS_LOG_FOLDER;
use leaderboard_api::{Part, names};
use leaderboard_contract::keys::CONTENTS_LOG;
use leaderboard_contract::run::{ENV_CHECKSUMS, ENV_POD_UID, ENV_ROLE_ARN, ENV_RUN, RUNNER, TOOLS};
use leaderboard_evaluation::workload::literal;

/// Copying prints little; what floods must not fill the disk. In bytes.
const CONTENTS_LOG_LIMIT: u64 = 16 << 20;
/// Resources of a container that copies, and of the one that stores.
const SMALL: [&str; 3] = ["50m", "64Mi", "512Mi"];
const LARGE: [&str; 3] = ["100m", "128Mi", "1Gi"];

/// Copies the private contents into their volumes, where the kind of evaluation has some.
pub(super) fn contents(input: &JobInput<'_>) -> Option<Value> {
    let contents = input.kind().contents(&input.asked())?;
    let hosts = input.spec().given(None, Part::Contents)?;
    Some(json!({
        "name": names::CONTAINER_CONTENTS,
        "image": contents.image,
        "command": kept(contents.command),
        "env": contents_env(input, hosts.env),
        "resources": hosts.resources,
        "securityContext": context(hosts.security),
        "volumeMounts": volumes::of_contents(input),
    }))
}

/// Adds the runner, which writes the output of `contents` to a file too. `logcopy` sends that file to CloudWatch.
fn kept(command: Vec<String>) -> Vec<String> {
    let file = CONTENTS_LOG.rsplit('/').next().unwrap_or(CONTENTS_LOG);
    let flags = [
        format!("{TOOLS}/{RUNNER}"),
        "keep".into(),
        format!("--log={CONTENTS_LOG_FOLDER}/{file}"),
        format!("--log-limit={CONTENTS_LOG_LIMIT}"),
        "--".into(),
    ];
    flags.into_iter().chain(command).collect()
}

/// Variables of the contents in the old pipeline, which a command of the host's may read. The host's own variables replace
/// those of the same name. They come last, so that they can refer to ours.
fn contents_env(input: &JobInput<'_>, hosts: &[EnvVar]) -> Vec<EnvVar> {
    let plan = input.plan;
    let ours = [
        variable("SUBMISSION_ID", plan.run_id.as_str()),
        // The evaluator takes any text for a yes.
        variable("RESUME", if is_resumed(input) { "1" } else { "" }),
        variable("S3_BUCKET", &plan.storage.s3.bucket),
    ];
    let is_free = |ours: &EnvVar| hosts.iter().all(|hosts| hosts.name != ours.name);
    ours.into_iter().filter(is_free).chain(hosts.iter().cloned()).collect()
}

/// Copy the dataset and the labels out of their images, which need no shell.
pub(super) fn data(input: &JobInput<'_>) -> Vec<Value> {
    let all = input.kind().data(input.spec()).into_iter();
    let containers = all.filter_map(|data| {
        let image = data.source.image()?;
        let from = format!("--from={}", literal(&image.path));
        Some(json!({
            "name": data.volume.name,
            "image": image.reference,
            "command": [format!("{TOOLS}/{RUNNER}"), "copy", from, format!("--to={}", data.volume.written)],
            "resources": resources(SMALL),
            "securityContext": confined(),
            "volumeMounts": volumes::of_data(data.volume),
        }))
    });
    containers.collect()
}

/// Prepares the volumes and restores what an earlier attempt stored.
pub(super) fn workspace(input: &JobInput<'_>) -> Value {
    let (env, mounts) = (own_env(input), volumes::of_workspace(input));
    own(input, names::CONTAINER_WORKSPACE, &env, &mounts, SMALL)
}

/// Merges, uploads and reports beside the workers.
pub(super) fn logcopy(input: &JobInput<'_>) -> Value {
    let (env, mounts) = (own_env(input), volumes::of_logcopy(input));
    let mut logcopy = own(input, names::CONTAINER_LOGCOPY, &env, &mounts, LARGE);
    logcopy["restartPolicy"] = "Always".into();
    logcopy
}

/// Copies what an agent has left, for the evaluators. It reads a stranger's files, so that it has no identity.
pub(super) fn collect(input: &JobInput<'_>) -> Value {
    let (env, mounts) = ([json!(run_variable(input))], volumes::of_collect());
    own(input, names::CONTAINER_COLLECT, &env, &mounts, SMALL)
}

fn own(input: &JobInput<'_>, name: &str, env: &[Value], mounts: &[Value], size: [&str; 3]) -> Value {
    let uid = own_uid::of(input);
    let mut context = confined();
    context["readOnlyRootFilesystem"] = true.into();
    context["runAsNonRoot"] = true.into();
    context["runAsUser"] = uid.into();
    context["runAsGroup"] = uid.into();
    json!({
        "name": name,
        "image": input.own.image,
        "imagePullPolicy": input.own.pull_policy,
        "command": ["leaderboard-operator", name],
        "env": env,
        "resources": resources(size),
        "securityContext": context,
        "volumeMounts": mounts,
    })
}

fn run_variable(input: &JobInput<'_>) -> EnvVar {
    let run = serde_json::to_string(&run_document(input)).unwrap_or_default();
    variable(ENV_RUN, &run)
}

fn own_env(input: &JobInput<'_>) -> Vec<Value> {
    let identity = input.spec().pod_identity.as_ref();
    let region = input.own.region.as_ref().or(input.plan.storage.s3.region.as_ref());
    let checksums = input.own.checksums.as_deref();
    let role = identity.and_then(|identity| identity.role_arn.as_deref());
    let settings = [
        // The node's own role is no identity of ours: what answers us at the metadata address answers the agents too.
        Some(variable("AWS_EC2_METADATA_DISABLED", "true")),
        region.map(|region| variable("AWS_REGION", region)),
        checksums.map(|when| variable(ENV_CHECKSUMS, when)),
        role.map(|role| variable(ENV_ROLE_ARN, role)),
    ];
    let secret = identity.and_then(|identity| identity.secret_name.as_deref());
    let keys = [
        ("AWS_ACCESS_KEY_ID", None),
        ("AWS_SECRET_ACCESS_KEY", None),
        ("AWS_SESSION_TOKEN", Some(true)),
    ];
    let from_secret = secret.into_iter().flat_map(|secret| {
        keys.map(|(key, optional)| {
            let reference = json!({"name": secret, "key": key, "optional": optional});
            json!({"name": key, "valueFrom": {"secretKeyRef": reference}})
        })
    });
    let uid = json!({"name": ENV_POD_UID, "valueFrom": {"fieldRef": {"fieldPath": "metadata.uid"}}});
    let settings = settings.into_iter().flatten().map(|variable| json!(variable));
    let own = [json!(run_variable(input)), uid].into_iter();
    own.chain(settings).chain(from_secret).collect()
}
