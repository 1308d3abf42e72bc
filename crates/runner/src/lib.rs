//! PID 1 of a simulator, an evaluator or an agent: starts the host's or the participant's program, and reports by files how it ended.
//!
//! `args` and `expand` read its command line, `graphics` finds what a simulator draws with. The files are `leaderboard-protocol`'s.
//! It may not know Kubernetes, S3 or EvalAI. `README.md` next to it describes the whole protocol.

pub mod args;
pub mod expand;
pub mod graphics;
