//! The names of what the benchmark makes.

/// The submission whose bodies are taken.
pub const SAMPLE: &str = "run-99999";
/// The submission that warms everything up; it is not measured.
pub const WARM_NAME: &str = "run-99998";
/// Name of the Leaderboard.
pub const LEADERBOARD: &str = "carla";
