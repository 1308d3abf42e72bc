//! Clients of the services around the cluster, one module a service. They know no Kubernetes objects and no policy
//! but their own (EvalAI's budget and guard, DynamoDB's conditions).

pub mod archive;
pub mod aws;
pub mod endpoints;
pub mod evalai;
pub mod fault;
pub mod log_groups;
pub mod logs;
pub mod metered;
pub mod public;
pub mod queue;
pub mod secrets;
pub mod table;
pub mod token;
