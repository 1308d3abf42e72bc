//! Names of entries in Secrets Manager, queues, buckets, tables and log groups that a Leaderboard may use. The operator reaches them
//! with an AWS identity of its own. Pure.
//!
//! Without this check, anyone who may edit Leaderboards in one namespace could send any entry to a server of their own, and empty
//! any queue. They could also read and replace the results and rows of another namespace.
//!
//! The chart hands in its values `allow` and `namespaces[]`. Without them, as on a person's machine, everything is allowed.
//! For a name that is not allowed the controller reads no token, starts and records no run, and shows `NotAllowed`. The bridge then
//! reads no queue.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt;
use std::str::FromStr;

use serde::Deserialize;

use leaderboard_api::Leaderboard;

/// Stands for every namespace that has no entry of its own.
const ANY: &str = "*";

/// The patterns of allowed names, by namespace. None: everything is allowed.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Allowed(Option<BTreeMap<String, Patterns>>);

/// Patterns, in which `*` stands for any text.
#[derive(Deserialize, Clone, Debug, Default, PartialEq, Eq)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
struct Patterns {
    #[serde(default)]
    secrets_manager: Vec<String>,
    #[serde(default)]
    queues: Vec<String>,
    #[serde(default)]
    buckets: Vec<String>,
    #[serde(default)]
    tables: Vec<String>,
    #[serde(default)]
    log_groups: Vec<String>,
}

/// A name that a Leaderboard uses and may not.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NotAllowed {
    kind: Kind,
    name: String,
    namespace: String,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Entry,
    Queue,
    DeadLetterQueue,
    Bucket,
    Table,
    LogGroup,
}

impl fmt::Display for NotAllowed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (what, list) = match self.kind {
            Kind::Entry => ("entry of Secrets Manager", "secretsManager"),
            Kind::Queue => ("queue", "queues"),
            Kind::DeadLetterQueue => ("dead-letter queue", "queues"),
            Kind::Bucket => ("bucket", "buckets"),
            Kind::Table => ("table", "tables"),
            Kind::LogGroup => ("log group", "logGroups"),
        };
        let Self { name, namespace, .. } = self;
        write!(
            f,
            "Leaderboards of the namespace {namespace} may not name the {what} {name}: the operator's administrator allows it in the \
             chart's values, in allow.{list} or in {list} of this namespace's entry in namespaces."
        )
    }
}

/// Why the operator's settings cannot be used.
#[derive(thiserror::Error, Debug, PartialEq, Eq)]
#[error(
    "what Leaderboards may name is not JSON such as {{\"namespace\": {{\"secretsManager\": [], \"queues\": []}}}}: {0}"
)]
pub struct Malformed(String);

impl FromStr for Allowed {
    type Err = Malformed;

    /// Reads JSON; an empty text sets no bounds.
    fn from_str(text: &str) -> Result<Self, Malformed> {
        if text.is_empty() {
            return Ok(Self(None));
        }
        serde_json::from_str(text)
            .map(|by_namespace| Self(Some(by_namespace)))
            .map_err(|error| Malformed(error.to_string()))
    }
}

impl Allowed {
    /// The first thing that a Leaderboard names and may not.
    pub fn refusal(&self, leaderboard: &Leaderboard) -> Option<NotAllowed> {
        let by_namespace = self.0.as_ref()?;
        let namespace = leaderboard.metadata.namespace.as_deref().unwrap_or_default();
        let none = Patterns::default();
        let patterns = by_namespace
            .get(namespace)
            .or_else(|| by_namespace.get(ANY))
            .unwrap_or(&none);
        let refused = named(leaderboard).find(|(kind, name)| !patterns.allow(*kind, name));
        refused.map(|(kind, name)| NotAllowed {
            kind,
            name: name.into_owned(),
            namespace: namespace.to_owned(),
        })
    }
}

impl Patterns {
    fn allow(&self, kind: Kind, name: &str) -> bool {
        match kind {
            Kind::Entry => any(&self.secrets_manager, name),
            Kind::Queue | Kind::DeadLetterQueue => self.queues.iter().any(|pattern| is_queue(pattern, name)),
            Kind::Bucket => self.buckets.iter().any(|pattern| is_bucket(pattern, name)),
            Kind::Table => any(&self.tables, name),
            Kind::LogGroup => any(&self.log_groups, name),
        }
    }
}

/// Everything that a Leaderboard names of what is allowed by name.
fn named(leaderboard: &Leaderboard) -> impl Iterator<Item = (Kind, Cow<'_, str>)> {
    let spec = &leaderboard.spec;
    let entry = spec
        .evalai
        .iter()
        .filter_map(|evalai| evalai.token.secrets_manager.as_ref());
    let entries = entry.map(|entry| (Kind::Entry, entry.id.as_str()));
    let queues = spec.sqs().into_iter().flat_map(|queue| {
        let dead = queue.dead_letter_url.as_deref().map(|url| (Kind::DeadLetterQueue, url));
        [(Kind::Queue, queue.url.as_str())].into_iter().chain(dead)
    });
    let table = spec.dynamo_table().map(|table| (Kind::Table, table.name.as_str()));
    let group = spec.log_group().map(|group| (Kind::LogGroup, group.name.as_str()));
    let by_name = entries.chain(queues).chain(table).chain(group);
    let prefix = spec.storage.s3.prefix.as_deref().unwrap_or_default();
    let bucket = format!("{}/{prefix}", spec.storage.s3.bucket);
    let by_name = by_name.map(|(kind, name)| (kind, Cow::Borrowed(name)));
    by_name.chain([(Kind::Bucket, Cow::Owned(bucket))])
}

fn any(patterns: &[String], name: &str) -> bool {
    patterns.iter().any(|pattern| matches(pattern, name))
}

/// A pattern with a slash is about bucket and prefix, any other one about the bucket with all that is in it.
fn is_bucket(pattern: &str, place: &str) -> bool {
    if pattern.contains('/') {
        return matches(pattern, place);
    }
    matches(pattern, place.split('/').next().unwrap_or_default())
}

/// A pattern with a slash is about the whole URL, any other one about the queue's name, which is its end.
fn is_queue(pattern: &str, url: &str) -> bool {
    if pattern.contains('/') {
        return matches(pattern, url);
    }
    let name = url.rsplit('/').next().unwrap_or_default();
    // Nothing of a URL but its path is the queue's.
    !url.contains(['?', '#']) && matches(pattern, name)
}

/// True if a text matches the pattern: `*` stands for any text, also none; every other character for itself.
fn matches(pattern: &str, text: &str) -> bool {
    let mut parts = pattern.split('*');
    let first = parts.next().unwrap_or_default();
    let Some(mut rest) = text.strip_prefix(first) else {
        return false;
    };
    let Some(last) = parts.next_back() else {
        return rest.is_empty();
    };
    for part in parts {
        let Some((_, after)) = rest.split_once(part) else {
            return false;
        };
        rest = after;
    }
    rest.ends_with(last)
}

#[cfg(test)]
mod tests;
