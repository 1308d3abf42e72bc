//! Runs the submissions of an AI challenge on Kubernetes and keeps EvalAI, S3 and DynamoDB true.
//!
//! The rooms and who may know what are drawn in docs/architecture.md.

pub mod bridge;
pub mod cli;
pub mod controller;
pub mod crds;
pub mod kubernetes;
pub mod observability;
pub mod pod;
pub mod services;
