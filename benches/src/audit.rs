//! The operator's requests in the API server's audit log: by verb and resource, with their times and bodies.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::time::Duration;

use jiff::Timestamp;
use serde::Deserialize;
use serde_json::Value;

use crate::bench::Outcome;
use crate::names::{LEADERBOARD, WARM_NAME};
use crate::servers::OPERATOR;

/// The process's own requests, which no submission causes.
const OF_THE_PROCESS: [&str; 2] = ["leases", "selfsubjectaccessreviews"];
/// Resources that are written for a Leaderboard, however many submissions it has.
const OF_THE_LEADERBOARD: [&str; 2] = ["leaderboards", "networkpolicies"];
const READS: [&str; 3] = ["get", "list", "watch"];
/// Longer than the API server takes to note a request.
const QUIET: Duration = Duration::from_secs(1);

/// A request of the operator.
#[derive(Deserialize, Clone, Debug)]
#[serde(rename_all = "camelCase")]
pub struct Entry {
    pub verb: String,
    #[serde(rename = "requestURI")]
    pub uri: String,
    #[serde(rename = "requestReceivedTimestamp")]
    pub received: Timestamp,
    #[serde(rename = "requestObject")]
    pub body: Option<Value>,
    user: User,
    object_ref: Option<ObjectRef>,
}

#[derive(Deserialize, Clone, Debug)]
struct User {
    username: String,
}

#[derive(Deserialize, Clone, Debug, Default)]
#[serde(default)]
struct ObjectRef {
    resource: String,
    subresource: Option<String>,
    name: String,
}

impl Entry {
    /// Resource, with the subresource behind a slash.
    pub fn resource(&self) -> String {
        let Some(object) = &self.object_ref else {
            return String::new();
        };
        let part = object.subresource.as_ref().map(|part| format!("/{part}"));
        format!("{}{}", object.resource, part.unwrap_or_default())
    }

    pub fn name(&self) -> &str {
        self.object_ref.as_ref().map_or("", |object| &object.name)
    }

    pub fn is_write(&self) -> bool {
        !READS.contains(&self.verb.as_str())
    }

    /// None: it is the process's own.
    fn cause(&self) -> Option<Cause> {
        let object = self.object_ref.as_ref();
        let is_of = |kinds: &[&str]| object.is_some_and(|object| kinds.contains(&object.resource.as_str()));
        if is_of(&OF_THE_PROCESS) {
            None
        } else if is_of(&OF_THE_LEADERBOARD) || self.is_trial() || self.name().starts_with(LEADERBOARD) {
            Some(Cause::Leaderboard)
        } else if self.name().starts_with(WARM_NAME) {
            Some(Cause::First)
        } else {
            Some(Cause::Measured)
        }
    }

    /// It asks whether the Leaderboard's Job would be accepted, and changes nothing.
    pub fn is_trial(&self) -> bool {
        self.uri.contains("dryRun")
    }
}

/// For what something is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Cause {
    Leaderboard,
    /// The submission that warms everything up.
    First,
    Measured,
}

/// The operator's writes.
#[derive(Debug, Default, PartialEq)]
pub struct Writes {
    /// About the measured submissions, by verb and resource.
    pub measured: BTreeMap<String, usize>,
    /// About the first submission, which is not measured.
    pub first: usize,
    /// For the Leaderboard alone.
    pub leaderboard: usize,
}

/// The operator's requests, oldest first.
pub fn read(log: &Path) -> Outcome<Vec<Entry>> {
    let mut found = Vec::new();
    for line in BufReader::new(File::open(log)?).lines() {
        let line = line?;
        // Most lines are others', and need not be read as JSON. The last line may be half written.
        if !line.contains("\"username\":\"operator\"") {
            continue;
        }
        let entry = serde_json::from_str::<Entry>(&line).ok();
        found.extend(entry.filter(|entry| entry.user.username == OPERATOR));
    }
    Ok(found)
}

/// The operator's requests once no more writes come: the event of an end follows its status, and each line its answer.
pub async fn read_settled(log: &Path) -> Outcome<Vec<Entry>> {
    let mut known = read(log)?;
    loop {
        tokio::time::sleep(QUIET).await;
        let entries = read(log)?;
        if writes(&entries) == writes(&known) {
            return Ok(entries);
        }
        known = entries;
    }
}

/// The writes among these, apart by what they are for.
pub fn writes(entries: &[Entry]) -> Writes {
    let of = |cause: Cause| {
        let writes = entries.iter().filter(|entry| entry.is_write());
        writes.filter(move |entry| entry.cause() == Some(cause))
    };
    Writes {
        measured: count(of(Cause::Measured)),
        first: of(Cause::First).count(),
        leaderboard: of(Cause::Leaderboard).count(),
    }
}

/// All requests but watches, by verb and resource.
pub fn requests(entries: &[Entry]) -> BTreeMap<String, usize> {
    count(entries.iter().filter(|entry| entry.verb != "watch"))
}

fn count<'a>(entries: impl Iterator<Item = &'a Entry>) -> BTreeMap<String, usize> {
    let mut counts = BTreeMap::new();
    for entry in entries {
        *counts
            .entry(format!("{} {}", entry.verb, entry.resource()))
            .or_default() += 1;
    }
    counts
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(user: &str, verb: &str, resource: &str, name: &str, uri: &str) -> String {
        format!(
            r#"{{"user":{{"username":"{user}"}},"verb":"{verb}","requestURI":"{uri}","requestReceivedTimestamp":"2026-01-01T00:00:00.5Z","objectRef":{{"resource":"{resource}","name":"{name}"}}}}"#
        )
    }

    #[test]
    fn only_the_operators_writes_are_counted_and_apart_by_what_they_are_for() {
        let folder = tempfile::tempdir().unwrap();
        let log = folder.path().join("audit.log");
        let lines = [
            line("operator", "create", "jobs", "run-00000-1", "/jobs"),
            line("operator", "create", "jobs", "run-00001-1", "/jobs"),
            line("operator", "create", "jobs", &format!("{WARM_NAME}-1"), "/jobs"),
            line("operator", "create", "events", &format!("{WARM_NAME}.18"), "/events"),
            line("operator", "create", "jobs", "run-00002-1", "/jobs?dryRun=All"),
            line("operator", "patch", "networkpolicies", "leaderboard-carla", "/x"),
            line("operator", "patch", "leaderboards", LEADERBOARD, "/x"),
            line("operator", "create", "events", &format!("{LEADERBOARD}.18"), "/events"),
            line("operator", "get", "nodes", "n", "/x"),
            line("operator", "update", "leases", "n", "/x"),
            line("bench", "create", "jobs", "run-00003-1", "/jobs"),
            r#"{"user":{"username":"operator"}"#.to_owned(),
        ];
        std::fs::write(&log, lines.join("\n")).unwrap();
        let entries = read(&log).unwrap();
        assert_eq!(entries.len(), 10);
        let expected = Writes {
            measured: [("create jobs".to_owned(), 2)].into(),
            first: 2,
            leaderboard: 4,
        };
        assert_eq!(writes(&entries), expected);
        assert_eq!(requests(&entries).values().sum::<usize>(), 10);
    }
}
