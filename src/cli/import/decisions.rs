//! What a person has decided about the Leaderboards: a file that is laid over what the entries become. Pure.
//!
//! `all` is for both Leaderboards, `leaderboard-10` and `leaderboard-20` for one, which goes before `all`. Each is a part of a
//! Leaderboard's spec: objects are laid over deep, lists as a whole, tracks by name, and null removes.

use std::collections::{BTreeMap, BTreeSet};

use kube::CustomResourceExt;
use leaderboard_api::Leaderboard;
use serde_json::{Map, Value};

use super::entries::Board;

/// The part that is for both.
const ALL: &str = "all";
/// Where a Leaderboard's definition has the schema of its spec.
const SPEC: &str = "/spec/versions/0/schema/openAPIV3Schema/properties/spec";

/// The parts of a file.
#[derive(Clone, Debug, Default)]
pub(super) struct Decisions {
    file: String,
    parts: BTreeMap<String, Map<String, Value>>,
}

/// Why a file cannot be used.
#[derive(thiserror::Error, Clone, Debug, PartialEq, Eq)]
pub(super) enum DecisionError {
    #[error("{file} is not YAML: {why}")]
    NotYaml { file: String, why: String },
    #[error("{file}: {place} {what}")]
    Unusable { file: String, place: String, what: String },
}

/// What is wrong with a file, at once.
struct Faults {
    file: String,
    found: Vec<DecisionError>,
}

impl Faults {
    fn add(&mut self, place: &str, what: impl Into<String>) {
        self.found.push(DecisionError::Unusable {
            file: self.file.clone(),
            place: place.to_owned(),
            what: what.into(),
        });
    }
}

impl Decisions {
    /// Reads a file's text. All that is wrong is named at once.
    pub(super) fn parse(file: &str, text: &str) -> Result<Self, Vec<DecisionError>> {
        let not_yaml = |error: serde_saphyr::Error| {
            let (file, why) = (file.to_owned(), error.to_string());
            vec![DecisionError::NotYaml { file, why }]
        };
        let whole: Value = serde_saphyr::from_str(text).map_err(not_yaml)?;
        let mut faults = Faults {
            file: file.to_owned(),
            found: Vec::new(),
        };
        let definition = serde_json::to_value(Leaderboard::crd()).unwrap_or_default();
        let schema = definition.pointer(SPEC).cloned().unwrap_or_default();
        let mut parts = BTreeMap::new();
        for (key, part) in fields(whole, "the file", &mut faults) {
            if key != ALL && !Board::ALL.iter().any(|board| board.entry() == key) {
                faults.add(&key, "is none of all, leaderboard-10 and leaderboard-20");
                continue;
            }
            compare(&schema, &part, &key, &mut faults);
            name_tracks(&part, &key, &mut faults);
            parts.insert(key.clone(), fields(part, &key, &mut faults));
        }
        if faults.found.is_empty() {
            let file = file.to_owned();
            Ok(Self { file, parts })
        } else {
            faults.found.dedup();
            Err(faults.found)
        }
    }

    /// Name of the file; empty without one.
    pub(super) fn file(&self) -> &str {
        &self.file
    }

    /// The parts for a Leaderboard, in the order in which they are laid over.
    fn parts(&self, board: Board) -> impl Iterator<Item = &Map<String, Value>> {
        [ALL, board.entry()].into_iter().filter_map(|key| self.parts.get(key))
    }

    /// Lays the file over a Leaderboard's spec.
    pub(super) fn lay_over(&self, board: Board, spec: &mut Value) {
        for part in self.parts(board) {
            for (key, value) in part {
                match (key.as_str(), value) {
                    ("tracks", Value::Array(items)) => lay_over_tracks(&mut spec["tracks"], items),
                    _ => merge_field(spec, key, value),
                }
            }
        }
    }

    /// The fields below the spec that the file sets for a Leaderboard.
    pub(super) fn keys(&self, board: Board) -> BTreeSet<&str> {
        self.parts(board)
            .flat_map(|part| part.keys().map(String::as_str))
            .collect()
    }

    /// Whether the file sets a field of a Leaderboard, such as `deadlines.runSeconds`, or removes what it is in.
    pub(super) fn set(&self, board: Board, field: &str) -> bool {
        self.parts(board).any(|part| sets(part, field))
    }

    /// Whether the file sets a field of each of these tracks.
    pub(super) fn set_tracks<'a>(&self, board: Board, field: &str, tracks: impl IntoIterator<Item = &'a str>) -> bool {
        let mut tracks = tracks.into_iter();
        tracks.all(|track| {
            let items = self.parts(board).flat_map(items);
            items.filter(|item| name(item) == Some(track)).any(|item| {
                let item = item.as_object();
                item.is_some_and(|item| sets(item, field))
            })
        })
    }

    /// Tracks of the file that no Leaderboard has. `tracks` are those of each that is made.
    pub(super) fn unknown_tracks(&self, tracks: &BTreeMap<Board, BTreeSet<String>>) -> Vec<DecisionError> {
        let mut faults = Faults {
            file: self.file.clone(),
            found: Vec::new(),
        };
        for (key, part) in &self.parts {
            let of = tracks.iter().filter(|(board, _)| key == ALL || board.entry() == key);
            let known: BTreeSet<&str> = of.flat_map(|(_, names)| names).map(String::as_str).collect();
            let is_made = key == ALL || tracks.keys().any(|board| board.entry() == key);
            let names = items(part).filter_map(name);
            for name in names.filter(|name| is_made && !known.contains(name)) {
                let known: Vec<_> = known.iter().copied().collect();
                let what = format!("has the track {name}, which is none of {}", known.join(", "));
                faults.add(key, what);
            }
        }
        faults.found
    }
}

/// The fields of an object; nothing is an object without any.
fn fields(value: Value, place: &str, faults: &mut Faults) -> Map<String, Value> {
    match value {
        Value::Object(fields) => fields,
        Value::Null => Map::new(),
        _ => {
            faults.add(place, "is no object");
            Map::new()
        }
    }
}

fn items(part: &Map<String, Value>) -> impl Iterator<Item = &Value> {
    part.get("tracks").and_then(Value::as_array).into_iter().flatten()
}

fn name(track: &Value) -> Option<&str> {
    track["name"].as_str()
}

/// Tracks are told apart by name.
fn name_tracks(part: &Value, place: &str, faults: &mut Faults) {
    let tracks = part["tracks"].as_array().into_iter().flatten();
    for (number, _) in tracks.enumerate().filter(|(_, track)| name(track).is_none()) {
        faults.add(
            &format!("{place}.tracks[{number}]"),
            "has no name: write that of the printed track",
        );
    }
}

fn sets(part: &Map<String, Value>, field: &str) -> bool {
    let (first, rest) = field
        .split_once('.')
        .map_or((field, None), |(first, rest)| (first, Some(rest)));
    match (part.get(first), rest) {
        (None, _) => false,
        (Some(Value::Null), _) | (Some(_), None) => true,
        (Some(value), Some(rest)) => value.as_object().is_some_and(|value| sets(value, rest)),
    }
}

fn lay_over_tracks(tracks: &mut Value, items: &[Value]) {
    for track in tracks.as_array_mut().into_iter().flatten() {
        for item in items {
            if name(item) == name(track) {
                merge(track, item);
            }
        }
    }
}

/// JSON merge patch (RFC 7396).
fn merge(base: &mut Value, change: &Value) {
    match change {
        Value::Object(change) => {
            if !base.is_object() {
                *base = Value::Object(Map::new());
            }
            for (key, value) in change {
                merge_field(base, key, value);
            }
        }
        whole => *base = whole.clone(),
    }
}

fn merge_field(base: &mut Value, key: &str, value: &Value) {
    let Value::Object(base) = base else { return };
    if value.is_null() {
        base.remove(key);
    } else {
        merge(base.entry(key).or_insert(Value::Null), value);
    }
}

/// Compares a value with the schema of its place. null is right everywhere: it removes.
fn compare(schema: &Value, value: &Value, place: &str, faults: &mut Faults) {
    let is_true = |key: &str| schema[key] == Value::Bool(true);
    if value.is_null() || is_true("x-kubernetes-preserve-unknown-fields") {
        return;
    }
    if is_true("x-kubernetes-int-or-string") {
        if !value.is_string() && !value.is_i64() {
            faults.add(place, "is neither a whole number nor a text");
        }
        return;
    }
    let (is_right, kind) = match schema["type"].as_str() {
        Some("object") => (value.is_object(), "no object"),
        Some("array") => (value.is_array(), "no list"),
        Some("string") => (value.is_string(), "no text: write it in quotation marks"),
        Some("integer") => (value.is_i64(), "no whole number"),
        Some("boolean") => (value.is_boolean(), "neither true nor false"),
        _ => (true, ""),
    };
    if !is_right {
        faults.add(place, format!("is {kind}"));
        return;
    }
    compare_within(schema, value, place, faults);
}

fn compare_within(schema: &Value, value: &Value, place: &str, faults: &mut Faults) {
    match value {
        Value::Object(fields) => {
            for (key, field) in fields {
                let place = format!("{place}.{key}");
                let known = schema["properties"].get(key);
                match known.or_else(|| schema.get("additionalProperties")) {
                    Some(schema) => compare(schema, field, &place, faults),
                    None => faults.add(&place, unknown(&schema["properties"])),
                }
            }
        }
        Value::Array(items) => {
            for (number, item) in items.iter().enumerate() {
                compare(&schema["items"], item, &format!("{place}[{number}]"), faults);
            }
        }
        Value::String(text) => {
            let words: Vec<_> = schema["enum"]
                .as_array()
                .into_iter()
                .flatten()
                .filter_map(Value::as_str)
                .collect();
            if !words.is_empty() && !words.contains(&text.as_str()) {
                faults.add(place, format!("is none of {}", words.join(", ")));
            }
        }
        _ => {}
    }
}

fn unknown(properties: &Value) -> String {
    let known: Vec<_> = properties
        .as_object()
        .into_iter()
        .flat_map(Map::keys)
        .map(String::as_str)
        .collect();
    format!("is no field of a Leaderboard; there are {}", known.join(", "))
}

#[cfg(test)]
#[path = "decisions_tests.rs"]
mod tests;
