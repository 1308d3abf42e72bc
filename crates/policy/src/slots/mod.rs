//! The order of waiting submissions (`turns`), the line of a Leaderboard (`line`), and its members (`member`).

pub mod line;
pub mod member;
pub mod turns;
