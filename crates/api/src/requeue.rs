//! A host's request to put a submission back in line at nobody's cost, and what was made of it.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A request: a run is stopped and continues later, in the same attempt, from what it has stored. One that has failed or was cancelled
/// begins again with a higher `attempt`, which goes into the same patch. What its earlier ends have cost is forgiven.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
pub struct Requeue {
    /// Grows with each request.
    #[schemars(range(min = 1, max = 9999))]
    pub number: i64,
    /// Why, for people: it is shown in the status and in an event.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(min = 1, max = 256))]
    pub reason: Option<String>,
}

/// The last request that was carried out.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
pub struct Requeued {
    /// `number` of the request.
    pub number: i64,
    /// When it was taken up.
    pub time: Time,
    /// Retries of the present attempt until then. They count no more.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub retries: i32,
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "the signature is serde's")]
fn is_zero(value: &i32) -> bool {
    *value == 0
}
