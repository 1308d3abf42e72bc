//! Where a simulator draws: what its program finds of a screen. Pure.
//!
//! SDL decides by a variable, which images of CARLA set to `x11`. On no screen, Unreal Engine 4.24 (V1) needs `offscreen` for it, and
//! 4.26 (V2) `dummy`.

use k8s_openapi::api::core::v1::{EnvVar, HostPathVolumeSource, Volume, VolumeMount};
use leaderboard_api::{Display, LeaderboardSpec, LeaderboardVersion, SimulatorContainer};
use leaderboard_runner::protocol::Side;
use serde_json::Value;

use super::gpu::member;
use super::{JobInput, variable};

const DRIVER: &str = "SDL_VIDEODRIVER";
const SCREEN: &str = "DISPLAY";
const COOKIES: &str = "XAUTHORITY";
/// Where X servers have their sockets.
const SOCKETS: &str = "/tmp/.X11-unix";
const SOCKETS_VOLUME: &str = "x11-sockets";

/// The variables of a simulator.
pub(super) fn variables(simulator: &SimulatorContainer, version: LeaderboardVersion) -> Vec<EnvVar> {
    match (simulator.display, version) {
        (Display::Offscreen, LeaderboardVersion::V1) => vec![variable(DRIVER, "offscreen")],
        (Display::Offscreen, LeaderboardVersion::V2) => vec![variable(DRIVER, "dummy")],
        (Display::X11Socket, _) => {
            let x11 = simulator.x11.clone().unwrap_or_default();
            vec![variable(DRIVER, "x11"), variable(SCREEN, &x11.display)]
        }
    }
}

/// The node's sockets, which the node must have.
pub(super) fn volume(input: &JobInput<'_>) -> Option<Volume> {
    is_on_x11(input).then(|| Volume {
        name: SOCKETS_VOLUME.into(),
        host_path: Some(HostPathVolumeSource {
            path: SOCKETS.into(),
            type_: Some("Directory".into()),
        }),
        ..Volume::default()
    })
}

/// The same in a simulator.
pub(super) fn mount(input: &JobInput<'_>) -> Option<VolumeMount> {
    is_on_x11(input).then(|| VolumeMount {
        name: SOCKETS_VOLUME.into(),
        mount_path: SOCKETS.into(),
        read_only: Some(true),
        ..VolumeMount::default()
    })
}

fn is_on_x11(input: &JobInput<'_>) -> bool {
    input.spec().simulator.display == Display::X11Socket
}

/// Takes what its image sets of a screen from a simulator that draws on none. A Pod cannot remove a variable, so the runner does; what
/// the host sets stays.
pub(super) fn settle(container: &mut Value, spec: &LeaderboardSpec) {
    let is_simulator = member(container).is_some_and(|member| member.side == Side::Host);
    if !is_simulator || spec.simulator.display != Display::Offscreen {
        return;
    }
    let env = container["env"].as_array().map(Vec::as_slice).unwrap_or_default();
    let is_set = |name: &&str| env.iter().any(|variable| variable["name"] == *name);
    let removed: Vec<&str> = [SCREEN, COOKIES].into_iter().filter(|name| !is_set(name)).collect();
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
