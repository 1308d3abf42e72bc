//! Makes a Submission of what comes in: a message of the bridge, a row of EvalAI's own queue (`inbox`), or one that a sweep finds.

pub mod ages;
pub mod inbox;
pub mod ingest;
pub mod leaderboards;
pub mod poller;
pub mod pollers;
pub mod shared;
pub mod source;
pub mod sweep;
