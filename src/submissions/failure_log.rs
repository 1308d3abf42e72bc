//! The tail of the log that explains a failure. It is read while it can be had, remembered until every system has the end, and stored in
//! S3 for people.
//!
//! `decide` asks for it; `external` hands the text on to EvalAI's hosts. A log may hold private parts of the challenge, so it never gets into status,
//! events or our own log.

use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;

use futures::AsyncReadExt;
use k8s_openapi::api::core::v1::Pod;
use kube::api::LogParams;
use kube::{Api, Client};

use super::reports::RunFiles;
use crate::ask::Asked;
use leaderboard_api::client_errors;
use leaderboard_api::names::FAILURE_LOG_KEY;
use leaderboard_api::{Attempt, JobNumber, names};
use leaderboard_aws::archive::Archive;
use leaderboard_aws::clients::Aws;
use leaderboard_policy::ask::{Ask, Failure, Lookup, Service};
use leaderboard_policy::view::{LogAt, LogPlace, ObservedLog};

/// Characters that are kept, as EvalAI's own worker does.
const TAIL_CHARS: usize = 10_000;
/// Bytes that are read of a stored log: as many characters of four bytes, and what is dropped of colors.
const STORED_BYTES: u64 = 64 << 10;
/// Lines that a node is asked for. It counts bytes from the first of them, so they must all fit into the limit.
const NODE_LINES: i64 = 200;
/// Bytes that are read of a node's answer.
const NODE_BYTES: u64 = 1 << 20;
/// Time that reading one place, or storing, may take.
const TRY: Duration = Duration::from_secs(5);
/// The number of tries to get one log, and the time between two of them.
const TRIES: u32 = 3;
const TRY_AGAIN: Duration = Duration::from_secs(3);

/// The log that is to be kept.
#[derive(Clone, Debug, PartialEq)]
pub struct FailureLog {
    pub job: JobNumber,
    pub places: Vec<LogPlace>,
    /// The submission has come to its end, so that its log is stored too.
    pub is_over: bool,
    pub files: Arc<RunFiles>,
}

impl Ask for FailureLog {
    type Answer = LogAnswer;
    const AT_ONCE: usize = 32;
    const AT_ONCE_OF_A_SERVICE: usize = 8;
    const LONGEST: Duration = Duration::from_mins(1);

    fn service(&self) -> Service {
        self.files.service()
    }

    fn again(&self, _result: &Result<LogAnswer, Failure>, _failures: u32, _waited: Duration) -> Option<Duration> {
        None
    }
}

/// The state of the log of a Job. `is_over`: the log at the end of the submission.
pub fn seen(lookup: &Lookup<FailureLog>, job: JobNumber, is_over: bool) -> ObservedLog {
    let asked = lookup.asked.as_ref();
    let Some(asked) = asked.filter(|asked| asked.job == job && asked.is_over == is_over) else {
        return ObservedLog::NotRequested;
    };
    match lookup.answer_to(asked).map(|answer| answer.result.as_ref()) {
        None => ObservedLog::Pending(lookup.waited.unwrap_or_default()),
        Some(Ok(answer)) if !answer.is_unclear && answer.tail.is_some() => ObservedLog::Kept,
        Some(Ok(answer)) if !answer.is_unclear => ObservedLog::None,
        Some(Ok(_) | Err(_)) => ObservedLog::GivenUp,
    }
}

/// The log of a Job that was kept.
pub fn kept(lookup: &Lookup<FailureLog>, job: JobNumber) -> Option<Tail> {
    let known = lookup.known().filter(|known| known.question.job == job)?;
    known.result.as_ref().as_ref().ok()?.tail.clone()
}

/// The last lines of a log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Tail {
    pub container: String,
    pub attempt: Attempt,
    /// Where all of it is, below the run's prefix, if it is stored.
    pub key: Option<String>,
    /// The lines, at most 10,000 characters with the first line for hosts.
    pub text: String,
}

impl Tail {
    /// True if the participant's own program wrote it.
    pub fn is_agents(&self) -> bool {
        names::is_agent_container(&self.container)
    }

    /// The text with a first line that names the container, the attempt and the key of the whole log.
    pub fn for_hosts(&self) -> String {
        let all = self.key.as_ref().map(|key| format!("; all of it is in {key}"));
        let (container, attempt, all) = (&self.container, self.attempt, all.unwrap_or_default());
        format!("The end of {container}'s log in attempt {attempt}{all}.\n{}", self.text)
    }

    /// The text with a first line that names no file which only hosts can read.
    pub fn for_participants(&self) -> String {
        format!(
            "The end of {}'s log in attempt {}:\n{}",
            self.container, self.attempt, self.text
        )
    }
}

/// Result of the search for a log.
#[derive(Clone, Debug, PartialEq)]
pub struct LogAnswer {
    pub tail: Option<Tail>,
    /// True if a place that may have the log did not answer, or if storing it failed.
    pub is_unclear: bool,
}

/// Keeps the tail of the first log that is there. Stores it once the submission has come to its end.
pub async fn keep((client, aws): (Client, Aws), asked: Asked<FailureLog>) -> Result<LogAnswer, Failure> {
    let question = &asked.question;
    let archive = question.files.archive(&aws);
    let known = asked.last.as_ref().filter(|last| last.question.job == question.job);
    let found = known.and_then(|last| last.result.as_ref().as_ref().ok());
    let mut tail = found.and_then(|found| found.tail.clone());
    let is_done = known.is_some_and(|last| last.question.is_over == question.is_over);
    if let Some(found) = found.filter(|found| is_done && found.tail.is_some()) {
        return Ok(found.clone());
    }
    let mut is_unclear = true;
    for attempt in 0..TRIES {
        if attempt > 0 {
            tokio::time::sleep(TRY_AGAIN).await;
        }
        (tail, is_unclear) = match tail {
            Some(tail) => (Some(tail), false),
            None => look(&client, &archive, &asked.about.namespace, question).await,
        };
        if let Some(tail) = tail.as_ref().filter(|_| question.is_over) {
            is_unclear |= !store(&archive, tail).await;
        }
        if !is_unclear {
            break;
        }
    }
    Ok(LogAnswer { tail, is_unclear })
}

/// The first log that is there, or else whether one that may have it did not answer.
async fn look(client: &Client, archive: &Archive, namespace: &str, question: &FailureLog) -> (Option<Tail>, bool) {
    let mut is_unclear = false;
    for place in &question.places {
        let read = async {
            match &place.at {
                LogAt::Node { pod, previous } => of_node(client, namespace, pod, &place.container, *previous).await,
                LogAt::Bucket { key } => archive.tail(key, STORED_BYTES).await.map_err(|error| error.to_string()),
            }
        };
        let read = tokio::time::timeout(TRY, read).await;
        match read.unwrap_or_else(|_| Err("no answer in time".into())) {
            Ok(Some(bytes)) => {
                if let Some(found) = found(question.job.attempt, place, &bytes) {
                    return (Some(found), false);
                }
            }
            Ok(None) => {}
            Err(why) => {
                tracing::warn!(container = %place.container, %why, "the log of a failure was not read");
                is_unclear = true;
            }
        }
    }
    (None, is_unclear)
}

fn found(attempt: Attempt, place: &LogPlace, bytes: &[u8]) -> Option<Tail> {
    let mut found = Tail {
        container: place.container.clone(),
        attempt,
        key: match &place.at {
            LogAt::Bucket { key } => Some(key.clone()),
            LogAt::Node { .. } => None,
        },
        text: String::new(),
    };
    let heading = found.for_hosts().chars().count();
    found.text = tail(TAIL_CHARS.saturating_sub(heading), bytes)?;
    Some(found)
}

/// The log of a container, from its node. None if the node has none.
async fn of_node(
    client: &Client,
    namespace: &str,
    pod: &str,
    container: &str,
    previous: bool,
) -> Result<Option<Vec<u8>>, String> {
    let api: Api<Pod> = Api::namespaced(client.clone(), namespace);
    let params = LogParams {
        container: Some(container.to_owned()),
        previous,
        tail_lines: Some(NODE_LINES),
        limit_bytes: i64::try_from(NODE_BYTES).ok(),
        ..LogParams::default()
    };
    let stream = match api.log_stream(pod, &params).await {
        Ok(stream) => stream,
        // Gone, or the container has no earlier run that the node remembers.
        Err(kube::Error::Api(status)) if [400, 404].contains(&status.code) => return Ok(None),
        Err(error) => return Err(client_errors::kube(&error)),
    };
    let mut bytes = Vec::new();
    let read = pin!(stream).take(NODE_BYTES).read_to_end(&mut bytes).await;
    read.map(|_| Some(bytes)).map_err(|error| error.to_string())
}

async fn store(archive: &Archive, tail: &Tail) -> bool {
    let put = archive.put(FAILURE_LOG_KEY, tail.for_hosts().into_bytes());
    let why = match tokio::time::timeout(TRY, put).await {
        Ok(Ok(_)) => return true,
        Ok(Err(error)) => error.to_string(),
        Err(_) => "no answer in time".to_owned(),
    };
    tracing::warn!(%why, "the log of a failure was not stored");
    false
}

/// The last characters of a log, as many as there is room for: text alone, without colors and control characters. None if nothing
/// is left.
fn tail(room: usize, bytes: &[u8]) -> Option<String> {
    let clean = plain(&String::from_utf8_lossy(bytes));
    // The bytes may begin in the middle of a character.
    let clean = clean.trim_start_matches(char::REPLACEMENT_CHARACTER).trim();
    if clean.is_empty() {
        return None;
    }
    let skip = clean.chars().count().saturating_sub(room);
    Some(clean.chars().skip(skip).collect())
}

/// A terminal's text as a file's: a carriage return ends a line, sequences that move or color are dropped.
fn plain(text: &str) -> String {
    let mut plain = String::with_capacity(text.len());
    let mut chars = text.chars().peekable();
    while let Some(char) = chars.next() {
        match char {
            '\u{1b}' => skip_sequence(&mut chars),
            '\r' if chars.peek() == Some(&'\n') => {}
            '\r' => plain.push('\n'),
            '\n' | '\t' => plain.push(char),
            char if char.is_control() => {}
            char => plain.push(char),
        }
    }
    plain
}

/// The rest of an escape sequence.
fn skip_sequence(chars: &mut std::iter::Peekable<std::str::Chars<'_>>) {
    match chars.next_if(|c| ('\u{20}'..='\u{7e}').contains(c)) {
        // Parameters, then one letter.
        Some('[') => {
            while chars.next_if(|c| ('\u{20}'..='\u{3f}').contains(c)).is_some() {}
            chars.next_if(|c| ('\u{40}'..='\u{7e}').contains(c));
        }
        // A title, up to a bell or the next escape.
        Some(']') => while chars.next_if(|c| !matches!(c, '\u{7}' | '\u{1b}' | '\n')).is_some() {},
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use http::{Request, Response};
    use kube::client::Body;

    use super::*;

    fn place() -> LogPlace {
        let key = "agent/agent2/leaderboard.log".to_owned();
        LogPlace {
            container: "agent-2".into(),
            at: LogAt::Bucket { key },
        }
    }

    #[test]
    fn a_tail_is_the_end_of_the_text_and_no_longer_than_allowed() {
        let long: Vec<String> = (0..5000).map(|n| format!("line {n} ü")).collect();
        let long = long.join("\n");
        let cut = found(Attempt(1), &place(), long.as_bytes()).unwrap().for_hosts();
        assert_eq!(cut.chars().count(), TAIL_CHARS);
        let heading = "The end of agent-2's log in attempt 1; all of it is in agent/agent2/leaderboard.log.\n";
        assert!(cut.starts_with(heading) && cut.ends_with("line 4999 ü"), "{cut}");
        let short = found(Attempt(1), &place(), b"short\n").unwrap();
        assert_eq!(short.for_hosts(), format!("{heading}short"));
        for nothing in ["", " \n\r\n", "\u{1b}[0m\u{0}"] {
            assert_eq!(found(Attempt(1), &place(), nothing.as_bytes()), None, "{nothing:?}");
        }
    }

    #[test]
    fn what_participants_read_of_a_log_names_no_file_of_the_hosts() {
        let tail = found(Attempt(1), &place(), b"Traceback: boom\n").unwrap();
        assert_eq!(
            tail.for_participants(),
            "The end of agent-2's log in attempt 1:\nTraceback: boom"
        );
    }

    #[test]
    fn a_tail_is_plain_text() {
        for (bytes, text) in [
            (&b"\xbc\xbcmain\xff\n"[..], "main\u{fffd}"),
            (b"a\x00b\x07c\td", "abc\td"),
            (b"1%\r2%\r\n3%", "1%\n2%\n3%"),
            (b"\x1b[1;31mred\x1b[0m end", "red end"),
            (b"\x1b]0;title\x07shown", "shown"),
            (b"\x1b]0;title\x1b\\shown", "shown"),
            (b"\x1bMup \x1b(Bx", "up Bx"),
            (b"cut \x1b[3", "cut"),
            (b"cut \x1b", "cut"),
            ("\u{85}\u{9b}31m é".as_bytes(), "31m é"),
        ] {
            assert_eq!(tail(TAIL_CHARS, bytes).as_deref(), Some(text), "{bytes:?}");
        }
    }

    /// How an answer of a node with this status and body is read, and the path that was asked for.
    async fn asked(code: u16, body: &'static str, previous: bool) -> (Result<Option<Vec<u8>>, String>, String) {
        let (service, mut handle) = tower_test::mock::pair::<Request<Body>, Response<Body>>();
        let client = Client::new(service, "default");
        let serve = async {
            let (request, send) = handle.next_request().await.unwrap();
            let answer = Response::builder()
                .status(code)
                .body(Body::from(body.as_bytes().to_vec()));
            send.send_response(answer.unwrap());
            request.uri().to_string()
        };
        tokio::join!(of_node(&client, "ns", "sub-1-x", "simulator-2", previous), serve)
    }

    #[tokio::test]
    async fn a_node_is_asked_for_the_last_lines_of_one_container() {
        let (found, uri) = asked(200, "Segmentation fault\n", true).await;
        assert_eq!(found.unwrap().unwrap(), b"Segmentation fault\n");
        assert!(uri.starts_with("/api/v1/namespaces/ns/pods/sub-1-x/log?"), "{uri}");
        for part in [
            "container=simulator-2",
            "previous=true",
            "tailLines=200",
            "limitBytes=1048576",
        ] {
            assert!(uri.contains(part), "{uri}");
        }
    }

    #[tokio::test]
    async fn a_log_that_is_gone_is_no_fault_and_a_refusal_is() {
        let status =
            |code: u16| format!(r#"{{"kind":"Status","status":"Failure","message":"no","reason":"r","code":{code}}}"#);
        for code in [400, 404] {
            let body = Box::leak(status(code).into_boxed_str());
            assert_eq!(asked(code, body, false).await.0, Ok(None), "{code}");
        }
        for code in [403, 500] {
            let body = Box::leak(status(code).into_boxed_str());
            assert!(asked(code, body, false).await.0.is_err(), "{code}");
        }
    }
}
