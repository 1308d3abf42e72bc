//! The parts of a Leaderboard's spec that define where submissions come from and where results go: EvalAI, SQS, S3,
//! DynamoDB and CloudWatch, each with its own rules and defaults.
//!
//! Owned by `api`; `leaderboard_parts` hands them on.

use std::collections::BTreeMap;

use kube::KubeSchema;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::byte_quantity::ByteQuantity;
use super::evalai_mode::EvalaiMode;
use super::evalai_queue::EvalaiQueue;
use super::keeping::StorageClass;

/// Holds of an endpoint without a query and without credentials: it is shown in conditions, logs and reports.
const PLAIN_ENDPOINT: &str = "!has(self.endpoint) || !(self.endpoint.contains('?') || self.endpoint.contains('#') || self.endpoint.contains('@'))";

/// Who may read the tail of a failed submission's log in EvalAI.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LogTail {
    /// Only the challenge's hosts: an agent can print the private routes.
    #[default]
    Hosts,
    /// The participant too.
    Participants,
}

/// The EvalAI challenge that submissions come from.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
#[x_kube(
    validation = Rule::new("!self.apiServer.matches('^https?://[^/]+(/.*)?/api(/|$)')").message("evalai.apiServer is the server's root without /api, for example https://eval.ai"),
    validation = Rule::new("!self.apiServer.contains('?') && !self.apiServer.contains('#') && !self.apiServer.contains('@')").message("evalai.apiServer may hold neither a query nor credentials: the token belongs into a Secret")
)]
pub struct Evalai {
    /// Root of the server, for example `https://eval.ai`.
    #[schemars(length(max = 512), regex(pattern = r"^https?://[^/\s]+(/\S*)?$"))]
    pub api_server: String,
    /// Id of the challenge.
    #[schemars(range(min = 1))]
    pub challenge: i64,
    /// Codename of the dataset split that results belong to.
    #[serde(default = "defaults::split")]
    #[schemars(length(min = 1, max = 128))]
    pub split: String,
    /// Token of a member of the host team, for EvalAI's API.
    pub token: Token,
    /// Requests per minute of this token; the server's own limit is 60, shared with the host's browser.
    #[serde(default = "defaults::requests_per_minute")]
    #[schemars(range(min = 6, max = 6000))]
    pub requests_per_minute: i32,
    /// Seconds between two sweeps for submissions whose message was lost.
    #[serde(default = "defaults::sweep_seconds")]
    #[schemars(range(min = 5, max = 86400))]
    pub sweep_seconds: i64,
    /// Readers of the tail of a failed submission's log.
    #[serde(default)]
    pub log_tail: LogTail,
    /// Mode of the challenge: results go to EvalAI, or the submissions of another program are only run once more.
    #[serde(default)]
    pub mode: EvalaiMode,
}

impl Evalai {
    /// The server in one spelling: two Leaderboards of one server are compared by it.
    pub fn server(&self) -> String {
        let root = self.api_server.trim_end_matches('/');
        let host = root.find("://").map_or(0, |at| at + 3);
        let path = root[host..].find('/').map_or(root.len(), |at| host + at);
        format!("{}{}", root[..path].to_ascii_lowercase(), &root[path..])
    }
}

/// Where EvalAI's token is kept: exactly one of the two.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
#[x_kube(validation = Rule::new("has(self.secretKeyRef) != has(self.secretsManager)").message("evalai.token needs exactly one of secretKeyRef and secretsManager"))]
pub struct Token {
    /// A key of a Secret in the Leaderboard's namespace.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub secret_key_ref: Option<SecretKey>,
    /// An entry of AWS Secrets Manager that holds a JSON object.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub secrets_manager: Option<SecretsManagerKey>,
}

/// A key of a Secret.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
pub struct SecretKey {
    /// Name of the Secret.
    #[schemars(length(min = 1, max = 253))]
    pub name: String,
    /// Key within it.
    #[schemars(length(min = 1, max = 253))]
    pub key: String,
}

/// A key of a JSON object in AWS Secrets Manager.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Debug, PartialEq, Eq)]
#[x_kube(validation = Rule::new(PLAIN_ENDPOINT).message("secretsManager.endpoint may hold neither a query nor credentials: the operator's own identity signs what it asks there"))]
pub struct SecretsManagerKey {
    /// Name or ARN of the entry.
    #[schemars(length(min = 1, max = 2048))]
    pub id: String,
    /// Key within its JSON object.
    #[serde(default = "defaults::secrets_manager_key")]
    #[schemars(length(min = 1, max = 253))]
    pub key: String,
    /// AWS region; default: the operator's own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 64))]
    pub region: Option<String>,
    /// Endpoint in place of AWS's own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 512), regex(pattern = r"^https?://\S+$"))]
    pub endpoint: Option<String>,
}

/// What becomes of messages for a challenge or phase that no Leaderboard serves.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Foreign {
    /// They go to the dead-letter queue.
    #[default]
    DeadLetter,
    /// They are left for another reader of the queue.
    Leave,
}

/// The queue of the challenge's messages: a queue in SQS, or EvalAI's own.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Debug, Default, PartialEq)]
#[x_kube(validation = Rule::new("has(self.sqs) != has(self.evalai)").message("queue needs exactly one of sqs and evalai: sqs if the queue is your own, evalai if it is EvalAI's"))]
pub struct Queue {
    /// A queue in SQS, which the bridge polls.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sqs: Option<SqsQueue>,
    /// The challenge's queue in EvalAI's account, which the controller reads.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub evalai: Option<EvalaiQueue>,
}

/// The SQS queue that EvalAI puts its messages in.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
#[x_kube(
    validation = Rule::new("!has(self.deadLetterURL) || self.deadLetterURL != self.url").message("queue.sqs.deadLetterURL is the queue itself: a bad message would come back endlessly"),
    validation = Rule::new("!(self.url.contains('?') || self.url.contains('#') || self.url.contains('@'))").message("queue.sqs.url may hold neither a query nor credentials: the operator's own identity signs what it asks there"),
    validation = Rule::new("!has(self.deadLetterURL) || !(self.deadLetterURL.contains('?') || self.deadLetterURL.contains('#') || self.deadLetterURL.contains('@'))").message("queue.sqs.deadLetterURL may hold neither a query nor credentials: the operator's own identity signs what it sends there"),
    validation = Rule::new(PLAIN_ENDPOINT).message("queue.sqs.endpoint may hold neither a query nor credentials: the operator's own identity signs what it asks there"),
    validation = Rule::new("!has(self.deadLetterURL) || self.url.endsWith('.fifo') == self.deadLetterURL.endsWith('.fifo')").message("a FIFO queue needs a FIFO dead-letter queue, a standard queue a standard one")
)]
pub struct SqsQueue {
    /// URL of the queue.
    #[schemars(length(max = 512), regex(pattern = r"^https?://\S+$"))]
    pub url: String,
    /// AWS region; default: the operator's own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 64))]
    pub region: Option<String>,
    /// Endpoint in place of AWS's own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 512), regex(pattern = r"^https?://\S+$"))]
    pub endpoint: Option<String>,
    /// Where messages go that can't be used.
    #[serde(rename = "deadLetterURL", default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 512), regex(pattern = r"^https?://\S+$"))]
    pub dead_letter_url: Option<String>,
    /// Seconds that a message may wait for its Leaderboard to be applied.
    #[serde(default = "defaults::unknown_after_seconds")]
    #[schemars(range(min = 0, max = 1_209_600))]
    pub unknown_after_seconds: i64,
    /// Treatment of messages that no Leaderboard serves.
    #[serde(default)]
    pub foreign: Foreign,
}

/// The store of results and logs.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
pub struct Storage {
    /// A bucket of S3.
    pub s3: S3Bucket,
}

/// The S3 bucket of results and logs.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
#[x_kube(
    validation = Rule::new("!has(self.sizeLimit) || quantity(string(self.sizeLimit)).compareTo(quantity('16Mi')) >= 0").message("storage.s3.sizeLimit must be 16Mi or more"),
    validation = Rule::new("!has(self.sizeLimit) || quantity(string(self.sizeLimit)).compareTo(quantity('1Ti')) <= 0").message("storage.s3.sizeLimit must be 1Ti or less"),
    validation = Rule::new(PLAIN_ENDPOINT).message("storage.s3.endpoint may hold neither a query nor credentials: podIdentity and the operator's own identity sign what is asked there")
)]
pub struct S3Bucket {
    /// Name of the bucket.
    #[schemars(length(min = 3, max = 63), regex(pattern = r"^[a-z0-9][a-z0-9.-]*[a-z0-9]$"))]
    pub bucket: String,
    /// Put before each run's id; empty, or ends with a slash.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 512), regex(pattern = r"^([A-Za-z0-9_][A-Za-z0-9_.-]*/)*$"))]
    pub prefix: Option<String>,
    /// AWS region; default: the operator's own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 64))]
    pub region: Option<String>,
    /// Endpoint in place of AWS's own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 512), regex(pattern = r"^https?://\S+$"))]
    pub endpoint: Option<String>,
    /// Size that one run may store, `16Mi` to `1Ti`; what is beyond it is left out, and logcopy's log says so. A file counts at least 4 KiB.
    #[serde(default = "defaults::size_limit")]
    pub size_limit: ByteQuantity,
    /// Key of KMS that S3 encrypts each object with (SSE-KMS); default: what the bucket says.
    #[serde(rename = "kmsKeyARN", default, skip_serializing_if = "Option::is_none")]
    #[schemars(
        length(max = 256),
        regex(pattern = r"^arn:[a-z-]+:kms:[a-z0-9-]+:[0-9]{12}:key/[A-Za-z0-9-]+$")
    )]
    pub kms_key_arn: Option<String>,
    /// Storage class of each object: `STANDARD`, `INTELLIGENT_TIERING`, `STANDARD_IA`, `ONEZONE_IA` or `GLACIER_IR`; default: S3's
    /// `STANDARD`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    // An enum of the schema refuses null, which is as good as a field left out.
    #[schemars(
        with = "Option<String>",
        length(max = 32),
        regex(pattern = r"^(STANDARD|INTELLIGENT_TIERING|STANDARD_IA|ONEZONE_IA|GLACIER_IR)$")
    )]
    pub storage_class: Option<StorageClass>,
}

/// The table of submissions.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq)]
pub struct Table {
    /// A table of DynamoDB.
    #[serde(rename = "dynamoDB")]
    pub dynamo_db: DynamoTable,
}

/// The DynamoDB table of submissions.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
#[x_kube(
    validation = Rule::new(PLAIN_ENDPOINT).message("table.dynamoDB.endpoint may hold neither a query nor credentials: the operator's own identity signs what it asks there"),
    validation = Rule::new("has(self.partitionKey) == has(self.sortKey)").message("table.dynamoDB.partitionKey and table.dynamoDB.sortKey are set together, or both are read from the table"),
    validation = Rule::new("!has(self.partitionKey) || !has(self.sortKey) || self.partitionKey != self.sortKey").message("table.dynamoDB.partitionKey and table.dynamoDB.sortKey are the same key")
)]
pub struct DynamoTable {
    /// Name of the table.
    #[schemars(length(min = 3, max = 255), regex(pattern = r"^[A-Za-z0-9_.-]+$"))]
    pub name: String,
    /// AWS region; default: the operator's own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 64))]
    pub region: Option<String>,
    /// Endpoint in place of AWS's own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 512), regex(pattern = r"^https?://\S+$"))]
    pub endpoint: Option<String>,
    /// Name of the partition key; default: what the table says.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(min = 1, max = 255))]
    pub partition_key: Option<String>,
    /// Name of the sort key; default: what the table says.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(min = 1, max = 255))]
    pub sort_key: Option<String>,
}

/// The store of container logs.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct Logs {
    /// A log group of CloudWatch Logs.
    pub cloud_watch: LogGroup,
}

/// The CloudWatch log group of container logs.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
#[x_kube(
    validation = Rule::new("!has(self.retentionDays) || self.retentionDays in [1, 3, 5, 7, 14, 30, 60, 90, 120, 150, 180, 365, 400, 545, 731, 1096, 1827, 2192, 2557, 2922, 3288, 3653]").message("logs.cloudWatch.retentionDays must be a number of days that CloudWatch Logs knows: 1, 3, 5, 7, 14, 30, 60, 90, 120, 150, 180, 365, 400, 545, 731, 1096, 1827, 2192, 2557, 2922, 3288 or 3653"),
    validation = Rule::new(PLAIN_ENDPOINT).message("logs.cloudWatch.endpoint may hold neither a query nor credentials: podIdentity and the operator's own identity sign what is asked there"),
    validation = Rule::new("!has(self.tags) || has(self.retentionDays)").message("logs.cloudWatch.tags are for a group that the controller makes: set logs.cloudWatch.retentionDays too, or tag the group yourself")
)]
pub struct LogGroup {
    /// Name of the log group.
    #[schemars(length(min = 1, max = 512))]
    pub name: String,
    /// AWS region; default: the operator's own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 64))]
    pub region: Option<String>,
    /// Endpoint in place of AWS's own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 512), regex(pattern = r"^https?://\S+$"))]
    pub endpoint: Option<String>,
    /// Days that lines are kept. With it the controller makes the group if it is missing, and keeps its retention so; without it
    /// the group must exist, and stays as it is.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub retention_days: Option<i32>,
    /// Tags of the group, given when the controller makes it.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    #[schemars(extend("maxProperties" = 50))]
    pub tags: BTreeMap<String, String>,
}

mod defaults {
    use super::ByteQuantity;

    pub(super) fn split() -> String {
        "leaderboard".into()
    }
    pub(super) fn requests_per_minute() -> i32 {
        54
    }
    pub(super) fn sweep_seconds() -> i64 {
        60
    }
    pub(super) fn secrets_manager_key() -> String {
        "auth_token".into()
    }
    pub(super) fn unknown_after_seconds() -> i64 {
        900
    }
    pub(super) fn size_limit() -> ByteQuantity {
        ByteQuantity::gibibytes(20)
    }
}
