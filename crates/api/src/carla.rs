//! The evaluation of the CARLA Leaderboard in the spec and the status of a Leaderboard: pairs of a simulator and an agent share out
//! the routes of a run.
//!
//! Owned by `api`. A track lays its own fields over those of the Leaderboard; `api::effective` computes the result.

use k8s_openapi::api::core::v1::{EnvVar, ResourceRequirements, SecurityContext};
use kube::KubeSchema;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::gpu::{Display, X11};
use super::route_slice::RouteSlice;
pub use super::route_subset::RouteSubset;
use super::shared_text::SharedText;
use super::track_container::TrackContainer;

/// A version of CARLA Leaderboard: it chooses the format of the checkpoints, the flags of the programs and some defaults.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, PartialEq, Eq)]
pub enum LeaderboardVersion {
    /// Leaderboard 1.0.
    V1,
    /// Leaderboard 2.0 and later.
    V2,
}

/// Treatment of scores that do not follow from their infractions.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Verify {
    /// Nothing is recomputed.
    Disabled,
    /// A difference is shown, the results count.
    #[default]
    Warn,
    /// A difference makes the results invalid.
    Refuse,
}

/// The evaluation of the CARLA Leaderboard.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
pub struct Carla {
    /// The version of CARLA Leaderboard, V1 for 1.0 and V2 for 2.0 and later: the format of the checkpoints, the flags of the programs and some defaults.
    pub version: LeaderboardVersion,
    /// The init container that brings the private contents.
    pub contents: ContentsContainer,
    /// The simulator of each pair.
    pub simulator: SimulatorContainer,
    /// Number of simulator-agent pairs that share out the routes.
    #[serde(default = "defaults::pairs")]
    #[schemars(range(min = 1, max = 16))]
    pub pairs: i32,
    /// Number of routes of a run, not counting repetitions.
    #[serde(default = "defaults::routes")]
    #[schemars(range(min = 1, max = 10000))]
    pub routes: i32,
    /// Number of times that each route is run. Default: 5 in V1, 1 in V2.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 1, max = 100))]
    pub repetitions: Option<i32>,
    /// Treatment of scores that do not follow from their infractions.
    #[serde(default)]
    pub verify: Verify,
}

/// The overlay of one track over `evaluation.carla`.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Debug, Default, PartialEq)]
#[serde(rename_all = "camelCase")]
#[x_kube(validation = Rule::new("!has(self.routeSubsets) || self.routeSubsets.all(s, int(s.split('-')[0]) <= int(s.split('-')[1]))").message("an entry of routeSubsets ends before it begins; write first-last, for example 5-9"))]
pub struct TrackCarla {
    /// The agent's CHALLENGE_TRACK_CODENAME, for example `SENSORS`. Default: the track's name.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(min = 1, max = 64), regex(pattern = r"^[A-Za-z0-9_.-]+$"))]
    pub codename: Option<String>,
    /// Number of routes, in place of the Leaderboard's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 1, max = 10000))]
    pub routes: Option<i32>,
    /// Number of repetitions, in place of the Leaderboard's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 1, max = 100))]
    pub repetitions: Option<i32>,
    /// Number of pairs, in place of the Leaderboard's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 1, max = 16))]
    pub pairs: Option<i32>,
    /// ROUTES_SUBSET of each pair in place of equal slices, each as `first-last`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(min = 1, max = 16))]
    pub route_subsets: Option<Vec<RouteSubset>>,
    /// File of the routes in the contents.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 512), regex(pattern = r"^/[A-Za-z0-9_./-]+$"))]
    pub routes_file: Option<String>,
    /// File of the scenarios in the contents (V1).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 512), regex(pattern = r"^/[A-Za-z0-9_./-]+$"))]
    pub scenarios_file: Option<String>,
    /// Overrides of the Leaderboard's simulator.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub simulator: Option<TrackContainer>,
}

impl TrackCarla {
    pub(super) fn is_empty(&self) -> bool {
        *self == Self::default()
    }
}

/// The init container that copies the private contents into shared volumes.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
#[x_kube(validation = Rule::new("!has(self.args) || has(self.command)").message("evaluation.carla.contents.args without evaluation.carla.contents.command would be added to the default command; write the command too"))]
pub struct ContentsContainer {
    /// Image with the private contents.
    #[schemars(length(min = 1, max = 512), regex(pattern = r"^[^\s]+$"))]
    pub image: String,
    /// Default: copies `$LEADERBOARD_ROOT`, `$SCENARIO_RUNNER_ROOT` and `$CARLA_PYTHON_API_ROOT`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub command: Option<Vec<String>>,
    /// Arguments of the command.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub args: Option<Vec<String>>,
    /// Environment variables beside those that the operator sets.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[x_kube(merge_strategy = ListMerge::Map(vec!["name".into()]))]
    pub env: Vec<EnvVar>,
    /// Requests and limits of the container.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub resources: Option<ResourceRequirements>,
    /// Laid over the safe default field by field. To remove one of its fields, set it to null in podOverrides.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub security_context: Option<SecurityContext>,
}

/// The simulator container of each pair.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
#[x_kube(
    validation = Rule::new("!has(self.args) || has(self.command)").message("evaluation.carla.simulator.args without evaluation.carla.simulator.command would be added to the default command; write the command too"),
    validation = Rule::new("!has(self.x11) || self.display == 'X11Socket'").message("evaluation.carla.simulator.x11 is for evaluation.carla.simulator.display X11Socket; set that display, or leave x11 out"),
    validation = Rule::new("!has(self.graphicsAdapter) || !has(self.command)").message("evaluation.carla.simulator.graphicsAdapter is a flag of the default command; write it into evaluation.carla.simulator.command")
)]
pub struct SimulatorContainer {
    /// Image of the simulator.
    #[schemars(length(min = 1, max = 512), regex(pattern = r"^[^\s]+$"))]
    pub image: String,
    /// Default: CARLA's start script with the flags of the version.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub command: Option<Vec<String>>,
    /// Arguments of the command.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub args: Option<Vec<String>>,
    /// Environment variables beside those that the operator sets.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[x_kube(merge_strategy = ListMerge::Map(vec!["name".into()]))]
    pub env: Vec<EnvVar>,
    /// Requests and limits; GPUs are requested by the field `gpu` of the Leaderboard.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub resources: Option<ResourceRequirements>,
    /// Laid over the safe default field by field. To remove one of its fields, set it to null in podOverrides.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub security_context: Option<SecurityContext>,
    /// `Offscreen`: on no screen; SDL_VIDEODRIVER is `offscreen` in V1 and `dummy` in V2, and the simulator has no DISPLAY and no XAUTHORITY of its image. `X11Socket`: on the node's X server, by its socket in /tmp/.X11-unix; the namespace then needs Pod Security `privileged`. What `env` sets takes precedence.
    #[serde(default)]
    pub display: Display,
    /// The node's X server, for `X11Socket`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub x11: Option<X11>,
    /// Number of the graphics adapter of every simulator, for nodes where Vulkan counts otherwise than the devices. Default: the one GPU that a simulator sees; if it sees several, that of its pair. V2 only.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 0, max = 255))]
    pub graphics_adapter: Option<i32>,
}

/// What a run of the CARLA Leaderboard consists of.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
pub struct CarlaPlan {
    /// The version of CARLA Leaderboard: the format of the checkpoints, the flags of the programs and some defaults.
    pub version: LeaderboardVersion,
    /// The agent's CHALLENGE_TRACK_CODENAME.
    #[schemars(length(max = 64))]
    pub codename: SharedText,
    /// Routes of each pair; their number is the number of pairs.
    #[schemars(length(max = 16))]
    pub slices: Vec<RouteSlice>,
    /// Number of routes, not counting repetitions.
    pub routes: i32,
    /// Number of repetitions of each route.
    pub repetitions: i32,
    /// Image of the contents, renewed by each attempt.
    #[schemars(length(max = 512))]
    pub contents_image: SharedText,
    /// Image of the simulator, renewed by each attempt.
    #[schemars(length(max = 512))]
    pub simulator_image: SharedText,
}

/// The numbers of what a track effectively runs.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, Default, PartialEq, Eq)]
pub struct CarlaShape {
    /// Number of simulator-agent pairs.
    pub pairs: i32,
    /// Number of routes, not counting repetitions.
    pub routes: i32,
    /// Number of repetitions of each route.
    pub repetitions: i32,
}

mod defaults {
    pub(super) fn pairs() -> i32 {
        4
    }
    pub(super) fn routes() -> i32 {
        20
    }
}
