//! What becomes of a message: what it says (`message`), and for which Leaderboard it is (`route`).

#[cfg(any(test, feature = "fixtures"))]
#[allow(clippy::unwrap_used)]
pub mod fixtures;
pub mod message;
pub mod route;
