//! The default commands of the host's and the participant's images, and how words get past Kubernetes' expansion. Pure.
//!
//! Kubernetes replaces `$(NAME)` in a container's words and variables when it starts; the runner does the same with an
//! agent's words when it starts that, and knows the round. A shell comes last.

use crate::carla::layout::python_path;
use crate::workload::literal;
use leaderboard_api::LeaderboardVersion;

const ADAPTER: &str = "-ini:[/Script/Engine.RendererSettings]:r.GraphicsAdapter=";

/// Which graphics adapter a simulator draws with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Adapter {
    /// The engine chooses.
    Unnamed,
    Numbered(i32),
    /// The runner finds the number: it sees the devices of its container.
    Found,
}

impl Adapter {
    fn flag(self) -> Option<String> {
        match self {
            Self::Unnamed => None,
            Self::Numbered(number) => Some(format!("{ADAPTER}{number}")),
            Self::Found => Some(literal(&format!(
                "{ADAPTER}$({})",
                leaderboard_protocol::graphics::ADAPTER
            ))),
        }
    }
}

/// Copies the private contents into their volumes, which `contents` has below /tmp.
pub fn contents() -> Vec<String> {
    // Without the second line an image that sets none of the three would have its whole file system copied.
    let script = r#"set -e
: "${LEADERBOARD_ROOT:?}" "${SCENARIO_RUNNER_ROOT:?}" "${CARLA_PYTHON_API_ROOT:?}"
cp -r ${LEADERBOARD_ROOT}/* /tmp/leaderboard/
cp -r ${SCENARIO_RUNNER_ROOT}/* /tmp/scenario_runner/
cp -r ${CARLA_PYTHON_API_ROOT}/* /tmp/CARLA/
"#;
    in_bash(script.to_owned())
}

/// Starts CARLA's server. The values are Kubernetes' to expand, but for an adapter that the runner finds.
pub fn simulator(format: LeaderboardVersion, adapter: Adapter) -> Vec<String> {
    let flags: &[&str] = match format {
        LeaderboardVersion::V1 => &["-carla-rpc-port=$(CARLA_PORT)", "-opengl", "-nosound"],
        LeaderboardVersion::V2 => &[
            "-vulkan",
            "-carla-rpc-port=$(CARLA_PORT)",
            "-RenderOffScreen",
            "-nosound",
        ],
    };
    let adapter = match format {
        // OpenGL takes none.
        LeaderboardVersion::V1 => None,
        LeaderboardVersion::V2 => adapter.flag(),
    };
    let words = ["/bin/bash", "/home/carla/CarlaUE4.sh"];
    let words = words.into_iter().chain(flags.iter().copied()).map(Into::into);
    words.chain(adapter).collect()
}

/// Starts the evaluator with the participant's agent.
///
/// `$(NAME)` are the runner's to expand, before the shell sources anything of the image: only TEAM_AGENT and TEAM_CONFIG
/// are what the participant's files make of them.
pub fn agent(format: LeaderboardVersion) -> Vec<String> {
    let flags: Vec<String> = agent_flags(format).iter().map(|flag| format!("  {flag}")).collect();
    let front = python_path();
    // The image may put its own modules on the path, but not in front of the contents' leaderboard.
    let script = format!(
        r#"[ -f ~/.bashrc ] && source ~/.bashrc
[ -f ~/agent_sources.sh ] && source ~/agent_sources.sh
: "${{TEAM_AGENT:?the image must set TEAM_AGENT to the path of its agent}}"
case "${{PYTHONPATH-}}:" in
  '{front}:'*) ;;
  *) export PYTHONPATH='{front}'"${{PYTHONPATH:+:$PYTHONPATH}}" ;;
esac
exec python3 -u '$(LEADERBOARD_ROOT)/leaderboard/leaderboard_evaluator.py' \
{}
"#,
        flags.join(" \\\n")
    );
    in_bash(script)
}

fn agent_flags(format: LeaderboardVersion) -> &'static [&'static str] {
    match format {
        LeaderboardVersion::V1 => &[
            "'--port=$(CARLA_PORT)'",
            "'--trafficManagerPort=$(CARLA_TM_PORT)'",
            r#""--agent=${TEAM_AGENT}""#,
            r#""--agent-config=${TEAM_CONFIG-}""#,
            "'--track=$(CHALLENGE_TRACK_CODENAME)'",
            "'--routes=$(ROUTES)'",
            "'--routes-subset=$(ROUTES_SUBSET)'",
            "'--scenarios=$(SCENARIOS)'",
            "'--repetitions=$(REPETITIONS)'",
            "'--resume=$(RESUME)'",
            "'--checkpoint=$(CHECKPOINT_ENDPOINT)'",
            "'--record=$(RECORD_PATH)'",
            "'--debug=$(DEBUG_CHALLENGE)'",
        ],
        LeaderboardVersion::V2 => &[
            "'--port=$(CARLA_PORT)'",
            "'--traffic-manager-port=$(CARLA_TM_PORT)'",
            r#""--agent=${TEAM_AGENT}""#,
            r#""--agent-config=${TEAM_CONFIG-}""#,
            "'--track=$(CHALLENGE_TRACK_CODENAME)'",
            "'--routes=$(ROUTES)'",
            "'--routes-subset=$(ROUTES_SUBSET)'",
            "'--repetitions=$(REPETITIONS)'",
            "'--resume=$(RESUME)'",
            "'--checkpoint=$(CHECKPOINT_ENDPOINT)'",
            "'--record=$(RECORD_PATH)'",
            "'--debug-checkpoint=$(DEBUG_CHECKPOINT_ENDPOINT)'",
            "'--debug=$(DEBUG_CHALLENGE)'",
        ],
    }
}

fn in_bash(script: String) -> Vec<String> {
    vec!["/bin/bash".into(), "-c".into(), script]
}
