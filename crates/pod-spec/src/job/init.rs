//! The init containers but for an agent's: `contents` and the data of the host, and our own `workspace`, `logcopy` and `collect`. Pure.
//!
//! Only `workspace` and `logcopy` ever get an identity towards AWS.

use k8s_openapi::api::core::v1::{
    Container, EnvVar, EnvVarSource, ObjectFieldSelector, SecretKeySelector, SecurityContext,
};

use super::security::{confined, context, resources};
use super::{JobInput, is_resumed, own_uid, run_document, variable, volumes};
use crate::layout::CONTENTS_LOG_FOLDER;
use leaderboard_api::{Part, names};
use leaderboard_contract::keys::CONTENTS_LOG;
use leaderboard_contract::run::{ENV_CHECKSUMS, ENV_POD_UID, ENV_ROLE_ARN, ENV_RUN, RUNNER, TOOLS};
use leaderboard_evaluation::workload::literal;

/// Copying prints little; what floods must not fill the disk. In bytes.
const CONTENTS_LOG_LIMIT: u64 = 16 << 20;

/// Copies the private contents into their volumes, where the kind of evaluation has some.
pub(super) fn contents(input: &JobInput<'_>) -> Option<Container> {
    let (contents, hosts) = (
        input.kind().contents(&input.asked())?,
        input.spec().given(None, Part::Contents)?,
    );
    Some(Container {
        name: names::CONTAINER_CONTENTS.into(),
        image: Some(contents.image),
        command: Some(kept(contents.command)),
        env: Some(contents_env(input, hosts.env)),
        resources: hosts.resources,
        security_context: Some(context(hosts.security)),
        volume_mounts: Some(volumes::of_contents(input)),
        ..Container::default()
    })
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
pub(super) fn data(input: &JobInput<'_>) -> Vec<Container> {
    let all = input.kind().data(input.spec()).into_iter();
    let containers = all.filter_map(|data| {
        let image = data.source.image()?;
        Some(Container {
            name: data.volume.name.into(),
            image: Some(image.reference.clone()),
            command: Some(vec![
                format!("{TOOLS}/{RUNNER}"),
                "copy".into(),
                format!("--from={}", literal(&image.path)),
                format!("--to={}", data.volume.written),
            ]),
            resources: Some(resources(["50m", "64Mi"], "512Mi")),
            security_context: Some(confined()),
            volume_mounts: Some(volumes::of_data(data.volume)),
            ..Container::default()
        })
    });
    containers.collect()
}

/// Prepares the volumes and restores what an earlier attempt stored.
pub(super) fn workspace(input: &JobInput<'_>) -> Container {
    Container {
        volume_mounts: Some(volumes::of_workspace(input)),
        resources: Some(resources(["50m", "64Mi"], "512Mi")),
        ..own(input, names::CONTAINER_WORKSPACE)
    }
}

/// Merges, uploads and reports beside the workers.
pub(super) fn logcopy(input: &JobInput<'_>) -> Container {
    Container {
        restart_policy: Some("Always".into()),
        volume_mounts: Some(volumes::of_logcopy(input)),
        resources: Some(resources(["100m", "128Mi"], "1Gi")),
        ..own(input, names::CONTAINER_LOGCOPY)
    }
}

/// Copies what an agent has left, for the evaluators. It reads a stranger's files, so that it has no identity.
pub(super) fn collect(input: &JobInput<'_>) -> Container {
    Container {
        env: Some(vec![run_variable(input)]),
        volume_mounts: Some(volumes::of_collect()),
        resources: Some(resources(["50m", "64Mi"], "512Mi")),
        ..own(input, names::CONTAINER_COLLECT)
    }
}

fn own(input: &JobInput<'_>, name: &str) -> Container {
    let uid = own_uid::of(input);
    Container {
        name: name.into(),
        image: Some(input.own.image.clone()),
        image_pull_policy: input.own.pull_policy.clone(),
        command: Some(vec!["leaderboard-operator".into(), name.into()]),
        env: Some(own_env(input)),
        security_context: Some(SecurityContext {
            read_only_root_filesystem: Some(true),
            run_as_non_root: Some(true),
            run_as_user: Some(uid),
            run_as_group: Some(uid),
            ..confined()
        }),
        ..Container::default()
    }
}

fn run_variable(input: &JobInput<'_>) -> EnvVar {
    let run = serde_json::to_string(&run_document(input)).unwrap_or_default();
    variable(ENV_RUN, &run)
}

fn own_env(input: &JobInput<'_>) -> Vec<EnvVar> {
    let mut env = vec![
        run_variable(input),
        EnvVar {
            name: ENV_POD_UID.into(),
            value_from: Some(EnvVarSource {
                field_ref: Some(ObjectFieldSelector {
                    field_path: "metadata.uid".into(),
                    api_version: None,
                }),
                ..EnvVarSource::default()
            }),
            value: None,
        },
        // The node's own role is no identity of ours: what answers us at the metadata address answers the agents too.
        variable("AWS_EC2_METADATA_DISABLED", "true"),
    ];
    let region = input.own.region.as_ref().or(input.plan.storage.s3.region.as_ref());
    env.extend(region.map(|region| variable("AWS_REGION", region)));
    let checksums = input.own.checksums.as_deref();
    env.extend(checksums.map(|when| variable(ENV_CHECKSUMS, when)));
    if let Some(identity) = &input.spec().pod_identity {
        env.extend(identity.role_arn.as_deref().map(|role| variable(ENV_ROLE_ARN, role)));
        env.extend(identity.secret_name.iter().flat_map(|secret| {
            [
                from_secret(secret, "AWS_ACCESS_KEY_ID", false),
                from_secret(secret, "AWS_SECRET_ACCESS_KEY", false),
                from_secret(secret, "AWS_SESSION_TOKEN", true),
            ]
        }));
    }
    env
}

fn from_secret(secret: &str, key: &str, optional: bool) -> EnvVar {
    EnvVar {
        name: key.into(),
        value_from: Some(EnvVarSource {
            secret_key_ref: Some(SecretKeySelector {
                name: secret.into(),
                key: key.into(),
                optional: optional.then_some(true),
            }),
            ..EnvVarSource::default()
        }),
        value: None,
    }
}
