//! What only a real API server can tell: whether it takes the definitions, and what it then refuses, fills in and shows.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "clippy knows a test by its attribute; what tests call is a test too"
)]

mod support;

mod api {
    mod allowed;
    mod boards;
    mod bridge;
    mod charging;
    mod columns;
    mod counts;
    mod definitions;
    mod endpoints;
    mod evalai;
    mod examples;
    mod failures;
    mod images;
    mod intake;
    mod isolation;
    mod leader;
    mod memory;
    mod objects;
    mod operator;
    mod plugin;
    mod pod;
    mod pod_security;
    mod queue;
    mod retention;
    mod rights;
    mod rule_cases;
    mod rules;
    mod scale;
    mod slots;
    mod table;
    mod token;
    mod two_operators;
    mod watches;
    mod world;
}
