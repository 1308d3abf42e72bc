//! The way of a message: its content (`message`), and the Leaderboard that it is for (`route`).

#[cfg(any(test, feature = "fixtures"))]
#[allow(clippy::unwrap_used)]
pub mod fixtures;
pub mod message;
pub mod route;
