//! The log of every request, for tests and people to read. Bounded; the lock around it is `server`'s.

use std::collections::VecDeque;

use jiff::Timestamp;
use serde::Serialize;
use serde_json::Value;

/// How many requests are kept.
const ENTRIES: usize = 10_000;
/// How many bytes of a body are kept.
const BODY_BYTES: usize = 64 << 10;

/// One request.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Entry {
    /// Counts up from 1 and never starts again while the program runs.
    pub id: u64,
    /// When it came in.
    pub time: Timestamp,
    /// Its method.
    pub method: String,
    /// Its path with the query.
    pub path: String,
    /// The token that signed it.
    pub token: Option<String>,
    /// Its body: as JSON where it is JSON, else as text, cut at 64 KiB.
    pub body: Value,
    /// The status of the answer; none while it is worked on, and for a connection that was closed or left hanging.
    pub status: Option<u16>,
    /// When it was answered.
    pub answered: Option<Timestamp>,
    /// The fault it ran into.
    pub fault: Option<String>,
}

/// The last requests, oldest first.
#[derive(Debug, Default)]
pub struct RequestLog {
    entries: VecDeque<Entry>,
    last: u64,
}

impl RequestLog {
    /// Adds a request and hands its id back.
    pub fn begin(&mut self, time: Timestamp, method: &str, path: &str, token: Option<&str>, body: &[u8]) -> u64 {
        self.last += 1;
        if self.entries.len() == ENTRIES {
            self.entries.pop_front();
        }
        let text = || Value::from(String::from_utf8_lossy(&body[..body.len().min(BODY_BYTES)]));
        let json = (body.len() <= BODY_BYTES)
            .then(|| serde_json::from_slice(body).ok())
            .flatten();
        self.entries.push_back(Entry {
            id: self.last,
            time,
            method: method.to_owned(),
            path: path.to_owned(),
            token: token.map(str::to_owned),
            body: if body.is_empty() {
                Value::Null
            } else {
                json.unwrap_or_else(text)
            },
            status: None,
            answered: None,
            fault: None,
        });
        self.last
    }

    /// Writes down how a request ended.
    pub fn end(&mut self, id: u64, status: Option<u16>, answered: Timestamp, fault: Option<String>) {
        if let Some(entry) = self.entries.iter_mut().rev().find(|entry| entry.id == id) {
            entry.status = status;
            entry.answered = Some(answered);
            entry.fault = fault;
        }
    }

    /// The requests, oldest first.
    pub fn entries(&self) -> impl Iterator<Item = &Entry> {
        self.entries.iter()
    }

    /// Forgets all requests.
    pub fn clear(&mut self) {
        self.entries.clear();
    }
}
