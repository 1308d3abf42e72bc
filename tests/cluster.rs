//! The whole system on a real cluster: the operator's own programs, real Pods, and stand-ins for AWS and EvalAI.
//!
//! Each test has a namespace, queues, a table and a prefix in the bucket of its own. It runs the operator as child processes that it may
//! kill and stop. Six tests run at once, and up to ten while the processors have time left, begun in the order of their names. Each prints
//! its seconds.
//! `restarts` disturbs all others, so it runs alone, after them.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::disallowed_methods,
    reason = "clippy knows a test by its attribute; what tests call is a test too"
)]

#[path = "support/aws.rs"]
mod aws;
#[path = "support/evalai.rs"]
mod evalai;
#[path = "support/gate.rs"]
mod gate;
#[path = "support/old_pipeline.rs"]
mod old_pipeline;
#[path = "support/operator.rs"]
mod operator;
#[allow(dead_code, reason = "the tests of the API server play more of a cluster")]
#[path = "support/played.rs"]
mod played;
#[path = "support/processes.rs"]
mod processes;
#[path = "support/registry.rs"]
mod registry;
#[path = "support/cluster.rs"]
mod scene;

mod cluster {
    mod abrupt;
    mod abuse;
    mod attempts;
    mod audit;
    mod both_versions;
    mod bridge;
    mod bucket;
    mod checks;
    mod containers;
    mod crashes;
    mod cutover;
    mod edits;
    mod expected;
    mod failures;
    mod gpus;
    mod helm;
    mod hostile_containers;
    mod hostile_inputs;
    mod import;
    mod isolation;
    mod losses;
    mod matrix;
    mod matrix_evalai;
    mod matrix_outages;
    mod matrix_runs;
    mod matrix_stops;
    mod matrix_waits;
    mod modes;
    mod names;
    mod probe_endings;
    mod probes;
    mod publish;
    mod real_files;
    mod restarts;
    mod runs;
    mod stops;
}
