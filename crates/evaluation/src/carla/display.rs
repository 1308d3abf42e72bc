//! Where a simulator draws: what its program finds of a screen. Pure.
//!
//! SDL decides by a variable, which images of CARLA set to `x11`. On no screen, Unreal Engine 4.24 (V1) needs `offscreen` for it, and
//! 4.26 (V2) `dummy`.

use leaderboard_api::{Display, LeaderboardVersion, SimulatorContainer};

use crate::workload::Mount;

const DRIVER: &str = "SDL_VIDEODRIVER";
const SCREEN: &str = "DISPLAY";
const COOKIES: &str = "XAUTHORITY";

/// The variables of a simulator.
pub(super) fn variables(simulator: &SimulatorContainer, version: LeaderboardVersion) -> Vec<(&'static str, String)> {
    match (simulator.display, version) {
        (Display::Offscreen, LeaderboardVersion::V1) => vec![(DRIVER, "offscreen".into())],
        (Display::Offscreen, LeaderboardVersion::V2) => vec![(DRIVER, "dummy".into())],
        (Display::X11Socket, _) => {
            let x11 = simulator.x11.clone().unwrap_or_default();
            vec![(DRIVER, "x11".into()), (SCREEN, x11.display)]
        }
    }
}

/// Where X servers have their sockets.
pub(super) fn sockets(simulator: &SimulatorContainer) -> Option<Mount> {
    (simulator.display == Display::X11Socket).then_some(Mount::OfNode {
        volume: "x11-sockets",
        path: "/tmp/.X11-unix",
    })
}

/// Variables of the image that the container does not get: with no screen, those that name one.
pub(super) fn removed(simulator: &SimulatorContainer) -> &'static [&'static str] {
    match simulator.display {
        Display::Offscreen => &[SCREEN, COOKIES],
        Display::X11Socket => &[],
    }
}
