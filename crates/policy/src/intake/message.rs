//! EvalAI's message, parsed once at the edge.
//!
//! Called by the poller. Pure: knows no queue, no cluster and no clock.

use serde_json::{Map, Value};
use thiserror::Error;

use leaderboard_api::image;

/// The key that a message of a challenge with static code upload has set.
pub const STATIC_CODE_UPLOAD: &str = "is_static_dataset_code_upload_submission";

/// A message that names a submission of EvalAI.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Message {
    /// Id of the challenge.
    pub challenge: i64,
    /// Id of the phase.
    pub phase: i64,
    /// Id of the submission.
    pub submission: i64,
    /// The participant's image. None if the message names none, or none that a Submission could hold: the
    /// controller then asks EvalAI, and a bad image ends as a failure that the participant sees.
    pub image: Option<String>,
    /// The files that its image leaves are evaluated once that has ended.
    pub is_static_code_upload: bool,
}

/// Why a message can never be used.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum Malformed {
    /// The body is no JSON.
    #[error("the body is not JSON (line {line}, column {column})")]
    NotJson { line: usize, column: usize },
    /// The body is JSON, but no object.
    #[error("the body is not a JSON object")]
    NotAnObject,
    /// An id is absent.
    #[error("{0} is missing")]
    Missing(&'static str),
    /// An id is no positive whole number.
    #[error("{0} is not a positive whole number")]
    NotAnId(&'static str),
}

/// Parses the body of a message. Ids come as numbers or as decimal strings; unknown keys are ignored.
pub fn parse(body: &str) -> Result<Message, Malformed> {
    let value: Value = serde_json::from_str(body).map_err(|error| Malformed::NotJson {
        line: error.line(),
        column: error.column(),
    })?;
    let Value::Object(map) = value else {
        return Err(Malformed::NotAnObject);
    };
    Ok(Message {
        challenge: id(&map, "challenge_pk")?,
        phase: id(&map, "phase_pk")?,
        submission: id(&map, "submission_pk")?,
        image: map.get("submitted_image_uri").and_then(Value::as_str).and_then(fitting),
        is_static_code_upload: is_set(map.get(STATIC_CODE_UPLOAD)),
    })
}

/// The text as the image of a Submission. None if the definition would refuse it. Acceptance judges if it can be pulled.
fn fitting(text: &str) -> Option<String> {
    let text = text.trim();
    let starts_well = text.starts_with(|c: char| c.is_ascii_lowercase() || c.is_ascii_digit());
    let fits = text.len() <= image::LONGEST && text.bytes().all(|byte| byte.is_ascii_graphic());
    (starts_well && fits).then(|| text.to_owned())
}

fn id(map: &Map<String, Value>, name: &'static str) -> Result<i64, Malformed> {
    let number = match map.get(name) {
        None | Some(Value::Null) => return Err(Malformed::Missing(name)),
        Some(Value::Number(number)) => number.as_i64(),
        Some(Value::String(text)) if text.bytes().all(|b| b.is_ascii_digit()) => text.parse().ok(),
        Some(_) => None,
    };
    number.filter(|n| *n > 0).ok_or(Malformed::NotAnId(name))
}

fn is_set(value: Option<&Value>) -> bool {
    match value {
        Some(Value::Bool(set)) => *set,
        Some(Value::String(text)) => text.eq_ignore_ascii_case("true"),
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(image: Option<&str>) -> Message {
        Message {
            challenge: 1,
            phase: 2,
            submission: 3,
            image: image.map(str::to_owned),
            is_static_code_upload: false,
        }
    }

    #[test]
    fn every_shape_that_evalai_sends_is_read() {
        let cases = [
            // The first message: ids of challenge and phase are strings.
            (
                r#"{"challenge_pk":"1","phase_pk":"2","is_static_dataset_code_upload_submission":false,"submitted_image_uri":"r.example/a:7f3","submission_pk":3}"#,
                Some("r.example/a:7f3"),
            ),
            // A resume or a re-run: all are numbers.
            (
                r#"{"challenge_pk":1,"phase_pk":2,"submission_pk":3,"is_static_dataset_code_upload_submission":false,"submitted_image_uri":"r.example/a:7f3"}"#,
                Some("r.example/a:7f3"),
            ),
            // A file by URL: neither flag nor image.
            (r#"{"challenge_pk":1,"phase_pk":2,"submission_pk":3}"#, None),
            (
                r#"{"challenge_pk":"1","phase_pk":2,"submission_pk":"3","is_static_dataset_code_upload_submission":"false"}"#,
                None,
            ),
            (
                r#"{"challenge_pk":1,"phase_pk":2,"submission_pk":3,"submission_meta":{"x":[1]},"submitted_image_uri":null}"#,
                None,
            ),
        ];
        for (body, image) in cases {
            assert_eq!(parse(body), Ok(message(image)), "{body}");
        }
    }

    #[test]
    fn an_image_that_no_submission_could_hold_is_left_to_evalais_answer() {
        for (image, expected) in [
            (r#""a b""#, None),
            (r#""Upper/case""#, None),
            (r#""r.example/a\u001b[2J:1""#, None),
            (r#""r.example/\u202ea:1""#, None),
            (r#""r.example/\u0430:1""#, None),
            ("7", None),
            (r#"" r.example/a:1\n""#, Some("r.example/a:1")),
        ] {
            let body = format!(r#"{{"challenge_pk":1,"phase_pk":2,"submission_pk":3,"submitted_image_uri":{image}}}"#);
            assert_eq!(parse(&body), Ok(message(expected)), "{body}");
        }
    }

    #[test]
    fn what_is_no_such_message_is_refused_with_a_reason() {
        let cases = [
            ("", Malformed::NotJson { line: 1, column: 0 }),
            ("{", Malformed::NotJson { line: 1, column: 1 }),
            ("[]", Malformed::NotAnObject),
            ("\"x\"", Malformed::NotAnObject),
            ("{}", Malformed::Missing("challenge_pk")),
            (r#"{"challenge_pk":1}"#, Malformed::Missing("phase_pk")),
        ];
        for (body, want) in cases {
            assert_eq!(parse(body), Err(want), "{body}");
        }
    }

    #[test]
    fn a_static_code_upload_is_a_message_like_any_other() {
        for (flag, expected) in [
            ("true", true),
            (r#""True""#, true),
            ("false", false),
            (r#""false""#, false),
            ("null", false),
            ("1", false),
        ] {
            let body = format!(
                r#"{{"challenge_pk":1,"phase_pk":2,"submission_pk":3,"{STATIC_CODE_UPLOAD}":{flag},"submitted_image_uri":"r.example/a:1"}}"#
            );
            let read = Message {
                is_static_code_upload: expected,
                ..message(Some("r.example/a:1"))
            };
            assert_eq!(parse(&body), Ok(read), "{body}");
        }
    }

    #[test]
    fn each_id_must_be_a_positive_whole_number() {
        let ids = ["challenge_pk", "phase_pk", "submission_pk"];
        let wrong = [
            "1.5",
            "-3",
            "0",
            "99999999999999999999",
            "true",
            "[3]",
            r#""""#,
            r#""+1""#,
            r#""-1""#,
            r#""x""#,
            r#"" 1""#,
        ];
        for name in ids {
            let with = |value: &str| {
                let fields = ids.map(|id| format!("\"{id}\":{}", if id == name { value } else { "7" }));
                parse(&format!("{{{}}}", fields.join(",")))
            };
            for value in wrong {
                assert_eq!(with(value), Err(Malformed::NotAnId(name)), "{name}: {value}");
            }
            assert_eq!(with("null"), Err(Malformed::Missing(name)));
            assert!(with("\"0012\"").is_ok());
        }
    }

    #[test]
    fn deep_nesting_is_refused_and_not_followed() {
        let body = "[".repeat(100_000);
        assert!(matches!(parse(&body), Err(Malformed::NotJson { .. })));
    }
}
