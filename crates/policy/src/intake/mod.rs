//! What becomes of a message: what it says (`message`), and for which Leaderboard it is (`route`).

pub mod message;
pub mod route;
