//! The containers of the workers: strangers' images behind our runner. Pure.

use k8s_openapi::api::core::v1::EnvVar;
use serde_json::{Value, json};

use super::members::{is_first, members, role};
use super::security::context;
use super::{JobInput, gpu, variable, volumes};
use crate::layout::STATUS;
use leaderboard_api::Part;
use leaderboard_contract::run::{RUNNER, TOOLS};
use leaderboard_evaluation::workload::{Role, Workload};
use leaderboard_protocol::files::{Member, Side};

/// The containers that run side by side.
pub(super) fn all(input: &JobInput<'_>, workloads: &[Workload]) -> Vec<Value> {
    members(input.plan)
        .filter(|member| !is_first(input.plan, *member))
        .filter_map(|member| container(input, member, role(workloads, member)?))
        .collect()
}

/// The agent that ends before they start, if there is one.
pub(super) fn first(input: &JobInput<'_>, workloads: &[Workload]) -> Option<Value> {
    let member = members(input.plan).find(|member| is_first(input.plan, *member))?;
    container(input, member, role(workloads, member)?)
}

fn container(input: &JobInput<'_>, member: Member, role: &Role) -> Option<Value> {
    let agents = input.plan.agents();
    let gpus = gpu::source_of(input.spec(), input.plan, member);
    let hosts = input.spec().given(input.track(), part(member.side))?;
    let env = role.env.iter().map(|(name, value)| variable(name, value));
    let env = env.chain(gpu::variables(gpus, member)).collect();
    let flags = role
        .flags
        .iter()
        .cloned()
        .chain(gpu::flags(gpus, agents, member.side, role.draws));
    Some(json!({
        "name": member.to_string(),
        "image": role.image,
        // Kubernetes asks for `latest` anew before each container: a worker, or a restart, could get another image.
        "imagePullPolicy": (member.side == Side::Agent).then_some("IfNotPresent"),
        "command": behind_runner(member, flags, &role.command),
        "env": merged(env, hosts.env, &input.kind().reserved(input.spec()).env),
        "resources": gpu::resources(input.spec(), input.plan, member, hosts.resources.as_ref()),
        "securityContext": context(hosts.security),
        "volumeMounts": volumes::of_member(member, role),
    }))
}

pub(super) fn part(side: Side) -> Part {
    match side {
        Side::Host(_) => Part::Host,
        Side::Agent => Part::Agent,
    }
}

fn behind_runner(member: Member, flags: impl IntoIterator<Item = String>, words: &[String]) -> Vec<String> {
    let start = [
        format!("{TOOLS}/{RUNNER}"),
        member.side.name().to_owned(),
        format!("--pair={}", member.pair),
        format!("--status={STATUS}"),
    ];
    start
        .into_iter()
        .chain(flags)
        .chain(["--".to_owned()])
        .chain(words.iter().cloned())
        .collect()
}

/// The host's variables take the place of ours of the same name, but for those that follow from the plan.
fn merged(mut ours: Vec<EnvVar>, hosts: &[EnvVar], reserved: &[&str]) -> Vec<EnvVar> {
    for variable in hosts
        .iter()
        .filter(|variable| !reserved.contains(&variable.name.as_str()))
    {
        match ours.iter_mut().find(|known| known.name == variable.name) {
            Some(known) => known.clone_from(variable),
            None => ours.push(variable.clone()),
        }
    }
    ours
}

/// Takes variables of its image from a container. A Pod cannot remove a variable, so the runner does; what the host sets stays.
pub(super) fn settle(container: &mut Value, workloads: &[Workload]) {
    let Some(role) = gpu::member(container).and_then(|member| role(workloads, member)) else {
        return;
    };
    let env = container["env"].as_array().map(Vec::as_slice).unwrap_or_default();
    let is_set = |name: &&&str| env.iter().any(|variable| variable["name"] == **name);
    let removed: Vec<&str> = role.removes.iter().filter(|name| !is_set(name)).copied().collect();
    if removed.is_empty() {
        return;
    }
    let flag = format!("--unset={}", removed.join(","));
    // The first of these ends the runner's own flags.
    if let Some(words) = container["command"].as_array_mut()
        && let Some(end) = words.iter().position(|word| word == "--")
    {
        words.insert(end, flag.into());
    }
}
