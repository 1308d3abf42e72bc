//! The simulator and the agent of each pair: strangers' images behind our runner. Pure.
//!
//! What they see (mounts, variables, flags) is the original's, version by version.

use k8s_openapi::api::core::v1::{Container, EnvVar};

use super::commands::Adapter;
use super::security::context;
use super::{JobInput, commands, display, gpu, resume, variable, volumes};
use crate::controller::gpu_claims::source;
use crate::controller::submissions::pod_layout::{
    AGENT, CARLA_ROOT, FIXED_ENV, LEADERBOARD_ROOT, SAVED, SCENARIO_RUNNER_ROOT, STATUS, python_path,
};
use crate::pod::run::{RUNNER, TOOLS, console_name};
use leaderboard_api::{GpuSource, LeaderboardVersion, SimulatorContainer, effective};
use leaderboard_runner::graphics::Needs;
use leaderboard_runner::protocol::{Member, Pair};

const ROUTES_FILE: &str = "/workspace/leaderboard/data/routes_testing.xml";
const SCENARIOS_FILE: &str = "/workspace/leaderboard/data/all_towns_traffic_scenarios_private.json";
const CHECKPOINT: &str = "/tmp/agent/agent_results.json";
const LIVE_RESULTS: &str = "/tmp/agent/live_results.txt";
/// A server prints little; one that floods must not fill the disk. In bytes.
const SIMULATOR_LOG_LIMIT: u64 = 64 << 20;

/// Port of a pair's simulator.
fn port(pair: Pair) -> usize {
    2000 + 100 * pair.index()
}

/// The simulator of a pair.
pub(super) fn simulator(input: &JobInput<'_>, pair: Pair) -> Container {
    let (spec, deadlines) = (&input.spec().simulator, input.deadlines());
    let own = input.track().and_then(|track| track.simulator.as_ref());
    let member = pair.host();
    let name = member.to_string();
    let (version, gpus) = (input.plan.leaderboard_version, source(input.spec()));
    let flags = [
        format!("--port={}", port(pair)),
        seconds("ready", deadlines.ready_seconds),
        seconds("flush", deadlines.flush_seconds),
        seconds("cancel", deadlines.cancel_seconds),
        format!("--log={}/{}", SAVED, console_name(pair)),
        format!("--log-limit={SIMULATOR_LOG_LIMIT}"),
    ];
    let flags = flags.into_iter().chain(gpu::check(gpus, needs(spec, version)));
    let host = commands::of_host(spec.command.as_deref(), spec.args.as_deref());
    let words = host.unwrap_or_else(|| commands::simulator(version, adapter(spec, gpus)));
    let env = [variable("CARLA_PORT", &port(pair).to_string())].into_iter();
    let env = env
        .chain(display::variables(spec, version))
        .chain(gpu::variables(gpus, member));
    let resources = effective::resources(own, spec.resources.as_ref());
    Container {
        image: Some(input.plan.simulator_image.to_string()),
        command: Some(behind_runner(member, flags, words)),
        env: Some(merged(env.collect(), &spec.env)),
        resources: gpu::resources(gpus, member, resources),
        security_context: Some(context(spec.security_context.as_ref())),
        volume_mounts: Some(volumes::of_simulator(input, &name)),
        name,
        ..Container::default()
    }
}

/// What the server draws with. Of a command of the host's that is not known.
fn needs(spec: &SimulatorContainer, version: LeaderboardVersion) -> Needs {
    match (&spec.command, version) {
        (Some(_), _) => Needs::Any,
        (None, LeaderboardVersion::V1) => Needs::OpenGl,
        (None, LeaderboardVersion::V2) => Needs::Vulkan,
    }
}

fn adapter(spec: &SimulatorContainer, gpus: GpuSource<'_>) -> Adapter {
    match (spec.graphics_adapter, gpus) {
        (Some(number), _) => Adapter::Numbered(number),
        (None, GpuSource::None) => Adapter::Unnamed,
        (None, _) => Adapter::Found,
    }
}

/// The agent of a pair.
pub(super) fn agent(input: &JobInput<'_>, pair: Pair) -> Container {
    let (spec, deadlines) = (&input.spec().agent, input.deadlines());
    let own = input.track().and_then(|track| track.agent.as_ref());
    let member = pair.agent();
    let name = member.to_string();
    let flags = [
        format!("--work={AGENT}"),
        format!("--checkpoint={CHECKPOINT}"),
        seconds("ready", deadlines.ready_seconds),
        seconds("idle", deadlines.idle_seconds),
        format!("--log-limit={}", spec.log_size_limit.bytes()),
        format!("--python-path={}", python_path()),
        format!("--route-runs={}", route_runs(input, pair)),
    ];
    let flags = flags.into_iter().chain(gpu::report(source(input.spec())));
    let host = commands::of_host(spec.command.as_deref(), spec.args.as_deref());
    let words = host.unwrap_or_else(|| commands::agent(input.plan.leaderboard_version));
    // The runner expands these words, so that RESUME is what it is in this round.
    let words = words.iter().map(|word| commands::literal(word)).collect();
    let resources = effective::resources(own, spec.resources.as_ref());
    Container {
        image: Some(input.plan.image.clone()),
        // Kubernetes asks for `latest` anew before each container: a pair, or a restart, could get another image.
        image_pull_policy: Some("IfNotPresent".into()),
        command: Some(behind_runner(member, flags, words)),
        env: Some(merged(agent_env(input, pair), &spec.env)),
        resources: gpu::resources(source(input.spec()), member, resources),
        security_context: Some(context(spec.security_context.as_ref())),
        volume_mounts: Some(volumes::of_agent(input, &name, pair)),
        name,
        ..Container::default()
    }
}

/// How many route runs the pair's evaluator is to drive; 0 if there were no slice for it.
fn route_runs(input: &JobInput<'_>, pair: Pair) -> u32 {
    let slice = input.plan.slices.get(pair.index());
    let repetitions = u32::try_from(input.plan.repetitions).unwrap_or(0);
    slice.map_or(0, |slice| slice.routes().saturating_mul(repetitions))
}

fn behind_runner(member: Member, flags: impl IntoIterator<Item = String>, words: Vec<String>) -> Vec<String> {
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
        .chain(words)
        .collect()
}

/// A flag of the runner, which counts seconds in 32 bits.
fn seconds(what: &str, value: i64) -> String {
    let value = value.clamp(0, u32::MAX.into());
    format!("--{what}-seconds={value}")
}

fn agent_env(input: &JobInput<'_>, pair: Pair) -> Vec<EnvVar> {
    let (plan, track) = (input.plan, input.track());
    let routes = track
        .and_then(|track| track.routes_file.as_deref())
        .unwrap_or(ROUTES_FILE);
    let scenarios = track
        .and_then(|track| track.scenarios_file.as_deref())
        .unwrap_or(SCENARIOS_FILE);
    let slice = plan.slices.get(pair.index());
    let slice = slice.map(ToString::to_string).unwrap_or_default();
    let mut env = vec![
        variable("CARLA_PORT", &port(pair).to_string()),
        variable("CARLA_TM_PORT", &(port(pair) + 10).to_string()),
        variable("CHALLENGE_TRACK_CODENAME", &plan.codename),
        variable("ROUTES", routes),
        variable("ROUTES_SUBSET", &slice),
        variable("REPETITIONS", &plan.repetitions.to_string()),
        variable("RESUME", resume(input)),
        variable("CHECKPOINT_ENDPOINT", CHECKPOINT),
        variable("RECORD_PATH", SAVED),
        variable("DEBUG_CHALLENGE", "0"),
        variable("CARLA_ROOT", CARLA_ROOT),
        variable("SCENARIO_RUNNER_ROOT", SCENARIO_RUNNER_ROOT),
        variable("LEADERBOARD_ROOT", LEADERBOARD_ROOT),
    ];
    env.push(match plan.leaderboard_version {
        LeaderboardVersion::V1 => variable("SCENARIOS", scenarios),
        // The original's file lies in the contents, which are read-only here.
        LeaderboardVersion::V2 => variable("DEBUG_CHECKPOINT_ENDPOINT", LIVE_RESULTS),
    });
    env.extend(gpu::variables(source(input.spec()), pair.agent()));
    env
}

/// The host's variables take the place of ours of the same name, but for those that follow from the plan.
fn merged(mut ours: Vec<EnvVar>, hosts: &[EnvVar]) -> Vec<EnvVar> {
    for variable in hosts
        .iter()
        .filter(|variable| !FIXED_ENV.contains(&variable.name.as_str()))
    {
        match ours.iter_mut().find(|known| known.name == variable.name) {
            Some(known) => known.clone_from(variable),
            None => ours.push(variable.clone()),
        }
    }
    ours
}
