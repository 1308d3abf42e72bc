//! Runs the submissions of an AI challenge on Kubernetes and keeps EvalAI, S3 and DynamoDB in sync.
//!
//! The modules and what each may import are drawn in docs/architecture.md.

pub mod ask;
pub mod bridge;
pub mod cli;
pub mod controller;
pub mod crds;
pub mod kubernetes;
pub mod observability;
pub mod page;
