//! Parts that all of the operator shares. None of them depends on the operator's other parts.
//!
//! Tasks that end the process when they fail (`tasks`), the stop that all of them watch (`shutdown`), pauses between tries (`backoff`),
//! the span that all log lines of a submission share (`spans`, `trace_id`), the meter that calls to other services are counted by, and the
//! `clock` that tells a process the time.

pub mod backoff;
pub mod clock;
pub mod lock;
pub mod meter;
pub mod object_key;
pub mod shutdown;
pub mod spans;
pub mod tasks;
pub mod trace_id;
