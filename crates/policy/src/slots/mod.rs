//! Whose turn it is: the order of turns (`turns`), the line of a Leaderboard (`line`), and who stands in it (`member`).

pub mod line;
pub mod member;
pub mod turns;
