//! Credentials that an image could find.

use std::env;
use std::fs;
use std::path::Path;

use crate::probe::{Probe, held};
use crate::seen::Seen;

/// Where clouds and Kubernetes put a Pod's tokens.
const TOKENS: [&str; 4] = [
    "/var/run/secrets/kubernetes.io",
    "/run/secrets/kubernetes.io",
    "/var/run/secrets/eks.amazonaws.com",
    "/var/run/secrets/pods.eks.amazonaws.com",
];
/// Folder of the token for `podIdentity.roleARN`, in our own containers.
const ROLE_TOKEN: &str = "/var/run/secrets/leaderboard";
const CLOUD: [&str; 6] = ["AWS_", "ECS_", "GOOGLE_", "AZURE_", "OCI_", "EVALAI_"];
const SECRET: [&str; 5] = ["SECRET", "PASSWORD", "TOKEN", "CREDENTIAL", "ACCESS_KEY"];

pub(crate) const PROBES: &[Probe] = &[
    held(
        "service-account-token",
        "Read the ServiceAccount's token, or a cloud's token of the Pod",
        "the Pod mounts none (`automountServiceAccountToken: false`), and an annotation makes admission webhooks skip these containers",
        || found(TOKENS),
    ),
    held(
        "role-token",
        "Read the role token or static keys with which results are stored",
        "mounted in the operator's own containers alone",
        || found([ROLE_TOKEN]),
    ),
    held(
        "cloud-variables",
        "Read credentials of AWS, EvalAI or another cloud from the environment",
        "none is ever given to this container",
        || variables(|name| CLOUD.iter().any(|cloud| name.starts_with(cloud))),
    ),
    held(
        "secret-variables",
        "Read a password, token or key from the environment",
        "the host's `agent.env` is all there is",
        || variables(|name| SECRET.iter().any(|secret| name.contains(secret))),
    ),
    held(
        "service-variables",
        "Learn the addresses of the namespace's Services from the environment",
        "`enableServiceLinks: false`",
        || variables(|name| name.ends_with("_SERVICE_HOST") && name != "KUBERNETES_SERVICE_HOST"),
    ),
    held(
        "gpu-variable",
        "Use a GPU of the node that it was not given",
        "`NVIDIA_VISIBLE_DEVICES` is `void` for every container without one",
        || match env::var("NVIDIA_VISIBLE_DEVICES").as_deref() {
            Ok("void") => Seen::Denied("void".to_owned()),
            other => Seen::Open(format!("{other:?}")),
        },
    ),
    held(
        "own-volumes",
        "Open the volumes of logcopy: all results, the Pod's annotations",
        "mounted in the operator's own containers alone",
        || found(["/logs", "/podinfo", "/tmp/leaderboard", "/tmp/scenario_runner"]),
    ),
];

fn found<const N: usize>(places: [&str; N]) -> Seen {
    let there = places
        .into_iter()
        .filter(|place| fs::symlink_metadata(Path::new(place)).is_ok());
    Seen::of_finds(&there.map(str::to_owned).collect::<Vec<_>>(), "nothing is there")
}

/// The names alone: a value would be in the log.
fn variables(is_secret: impl Fn(&str) -> bool) -> Seen {
    let names = env::vars_os().filter_map(|(name, _)| name.into_string().ok());
    Seen::of_finds(
        &names.filter(|name| is_secret(name)).collect::<Vec<_>>(),
        "no such variable",
    )
}
