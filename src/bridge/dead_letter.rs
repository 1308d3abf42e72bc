//! The copy of a message that goes to the dead-letter queue, in forms that get smaller: no queue tells beforehand what it takes. Pure.

use serde_json::{Map, Value, json};

use crate::intake::source::Received;
use leaderboard_policy::intake::route::DeadReason;

/// Longest text of an attribute, in characters.
const LONGEST: usize = 1024;
/// The keys that name a submission, for a reader of the dead-letter queue and for a message that is moved back.
const IDS: [&str; 3] = ["challenge_pk", "phase_pk", "submission_pk"];
/// Longest id that is kept, in bytes.
const LONGEST_ID: usize = 20;

/// A copy as it is sent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct DeadLetter {
    pub body: String,
    pub attributes: Vec<(&'static str, String)>,
}

/// The copy in three forms, from whole to cut. The second lacks most attributes, because they count for the limit of size as well. The
/// third names only the submission and the message, because a message can be as large as a queue of EvalAI takes.
pub(super) fn forms(message: &Received, reason: &DeadReason, queue: &str) -> [DeadLetter; 3] {
    let known = |fields: &[(&'static str, &str)]| {
        let fields = fields.iter().filter(|(_, text)| !text.is_empty());
        fields.map(|(name, text)| (*name, printable(text))).collect::<Vec<_>>()
    };
    let (first_seen, detail) = (iso(message.first_seen_ms), reason.detail());
    let least = [("reason", reason.as_str()), ("messageId", message.id.as_str())];
    let rest = [("detail", detail), ("queue", queue), ("firstSeen", &first_seen)];
    let letter = |body: &str, fields: &[&[_]]| DeadLetter {
        body: body.to_owned(),
        attributes: known(&fields.concat()),
    };
    [
        letter(&message.body, &[&least, &rest]),
        letter(&message.body, &[&least]),
        letter(&pointer(message), &[&least, &rest]),
    ]
}

/// A body that names the submission and the message, of which the rest was cut. EvalAI has the image, should it be moved back.
fn pointer(message: &Received) -> String {
    let content: Map<String, Value> = serde_json::from_str(&message.body).unwrap_or_default();
    let is_id = |value: &Value| value.is_i64() || value.as_str().is_some_and(|text| text.len() <= LONGEST_ID);
    let named = IDS
        .iter()
        .filter_map(|key| Some((*key, content.get(*key).filter(|id| is_id(id))?)));
    let mut pointer: Map<String, Value> = named.map(|(key, id)| (key.to_owned(), id.clone())).collect();
    pointer.insert("cut_from_message".to_owned(), json!(message.id));
    Value::Object(pointer).to_string()
}

fn iso(milliseconds: i64) -> String {
    jiff::Timestamp::from_millisecond(milliseconds).map_or_else(|_| String::new(), |time| time.to_string())
}

/// SQS refuses control characters in attributes.
fn printable(text: &str) -> String {
    text.chars()
        .map(|c| if c.is_control() { ' ' } else { c })
        .take(LONGEST)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn received(body: &str) -> Received {
        Received {
            id: "m-1".into(),
            receipt: "r".into(),
            body: body.into(),
            sent_ms: 0,
            first_seen_ms: 0,
            receives: 1,
            group: None,
            hindrance: None,
        }
    }

    fn names(letter: &DeadLetter) -> Vec<&str> {
        letter.attributes.iter().map(|(name, _)| *name).collect()
    }

    #[test]
    fn a_dead_letter_loses_what_explains_it_before_its_text() {
        let body = r#"{"challenge_pk":"1","phase_pk":2,"submission_pk":3,"submitted_image_uri":"x","more":"y"}"#;
        let reason = DeadReason::Unknown("no\nLeaderboard".into());
        let [whole, bare, pointer] = forms(&received(body), &reason, "https://q/1");
        assert_eq!((whole.body.as_str(), bare.body.as_str()), (body, body));
        assert_eq!(names(&whole), ["reason", "messageId", "detail", "queue", "firstSeen"]);
        assert_eq!(names(&bare), ["reason", "messageId"]);
        assert_eq!(names(&pointer), names(&whole));
        assert!(whole.attributes.contains(&("detail", "no Leaderboard".into())));
        let named: Value = serde_json::from_str(&pointer.body).unwrap();
        let wanted = json!({"challenge_pk": "1", "phase_pk": 2, "submission_pk": 3, "cut_from_message": "m-1"});
        assert_eq!(named, wanted);
    }

    #[test]
    fn what_names_nothing_is_left_as_its_message() {
        let long = "9".repeat(1000);
        for body in [
            "no JSON".to_owned(),
            format!(r#"{{"submission_pk":"{long}","phase_pk":[1]}}"#),
        ] {
            let [.., pointer] = forms(&received(&body), &DeadReason::Malformed(String::new()), "q");
            assert_eq!(pointer.body, r#"{"cut_from_message":"m-1"}"#);
        }
    }
}
