//! The commit that a program was built from.

/// The commit that was built; empty where the build was given none.
pub const REVISION: &str = match option_env!("LEADERBOARD_REVISION") {
    Some(revision) => revision,
    None => "",
};
