//! Conditions by the API conventions: one of each type, `lastTransitionTime` moves only when the status does.
//!
//! Called by the controller. Pure: the time is handed in.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::{self, Time};
use schemars::{JsonSchema, Schema, SchemaGenerator};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{ReasonName, SharedText};

/// The submission has a Leaderboard, a track, an image and a place in EvalAI.
pub const ACCEPTED: &str = "Accepted";
/// An agent of the present attempt runs.
pub const RUNNING: &str = "Running";
/// The final results are in S3.
pub const ARCHIVED: &str = "Archived";
/// The end is in DynamoDB.
pub const RECORDED: &str = "Recorded";
/// The end is in EvalAI.
pub const PUBLISHED: &str = "Published";
/// Nothing moves, although it should.
pub const STALLED: &str = "Stalled";
/// The scores follow from the infractions; only there once they did not.
pub const PLAUSIBLE: &str = "Plausible";
/// CloudWatch takes the lines of the run; only there once it did not.
pub const LOGGED: &str = "Logged";
/// The submission has come to its end: True in Finished, Failed and Cancelled.
pub const FINISHED: &str = "Finished";
/// The submission has come to results that count: True in Finished, False in Failed and Cancelled, Unknown from its acceptance until then.
pub const SUCCEEDED: &str = "Succeeded";
/// A Leaderboard can run submissions.
pub const READY: &str = "Ready";
/// The Pods of a Leaderboard reach nothing that its policy forbids: measured, not assumed.
pub const ISOLATED: &str = "Isolated";
/// A Leaderboard that is being deleted waits for its submissions.
pub const TERMINATING: &str = "Terminating";

/// The other systems that get an end, as people call them, each with its condition.
pub const SYSTEMS: [(&str, &str); 3] = [(ARCHIVED, "S3"), (PUBLISHED, "EvalAI"), (RECORDED, "DynamoDB")];

/// Characters of a condition's message, which may hold a stranger's text.
pub const MAX_MESSAGE: usize = 32_768;

/// A condition as Kubernetes has it. Conditions of thousands of submissions mostly have equal texts, which share their memory.
#[derive(Serialize, Deserialize, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
pub struct Condition {
    pub last_transition_time: Time,
    #[serde(default)]
    pub message: SharedText,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub observed_generation: Option<i64>,
    #[serde(default)]
    pub reason: ReasonName,
    /// One of `Truth`.
    #[serde(default)]
    pub status: SharedText,
    #[serde(default, rename = "type")]
    pub type_: SharedText,
}

impl Condition {
    /// All texts that it may share with others.
    pub fn shared_texts(&mut self) -> [&mut SharedText; 3] {
        [&mut self.type_, &mut self.status, &mut self.message]
    }

    /// True if the condition's status is `True`.
    pub fn is_true(&self) -> bool {
        self.status == Truth::True.as_str()
    }
}

/// The truth of a condition.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Truth {
    True,
    False,
    Unknown,
}

impl Truth {
    /// As Kubernetes writes it.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::True => "True",
            Self::False => "False",
            Self::Unknown => "Unknown",
        }
    }
}

impl From<bool> for Truth {
    fn from(value: bool) -> Self {
        if value { Self::True } else { Self::False }
    }
}

/// Sets one condition. Returns whether anything but times changed.
pub fn set(
    conditions: &mut Vec<Condition>,
    type_: &str,
    truth: Truth,
    reason: impl Into<ReasonName>,
    message: &str,
    generation: Option<i64>,
    now: &Time,
) -> bool {
    let (status, reason, message) = (truth.as_str(), reason.into(), fitting(message));
    let Some(old) = conditions.iter_mut().find(|c| c.type_ == type_) else {
        conditions.push(Condition {
            type_: type_.into(),
            status: status.into(),
            reason,
            message: message.into(),
            observed_generation: generation,
            last_transition_time: now.clone(),
        });
        return true;
    };
    let mut changed = old.observed_generation != generation;
    old.observed_generation = generation;
    if old.status != status {
        old.last_transition_time = now.clone();
    }
    if old.reason != reason {
        old.reason = reason;
        changed = true;
    }
    for (old, new) in [(&mut old.status, status), (&mut old.message, message)] {
        if *old != *new {
            *old = new.into();
            changed = true;
        }
    }
    changed
}

/// The first [`MAX_MESSAGE`] characters of a message: the definition allows no more.
fn fitting(message: &str) -> &str {
    let end = message
        .char_indices()
        .nth(MAX_MESSAGE)
        .map_or(message.len(), |(at, _)| at);
    &message[..end]
}

/// Removes one condition.
pub fn remove(conditions: &mut Vec<Condition>, type_: &str) {
    conditions.retain(|c| c.type_ != type_);
}

/// The condition of a type.
pub fn get<'a>(conditions: &'a [Condition], type_: &str) -> Option<&'a Condition> {
    conditions.iter().find(|c| c.type_ == type_)
}

/// True if there is a condition of this type, and its status is `True`.
pub fn is_true(conditions: &[Condition], type_: &str) -> bool {
    get(conditions, type_).is_some_and(Condition::is_true)
}

/// A list of conditions, one of each type. Kubernetes bounds none of its texts, and a rule may walk only what is bounded.
pub(super) fn schema(generator: &mut SchemaGenerator) -> Schema {
    let mut item = v1::Condition::json_schema(generator);
    for (field, longest) in [("message", MAX_MESSAGE), ("reason", 64), ("status", 7), ("type", 64)] {
        if let Some(Value::Object(text)) = item.pointer_mut(&format!("/properties/{field}")) {
            text.insert("maxLength".to_owned(), longest.into());
        }
    }
    schemars::json_schema!({
        "type": "array",
        "items": item,
        "maxItems": 16,
        "x-kubernetes-list-type": "map",
        "x-kubernetes-list-map-keys": ["type"]
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Reason;

    fn at(second: i64) -> Time {
        Time(jiff::Timestamp::from_second(second).unwrap())
    }

    #[test]
    fn a_condition_reads_and_writes_as_kubernetes_own() {
        for generation in [None, Some(3)] {
            let theirs = v1::Condition {
                type_: READY.into(),
                status: "True".into(),
                reason: "A".into(),
                message: "All is well.".into(),
                observed_generation: generation,
                last_transition_time: at(7),
            };
            let text = serde_json::to_string(&theirs).unwrap();
            let ours: Condition = serde_json::from_str(&text).unwrap();
            assert_eq!(serde_json::to_string(&ours).unwrap(), text);
        }
    }

    #[test]
    fn a_message_is_cut_to_what_the_definition_allows() {
        let mut list = Vec::new();
        let long = "é".repeat(MAX_MESSAGE + 1);
        set(
            &mut list,
            READY,
            Truth::False,
            Reason::TokenMissing,
            &long,
            None,
            &at(1),
        );
        assert_eq!(list[0].message.chars().count(), MAX_MESSAGE);
        assert!(!set(
            &mut list,
            READY,
            Truth::False,
            Reason::TokenMissing,
            &long,
            None,
            &at(2)
        ));
    }

    #[test]
    fn the_transition_time_moves_only_with_the_status() {
        let mut list = Vec::new();
        assert!(set(
            &mut list,
            READY,
            Truth::False,
            Reason::TokenMissing,
            "a",
            Some(1),
            &at(1)
        ));
        assert!(set(
            &mut list,
            READY,
            Truth::False,
            Reason::TokenRefused,
            "b",
            Some(1),
            &at(2)
        ));
        assert_eq!(list[0].last_transition_time, at(1));
        assert!(!set(
            &mut list,
            READY,
            Truth::False,
            Reason::TokenRefused,
            "b",
            Some(1),
            &at(3)
        ));
        assert!(set(&mut list, READY, Truth::True, Reason::Ready, "", Some(1), &at(4)));
        assert_eq!(list[0].last_transition_time, at(4));
        assert_eq!(list.len(), 1);
    }
}
