//! Clients of AWS, one module a service: S3 as the folder of one run (`archive`), DynamoDB's rows (`table`), CloudWatch Logs (`logs`,
//! `log_groups`), SQS (`queue`), Secrets Manager (`secrets`). Each call is counted (`metered`), and its error is a sentence (`fault`).
//!
//! They know no Kubernetes object and no policy but their own: the conditions by which rows are written.

pub mod archive;
pub mod clients;
pub mod endpoints;
pub mod fault;
pub mod log_groups;
pub mod logs;
pub mod metered;
pub mod queue;
pub mod secrets;
pub mod table;
