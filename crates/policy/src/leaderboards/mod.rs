//! What a Leaderboard's status shows (`decide`, `standings`), and what it names and may not (`refusal`).

pub mod decide;
pub mod isolated;
pub mod refusal;
pub mod standings;
pub mod view;
