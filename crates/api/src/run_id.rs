//! The id of a run: its place in S3, its row of the table, and the name of its log streams.
//!
//! Parsed where it is read, so that no text with a slash, a blank or a dot in front becomes a key, a path or a policy.

use std::fmt;
use std::str::FromStr;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::Submission;

/// Characters that an id may have.
const LONGEST: usize = 128;

/// Id of a run: letters, digits, dots, hyphens and underscores, with no dot in front.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq, Hash)]
#[serde(try_from = "String", into = "String")]
#[schemars(with = "String", inline)]
pub struct RunId(String);

/// A text that is no [`RunId`].
#[derive(thiserror::Error, Clone, Debug, PartialEq, Eq)]
#[error(
    "{0:?} is no run id; one has 1 to {LONGEST} letters, digits, dots, hyphens and underscores, and does not begin with a dot"
)]
pub struct NotARunId(String);

impl RunId {
    /// As it is written.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl FromStr for RunId {
    type Err = NotARunId;

    fn from_str(text: &str) -> Result<Self, NotARunId> {
        let is_word = |byte: u8| byte.is_ascii_alphanumeric() || matches!(byte, b'.' | b'-' | b'_');
        let is_id = (1..=LONGEST).contains(&text.len()) && !text.starts_with('.') && text.bytes().all(is_word);
        if is_id {
            Ok(Self(text.to_owned()))
        } else {
            Err(NotARunId(text.chars().take(LONGEST).collect()))
        }
    }
}

impl TryFrom<String> for RunId {
    type Error = NotARunId;

    fn try_from(text: String) -> Result<Self, NotARunId> {
        text.parse()
    }
}

impl From<RunId> for String {
    fn from(id: RunId) -> Self {
        id.0
    }
}

impl fmt::Display for RunId {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(&self.0)
    }
}

impl Submission {
    /// Id of its run: its id in EvalAI, else its name, which the API server takes only with characters that an id may have.
    pub fn run_id(&self) -> RunId {
        RunId(match &self.spec.evalai {
            Some(evalai) => evalai.submission.to_string(),
            None => self.metadata.name.clone().unwrap_or_default(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn only_a_text_that_is_safe_in_a_key_is_an_id() {
        for text in ["4711", "team-a", "a.b_C-9", &"x".repeat(128)] {
            assert_eq!(text.parse::<RunId>().unwrap().as_str(), text);
        }
        for text in [
            "",
            ".",
            "..",
            ".a",
            "a/b",
            "../a",
            "a b",
            "ü",
            "a\n",
            "a*",
            &"x".repeat(129),
        ] {
            let refused = serde_json::from_value::<RunId>(json!(text)).unwrap_err().to_string();
            assert!(refused.contains("is no run id"), "{refused}");
        }
    }

    #[test]
    fn a_run_is_named_by_its_id_in_evalai_or_by_its_submission() {
        let local = json!({"leaderboardName": "lb", "image": "i", "track": "sensors"});
        let mut submission = Submission::new("mine", serde_json::from_value(local).unwrap());
        assert_eq!(submission.run_id().as_str(), "mine");
        let evalai = json!({"challenge": 1, "phase": 2, "submission": 77});
        submission.spec.evalai = serde_json::from_value(evalai).unwrap();
        assert_eq!(submission.run_id().as_str(), "77");
        let text = serde_json::to_value(submission.run_id()).unwrap();
        assert_eq!(text, json!("77"));
    }
}
