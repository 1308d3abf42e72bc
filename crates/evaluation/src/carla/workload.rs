//! CARLA's simulators and agents: images, commands, flags, variables and mounts of a pair. Pure.
//!
//! Both programs see the flags and variables of the original setup, version by version.

use super::commands::{self, Adapter};
use super::display;
use super::layout::{CARLA_ROOT, LEADERBOARD_ROOT, SCENARIO_RUNNER_ROOT, python_path};
use crate::workload::{
    AGENT, Asked, Contents, ContentsVolume, HOST_LOG_LIMIT, Mount, Reserved, Role, Workload, literal, of_host, seconds,
};
use leaderboard_api::{ByteQuantity, Carla, CarlaPlan, LeaderboardVersion, SimulatorContainer};
use leaderboard_contract::keys::{agent_folder, host_folder, host_log_name};
use leaderboard_protocol::files::Pair;
use leaderboard_protocol::graphics::Needs;

const ROUTES_FILE: &str = "/workspace/leaderboard/data/routes_testing.xml";
const SCENARIOS_FILE: &str = "/workspace/leaderboard/data/all_towns_traffic_scenarios_private.json";
const CHECKPOINT: &str = "/tmp/agent/agent_results.json";
const LIVE_RESULTS: &str = "/tmp/agent/live_results.txt";
/// The folder that a simulator writes.
const SAVED: &str = "/home/carla/CarlaUE4/Saved";
const CONTENTS_VOLUMES: [ContentsVolume; 3] = [
    ContentsVolume {
        name: "leaderboard",
        written: "/tmp/leaderboard",
        read: LEADERBOARD_ROOT,
    },
    ContentsVolume {
        name: "scenario-runner",
        written: "/tmp/scenario_runner",
        read: SCENARIO_RUNNER_ROOT,
    },
    ContentsVolume {
        name: "carla-python-api",
        written: "/tmp/CARLA",
        read: CARLA_ROOT,
    },
];
/// They follow from the plan.
const FIXED_ENV: [&str; 12] = [
    "CARLA_PORT",
    "CARLA_TM_PORT",
    "CHALLENGE_TRACK_CODENAME",
    "ROUTES",
    "ROUTES_SUBSET",
    "SCENARIOS",
    "REPETITIONS",
    "RESUME",
    "CHECKPOINT_ENDPOINT",
    "CARLA_ROOT",
    "SCENARIO_RUNNER_ROOT",
    "LEADERBOARD_ROOT",
];

pub(super) fn reserved() -> Reserved {
    Reserved {
        env: FIXED_ENV.to_vec(),
        volumes: &CONTENTS_VOLUMES,
        folders: vec![AGENT, SAVED],
    }
}

/// Settings of a workload, of this kind.
struct Known<'a> {
    asked: &'a Asked<'a>,
    spec: &'a Carla,
    plan: &'a CarlaPlan,
}

impl<'a> Known<'a> {
    /// `None` if plan or Leaderboard are of another kind.
    fn of(asked: &'a Asked<'a>) -> Option<Self> {
        let (spec, plan) = (asked.spec.evaluation.carla()?, asked.plan.carla()?);
        Some(Self { asked, spec, plan })
    }
}

/// Port of a pair's simulator.
fn port(pair: Pair) -> usize {
    pair.index().saturating_mul(100).saturating_add(2000)
}

/// The container with the private contents.
pub(super) fn contents(asked: &Asked<'_>) -> Option<Contents> {
    let known = Known::of(asked)?;
    let spec = &known.spec.contents;
    let host = of_host(spec.command.as_deref(), spec.args.as_deref());
    Some(Contents {
        image: known.plan.contents_image.to_string(),
        command: host.unwrap_or_else(commands::contents),
    })
}

/// The simulator and the agent of a pair.
pub(super) fn workload(asked: &Asked<'_>, pair: Pair) -> Option<Workload> {
    let known = Known::of(asked)?;
    Some(Workload {
        host: simulator(&known, pair),
        agent: Some(agent(&known, pair)?),
    })
}

fn simulator(known: &Known<'_>, pair: Pair) -> Role {
    let (spec, deadlines) = (&known.spec.simulator, &known.asked.deadlines);
    let version = known.plan.version;
    let flags = vec![
        format!("--port={}", port(pair)),
        seconds("ready", deadlines.ready_seconds),
        seconds("flush", deadlines.flush_seconds),
        seconds("cancel", deadlines.cancel_seconds),
        format!("--log={}/{}", SAVED, host_log_name(super::HOST, pair)),
        format!("--log-limit={HOST_LOG_LIMIT}"),
    ];
    let own = Mount::Own {
        folder: host_folder(super::HOST, pair),
        path: SAVED,
    };
    let port = ("CARLA_PORT", port(pair).to_string());
    Role {
        image: known.plan.simulator_image.to_string(),
        flags,
        command: of_host(spec.command.as_deref(), spec.args.as_deref())
            .unwrap_or_else(|| commands::simulator(version, adapter(spec, known.asked.has_gpus))),
        env: [port].into_iter().chain(display::variables(spec, version)).collect(),
        mounts: [own].into_iter().chain(display::sockets(spec)).collect(),
        shm: None,
        removes: display::removed(spec),
        draws: Some(needs(spec, version)),
    }
}

/// The graphics API that the server draws with. `Any` if the host has a command of its own: it may start any server.
fn needs(spec: &SimulatorContainer, version: LeaderboardVersion) -> Needs {
    match (&spec.command, version) {
        (Some(_), _) => Needs::Any,
        (None, LeaderboardVersion::V1) => Needs::OpenGl,
        (None, LeaderboardVersion::V2) => Needs::Vulkan,
    }
}

fn adapter(spec: &SimulatorContainer, has_gpus: bool) -> Adapter {
    match spec.graphics_adapter {
        Some(number) => Adapter::Numbered(number),
        None if has_gpus => Adapter::Found,
        None => Adapter::Unnamed,
    }
}

/// `None` for a submission without an image.
fn agent(known: &Known<'_>, pair: Pair) -> Option<Role> {
    let (spec, deadlines) = (&known.asked.spec.agent, &known.asked.deadlines);
    let flags = vec![
        format!("--work={AGENT}"),
        format!("--checkpoint={CHECKPOINT}"),
        seconds("ready", deadlines.ready_seconds),
        seconds("idle", deadlines.idle_seconds),
        format!("--log-limit={}", spec.log_size_limit.bytes()),
        format!("--python-path={}", python_path()),
        format!("--route-runs={}", route_runs(known.plan, pair)),
    ];
    let host = of_host(spec.command.as_deref(), spec.args.as_deref());
    let words = host.unwrap_or_else(|| commands::agent(known.plan.version));
    let own = Mount::Own {
        folder: agent_folder(pair),
        path: AGENT,
    };
    Some(Role {
        image: known.asked.plan.image.clone()?,
        flags,
        // The runner expands these words, so that RESUME is what it is in this round.
        command: words.iter().map(|word| literal(word)).collect(),
        env: agent_env(known, pair),
        mounts: CONTENTS_VOLUMES.map(Mount::Contents).into_iter().chain([own]).collect(),
        shm: spec.shm_size.as_ref().map(ByteQuantity::bytes),
        removes: &[],
        draws: None,
    })
}

/// How many route runs the pair's evaluator is to drive; 0 if there were no slice for it.
fn route_runs(plan: &CarlaPlan, pair: Pair) -> u32 {
    let slice = plan.slices.get(pair.index());
    let repetitions = u32::try_from(plan.repetitions).unwrap_or(0);
    slice.map_or(0, |slice| slice.routes().saturating_mul(repetitions))
}

fn agent_env(known: &Known<'_>, pair: Pair) -> Vec<(&'static str, String)> {
    let (plan, track) = (known.plan, known.asked.track);
    let routes = track
        .and_then(|track| track.carla.routes_file.as_deref())
        .unwrap_or(ROUTES_FILE);
    let scenarios = track
        .and_then(|track| track.carla.scenarios_file.as_deref())
        .unwrap_or(SCENARIOS_FILE);
    let slice = plan.slices.get(pair.index());
    let resume = if known.asked.resume { "1" } else { "" };
    vec![
        ("CARLA_PORT", port(pair).to_string()),
        ("CARLA_TM_PORT", port(pair).saturating_add(10).to_string()),
        ("CHALLENGE_TRACK_CODENAME", plan.codename.to_string()),
        ("ROUTES", routes.to_owned()),
        ("ROUTES_SUBSET", slice.map(ToString::to_string).unwrap_or_default()),
        ("REPETITIONS", plan.repetitions.to_string()),
        ("RESUME", resume.to_owned()),
        ("CHECKPOINT_ENDPOINT", CHECKPOINT.to_owned()),
        ("RECORD_PATH", SAVED.to_owned()),
        ("DEBUG_CHALLENGE", "0".to_owned()),
        ("CARLA_ROOT", CARLA_ROOT.to_owned()),
        ("SCENARIO_RUNNER_ROOT", SCENARIO_RUNNER_ROOT.to_owned()),
        ("LEADERBOARD_ROOT", LEADERBOARD_ROOT.to_owned()),
        match plan.version {
            LeaderboardVersion::V1 => ("SCENARIOS", scenarios.to_owned()),
            // The original's file lies in the contents, which are read-only here.
            LeaderboardVersion::V2 => ("DEBUG_CHECKPOINT_ENDPOINT", LIVE_RESULTS.to_owned()),
        },
    ]
}
