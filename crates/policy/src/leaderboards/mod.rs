//! The status of a Leaderboard (`decide`, `standings`), and the names that it may not use (`refusal`).

pub mod decide;
pub mod isolated;
pub mod refusal;
pub mod standings;
pub mod view;
