//! All that the operator decides, as pure functions of what was observed: a submission's next step (`submissions`), what a Leaderboard's
//! status shows (`leaderboards`), whose turn it is (`slots`), and what becomes of a message (`intake`).
//!
//! ```text
//! observe ──▶ view ──▶ submissions::decide ──▶ plan ──▶ act       a submission
//!             leaderboards::view ──▶ leaderboards::decide         a Leaderboard's status
//!             slots::line, slots::turns                           who starts next
//!             intake::message, intake::route                      which Leaderboard a message is for
//! ```
//!
//! `view` is what is observed, `ask` and `questions` are what decisions want to know of other services. Time is handed in. No client, no
//! file, no environment and no clock: clippy.toml refuses them, and a test of the tree refuses the libraries that would bring them.

pub mod allowed;
pub mod ask;
pub mod census;
pub mod intake;
pub mod leaderboards;
pub mod phases;
pub mod questions;
pub mod report_digest;
pub mod slots;
pub mod submissions;
pub mod view;
