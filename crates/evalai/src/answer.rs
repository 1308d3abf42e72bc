//! Meaning of an answer of EvalAI: done, refused, broken, throttled, or none at all; and its error as one sentence.
//!
//! Called by `client`, read by `queue`. Pure.

use std::time::Duration;

use leaderboard_api::text::one_line;
use serde_json::{Map, Value};

/// EvalAI's answer to a user who is no host, whatever is asked for.
const NOT_AUTHORIZED: &str = "you are not authorized to";
/// Longest text taken over from an answer, in characters.
const LONGEST: usize = 400;
/// Taken when the server throttles without saying for how long.
const DEFAULT_WAIT: Duration = Duration::from_mins(1);
/// Longest wait taken from the server.
const LONGEST_WAIT: Duration = Duration::from_mins(5);

/// How a request ended.
#[derive(Clone, Debug, PartialEq)]
pub enum Answer<T> {
    /// 2xx.
    Done(T),
    /// Any other answer but those below: nothing was done.
    Refused(Refusal),
    /// EvalAI's own page for an unhandled exception: it has stopped working on the request.
    Broken(String),
    /// 429: nothing was done, and nothing may be asked for that long.
    Throttled(Duration),
    /// No answer that shows what happened: the server may still be working on it.
    Unanswered(Silence),
}

/// A refusal.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Refusal {
    /// Its object.
    pub about: About,
    /// HTTP status code.
    pub status: u16,
    /// One sentence for people, with the next step where one is known.
    pub message: String,
}

impl Refusal {
    /// True for the answer about one submission that EvalAI gives a host of the challenge only where the submission is another challenge's.
    pub fn is_of_another_challenge(&self) -> bool {
        self.about == About::Request && self.status == 401 && self.message.contains(NOT_AUTHORIZED)
    }
}

/// Object of a refusal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum About {
    /// The token: every request would be refused.
    Token,
    /// The token's rights on one challenge: its user is no host of it. For others it may be good.
    Challenge,
    /// The submission: EvalAI has none of that id.
    Missing,
    /// The request.
    Request,
}

/// Why there is no answer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Silence {
    /// False if the server can't have got the request.
    pub sent: bool,
    /// One sentence for people.
    pub why: String,
}

impl<T> Answer<T> {
    /// The value of a metric's label.
    pub fn as_str(&self) -> &'static str {
        match self {
            Self::Done(_) => "ok",
            Self::Refused(_) => "refused",
            Self::Broken(_) => "broken",
            Self::Throttled(_) => "throttled",
            Self::Unanswered(Silence { sent: true, .. }) => "unanswered",
            Self::Unanswered(_) => "unreachable",
        }
    }

    /// The sentence for people, if it is not done.
    pub fn error(&self) -> Option<String> {
        match self {
            Self::Done(_) => None,
            Self::Refused(refusal) => Some(refusal.message.clone()),
            Self::Broken(message) => Some(message.clone()),
            Self::Throttled(wait) => Some(format!("EvalAI throttles this token for {} s", wait.as_secs())),
            Self::Unanswered(silence) => Some(silence.why.clone()),
        }
    }

    /// This answer, or what follows from its content.
    pub fn and_then<U>(self, f: impl FnOnce(T) -> Answer<U>) -> Answer<U> {
        match self {
            Self::Done(content) => f(content),
            Self::Refused(refusal) => Answer::Refused(refusal),
            Self::Broken(message) => Answer::Broken(message),
            Self::Throttled(wait) => Answer::Throttled(wait),
            Self::Unanswered(silence) => Answer::Unanswered(silence),
        }
    }

    /// This answer with another content.
    pub fn map<U>(self, f: impl FnOnce(T) -> U) -> Answer<U> {
        self.and_then(|content| Answer::Done(f(content)))
    }

    /// This answer to a request that every host of a challenge may make, and that is about nothing else: EvalAI refuses
    /// others with another text, with status 400 or 401. Of one submission the same text may mean another challenge's.
    pub(super) fn of_hosts(self) -> Self {
        match self {
            Self::Refused(refusal) if refusal.about == About::Request && refusal.message.contains(NOT_AUTHORIZED) => {
                Self::Refused(Refusal {
                    about: About::Challenge,
                    ..refusal
                })
            }
            other => other,
        }
    }

    /// A refusal of what was answered.
    pub(crate) fn unusable(status: u16, why: &str) -> Self {
        Self::Refused(Refusal {
            about: About::Request,
            status,
            message: format!("EvalAI answered {status} with {why}; check evalai.apiServer"),
        })
    }
}

/// Reads status code, `Retry-After` and body of an answer.
pub fn classify(status: u16, retry_after: Option<&str>, body: &[u8]) -> Answer<()> {
    let text = String::from_utf8_lossy(body);
    match status {
        200..=299 => Answer::Done(()),
        429 => Answer::Throttled(wait(retry_after)),
        300..=399 => Answer::unusable(status, "a redirect"),
        // A web server's or proxy's own page shows nothing of the program behind it.
        500 if !text.contains("<center>nginx") => Answer::Broken(sentence(status, &Body::read(&text))),
        400..=499 => {
            let body = Body::read(&text);
            Answer::Refused(Refusal {
                about: body.about(status),
                status,
                message: sentence(status, &body),
            })
        }
        _ => Answer::Unanswered(Silence {
            sent: true,
            why: sentence(status, &Body::read(&text)),
        }),
    }
}

fn wait(retry_after: Option<&str>) -> Duration {
    let asked = retry_after
        .and_then(|text| text.trim().parse().ok())
        .map(Duration::from_secs);
    asked
        .unwrap_or(DEFAULT_WAIT)
        .clamp(Duration::from_secs(1), LONGEST_WAIT)
}

/// Where the text of an error stood: EvalAI has four ways.
enum Body {
    /// `{"error": …}`, by EvalAI's views.
    Error(String),
    /// `{"detail": …}`, by the framework under them.
    Detail(String),
    /// `{"field": ["…"]}`, by its validation.
    Fields(String),
    /// A page, or anything else.
    Page(String),
}

impl Body {
    fn read(body: &str) -> Self {
        match serde_json::from_str::<Value>(body) {
            Ok(Value::Object(fields)) => Self::read_fields(&fields),
            Ok(other) => Self::Fields(flat(&other)),
            Err(_) => Self::Page(page(body)),
        }
    }

    fn read_fields(fields: &Map<String, Value>) -> Self {
        if let Some(error) = fields.get("error") {
            return Self::Error(flat(error));
        }
        if let Some(detail) = fields.get("detail") {
            let more = fields.get("messages").and_then(Value::as_array).into_iter().flatten();
            let more: Vec<_> = more.filter_map(|m| m.get("message")).map(flat).collect();
            let detail = flat(detail);
            return Self::Detail(if more.is_empty() {
                detail
            } else {
                format!("{detail}: {}", more.join(", "))
            });
        }
        Self::Fields(flat(&Value::Object(fields.clone())))
    }

    fn text(&self) -> &str {
        match self {
            Self::Error(text) | Self::Detail(text) | Self::Fields(text) | Self::Page(text) => text,
        }
    }

    fn about(&self, status: u16) -> About {
        match (status, self) {
            (401 | 403, Self::Detail(_)) => About::Token,
            // A page with status 404 is a wrong address, not a missing submission.
            (404, Self::Error(_) | Self::Detail(_)) => About::Missing,
            _ => About::Request,
        }
    }
}

/// One sentence without line breaks.
fn sentence(status: u16, body: &Body) -> String {
    let text = one_line(body.text(), LONGEST);
    let text = if text.is_empty() { "nothing".to_owned() } else { text };
    let next = next_step(status, body)
        .map(|step| format!(" ({step})"))
        .unwrap_or_default();
    format!("EvalAI answered {status}: {text}{next}")
}

/// Next step, where EvalAI's own text misleads or is empty.
fn next_step(status: u16, body: &Body) -> Option<&'static str> {
    let has = |part: &str| body.text().contains(part);
    match body.about(status) {
        About::Token if has("verify your email") => Some("the token's user has to confirm the e-mail address"),
        About::Token => Some("store a valid refresh token of a host of the challenge"),
        _ if has("metrics are missing in theleaderboard data") => {
            Some("these metrics are no labels of the phase's leaderboard: add them there")
        }
        _ if has("Challenge Phase Split does not exist") => Some("check evalai.split and the track's phase"),
        _ if has("Challenge with queue name") => Some("check queue.evalai.name, the challenge's queue in EvalAI"),
        _ if has("not authorized to access this submission") => Some("the token's user is no host of its challenge"),
        _ if has(NOT_AUTHORIZED) => Some(
            "the token's user is no host of this challenge, or there is no such challenge: check evalai.challenge, and \
             store a host's token where evalai.token points",
        ),
        _ if status == 404 && matches!(body, Body::Page(_)) => Some("check evalai.apiServer"),
        _ => None,
    }
}

/// JSON as plain text: values only of lists, names and values of objects.
fn flat(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        Value::Array(items) => items.iter().map(flat).collect::<Vec<_>>().join(", "),
        Value::Object(fields) => {
            let refused: Vec<_> = fields
                .iter()
                .map(|(name, value)| format!("{name}: {}", flat(value)))
                .collect();
            refused.join("; ")
        }
        Value::Null => String::new(),
        other => other.to_string(),
    }
}

/// The heading of a page, else its title, else its text.
fn page(body: &str) -> String {
    let found = ["h1", "title"]
        .iter()
        .find_map(|tag| element(body, tag))
        .filter(|text| !text.trim().is_empty());
    without_tags(&found.unwrap_or_else(|| body.to_owned()))
}

fn element(body: &str, tag: &str) -> Option<String> {
    let lower = body.to_ascii_lowercase();
    let opened = lower.find(&format!("<{tag}"))?;
    let start = opened + lower[opened..].find('>')? + 1;
    let end = start + lower[start..].find(&format!("</{tag}"))?;
    body.get(start..end).map(str::to_owned)
}

fn without_tags(text: &str) -> String {
    let mut pieces = text.split('<');
    let mut out = pieces.next().unwrap_or_default().to_owned();
    for (_, text) in pieces.filter_map(|piece| piece.split_once('>')) {
        out.push(' ');
        out.push_str(text);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused(status: u16, body: &str) -> Refusal {
        match classify(status, None, body.as_bytes()) {
            Answer::Refused(refusal) => refusal,
            other => panic!("{status} {body}: {other:?}"),
        }
    }

    #[test]
    fn all_four_shapes_become_a_sentence() {
        for (status, body, message) in [
            (
                400,
                r#"{"error":"Sorry, submission status is invalid"}"#,
                "EvalAI answered 400: Sorry, submission status is invalid",
            ),
            (
                404,
                r#"{"detail":"Submission 99 does not exist"}"#,
                "EvalAI answered 404: Submission 99 does not exist",
            ),
            (
                400,
                r#"{"result":["Value must be valid JSON."]}"#,
                "EvalAI answered 400: result: Value must be valid JSON.",
            ),
            (
                413,
                "<html>\r\n<head><title>413 Request Entity Too Large</title></head>\r\n<body></body></html>",
                "EvalAI answered 413: 413 Request Entity Too Large",
            ),
            (400, "plain\n text", "EvalAI answered 400: plain text"),
            (400, "", "EvalAI answered 400: nothing"),
            (406, r#"["a","b"]"#, "EvalAI answered 406: a, b"),
        ] {
            assert_eq!(refused(status, body).message, message);
        }
        let long = refused(400, &format!(r#"{{"error":"{}"}}"#, "x".repeat(5_000))).message;
        assert!(long.chars().count() < LONGEST + 40 && long.ends_with('…'), "{long}");
    }

    #[test]
    fn refusals_name_what_they_are_about() {
        for (status, body, about) in [
            (401, r#"{"detail":"Invalid token"}"#, About::Token),
            (403, r#"{"detail":"Please verify your email!"}"#, About::Token),
            (
                401,
                r#"{"error":"Sorry, you are not authorized to access this submission."}"#,
                About::Request,
            ),
            (404, r#"{"error":"Submission 7 does not exist"}"#, About::Missing),
            (404, "<html><h1>Error 404</h1></html>", About::Request),
            (
                400,
                r#"{"error":"Sorry, submission status is invalid"}"#,
                About::Request,
            ),
        ] {
            assert_eq!(refused(status, body).about, about, "{status} {body}");
        }
    }

    #[test]
    fn a_user_who_is_no_host_is_refused_for_the_challenge_alone() {
        for (status, body) in [
            (
                401,
                r#"{"error":"Sorry, you are not authorized to access these challenge phases."}"#,
            ),
            (
                400,
                r#"{"error":"Sorry, you are not authorized to make this request!"}"#,
            ),
        ] {
            let Answer::Refused(refusal) = classify(status, None, body.as_bytes()).of_hosts() else {
                panic!("{body}");
            };
            assert_eq!(refusal.about, About::Challenge, "{body}");
            assert!(
                refusal.message.contains("no host of this challenge"),
                "{}",
                refusal.message
            );
            assert_eq!(
                refused(status, body).about,
                About::Request,
                "about a submission: {body}"
            );
        }
        for (status, body) in [
            (400, r#"{"error":"Invalid submission status archived"}"#),
            (401, r#"{"detail":"Invalid token"}"#),
        ] {
            let before = classify(status, None, body.as_bytes());
            assert_eq!(before.clone().of_hosts(), before, "{body}");
        }
    }

    #[test]
    fn only_evalais_own_500_is_an_answer() {
        let own =
            "<!DOCTYPE html><html><head><title>EvalAI</title></head><h1>Error 500 - Internal Server Error</h1></html>";
        let broken = Answer::Broken("EvalAI answered 500: Error 500 - Internal Server Error".into());
        assert_eq!(classify(500, None, own.as_bytes()), broken);
        for status in [500, 502, 503, 504, 520] {
            let page = format!("<html><head><title>{status}</title></head><center>nginx</center></html>");
            let answer = classify(status, None, page.as_bytes());
            assert!(
                matches!(&answer, Answer::Unanswered(silence) if silence.sent),
                "{answer:?}"
            );
        }
        for status in [502, 503, 504] {
            assert!(matches!(classify(status, None, b""), Answer::Unanswered(_)));
        }
    }

    #[test]
    fn throttling_shows_how_long_it_lasts() {
        for (header, seconds) in [
            (Some("56"), 56),
            (Some("0"), 1),
            (Some("86400"), 300),
            (None, 60),
            (Some("soon"), 60),
        ] {
            assert_eq!(
                classify(429, header, b"{}"),
                Answer::Throttled(Duration::from_secs(seconds)),
                "{header:?}"
            );
        }
    }

    #[test]
    fn redirects_are_refused_with_the_next_step() {
        let refusal = refused(301, "");
        assert!(
            refusal.message.contains("redirect") && refusal.message.contains("apiServer"),
            "{}",
            refusal.message
        );
    }
}
