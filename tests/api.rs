//! Tests that need a real API server: it takes the definitions, refuses faulty objects, fills in defaults, and prints columns.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::disallowed_methods,
    reason = "clippy knows a test by its attribute; what tests call is a test too"
)]

mod support;

mod api {
    mod allowed;
    mod boards;
    mod bridge;
    mod claims;
    mod columns;
    mod containers;
    mod counts;
    mod definitions;
    mod endpoints;
    mod evalai;
    mod examples;
    mod failover;
    mod failures;
    mod images;
    mod import;
    mod inbox;
    mod intake;
    mod isolation;
    mod leader;
    mod log_groups;
    mod memory;
    mod objects;
    mod operator;
    mod page;
    mod plugin;
    mod pod;
    mod pod_security;
    mod process;
    mod prometheus;
    mod queue;
    mod restore;
    mod retention;
    mod rights;
    mod rule_cases;
    mod rules;
    mod scale;
    mod shared_queue;
    mod slots;
    mod standings;
    mod suspended;
    mod switch;
    mod table;
    mod token;
    mod traces;
    mod two_operators;
    mod watches;
    mod world;
}
