//! Where the CARLA Leaderboard looks for its parts inside a container.

pub const CARLA_ROOT: &str = "/workspace/CARLA";
pub const SCENARIO_RUNNER_ROOT: &str = "/workspace/scenario_runner";
pub const LEADERBOARD_ROOT: &str = "/workspace/leaderboard";

/// Puts what the original's script put there in front of the image's own PYTHONPATH.
pub fn python_path() -> String {
    format!("{CARLA_ROOT}/PythonAPI/carla:{SCENARIO_RUNNER_ROOT}:{LEADERBOARD_ROOT}")
}
