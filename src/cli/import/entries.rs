//! The four entries of the original pipeline in Secrets Manager, parsed. Pure.
//!
//! No text of an entry is in an error: an entry may hold anything, the token among it.

use std::collections::BTreeMap;

use clap::ValueEnum;
use jiff::Timestamp;
use leaderboard_api::{ImageReference, LeaderboardVersion};
use serde_json::Value;

use crate::services::token::{Token, TokenError};

/// The entry with the token and the server.
pub(super) const EVALAI: &str = "evalai";
/// The entry with the phases.
pub(super) const TRACKS: &str = "evalai-tracks";

/// A Leaderboard of the original, by the name of its entry.
#[derive(ValueEnum, Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Board {
    #[value(name = "leaderboard-10")]
    Ten,
    #[value(name = "leaderboard-20")]
    Twenty,
}

impl Board {
    /// Both.
    pub(super) const ALL: [Self; 2] = [Self::Ten, Self::Twenty];

    /// Name of its entry.
    pub(super) fn entry(self) -> &'static str {
        match self {
            Self::Ten => "leaderboard-10",
            Self::Twenty => "leaderboard-20",
        }
    }

    /// Its version.
    pub(super) fn version(self) -> LeaderboardVersion {
        match self {
            Self::Ten => LeaderboardVersion::V1,
            Self::Twenty => LeaderboardVersion::V2,
        }
    }
}

/// The texts of the entries, by name.
pub(super) type Texts = BTreeMap<&'static str, String>;

/// What the entries hold.
#[derive(Debug, PartialEq)]
pub(super) struct Entries {
    /// Root of EvalAI's server.
    pub(super) api_server: String,
    /// When the token ends, if it shows that; or why it is none.
    pub(super) token: Result<Option<Timestamp>, TokenError>,
    /// Each Leaderboard that is asked for and has a track.
    pub(super) boards: Vec<BoardEntry>,
    /// What is not taken over.
    pub(super) dropped: Vec<Dropped>,
}

/// The entry of one Leaderboard, with its tracks.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct BoardEntry {
    pub(super) board: Board,
    pub(super) simulator_image: String,
    pub(super) contents_image: String,
    pub(super) bucket: String,
    pub(super) table: String,
    pub(super) log_group: Option<String>,
    pub(super) tracks: Vec<TrackEntry>,
}

impl BoardEntry {
    /// The name that a phase's track gets.
    pub(super) fn track_name(&self, track: &TrackEntry) -> String {
        let short = track.short_name();
        let same = self.tracks.iter().filter(|other| other.short_name() == short).count();
        // Names are unique, and two phases may have the same track.
        match (same, short.as_str()) {
            (_, "") => format!("phase-{}", track.phase),
            (1, short) => short.to_owned(),
            (_, short) => format!(
                "{}-{}",
                short.get(..12).unwrap_or(short).trim_end_matches('-'),
                track.phase
            ),
        }
    }
}

/// A phase and its track.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct TrackEntry {
    pub(super) phase: i64,
    /// In upper case, as agents get it.
    pub(super) codename: String,
}

impl TrackEntry {
    /// The codename as a DNS label has it.
    fn short_name(&self) -> String {
        let short = self.codename.to_ascii_lowercase().replace(['_', '.'], "-");
        short.trim_matches('-').to_owned()
    }
}

/// A key of an entry that is not taken over, and why.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Dropped {
    pub(super) entry: &'static str,
    pub(super) key: String,
    pub(super) why: String,
}

/// What keeps an entry from being read.
#[derive(thiserror::Error, Clone, Debug, PartialEq, Eq)]
pub(super) enum EntryError {
    #[error("the entry {0} is not a JSON object; store it as {{\"key\": \"text\", …}}")]
    NotAnObject(&'static str),
    #[error("the entry {entry} lacks {}; add what is missing", .keys.join(", "))]
    Missing {
        entry: &'static str,
        keys: Vec<&'static str>,
    },
    #[error("the entry {entry}: {key} {what}")]
    Unusable {
        entry: &'static str,
        key: String,
        what: String,
    },
    #[error(
        "evalai-tracks names no phase of {0}; add \"<phase id>\": \"{0}-sensors\" and so on, or leave it out with --only"
    )]
    NoTrack(&'static str),
}

/// The keys of an entry that nobody has asked for yet.
struct Fields {
    entry: &'static str,
    left: BTreeMap<String, Value>,
    missing: Vec<&'static str>,
    errors: Vec<EntryError>,
}

impl Fields {
    fn parse(entry: &'static str, texts: &Texts) -> Self {
        let text = texts.get(entry).map(String::as_str).unwrap_or_default();
        let (left, errors) = match serde_json::from_str(text) {
            Ok(Value::Object(fields)) => (fields.into_iter().collect(), Vec::new()),
            _ => (BTreeMap::new(), vec![EntryError::NotAnObject(entry)]),
        };
        Self {
            entry,
            left,
            missing: Vec::new(),
            errors,
        }
    }

    fn unusable(&mut self, key: &str, what: impl Into<String>) {
        let (entry, key, what) = (self.entry, key.to_owned(), what.into());
        self.errors.push(EntryError::Unusable { entry, key, what });
    }

    fn optional(&mut self, key: &str) -> Option<String> {
        match self.left.remove(key)? {
            Value::String(text) if text.trim().is_empty() => None,
            Value::String(text) => Some(text.trim().to_owned()),
            _ => {
                self.unusable(key, "is not a text");
                None
            }
        }
    }

    fn required(&mut self, key: &'static str) -> String {
        let known = self.errors.len();
        let text = self.optional(key);
        if text.is_none() && known == self.errors.len() {
            self.missing.push(key);
        }
        text.unwrap_or_default()
    }

    fn image(&mut self, key: &'static str) -> String {
        let text = self.required(key);
        if !text.is_empty() && ImageReference::parse(&text).is_err() {
            self.unusable(
                key,
                "is no reference to an image, such as 123456789012.dkr.ecr.us-west-2.amazonaws.com/name:tag",
            );
        }
        text
    }

    /// A name without white space or a slash, as those of buckets, tables and log groups in this pipeline.
    fn name(&mut self, key: &'static str, text: String) -> String {
        let is_word = |byte: u8| byte.is_ascii_alphanumeric() || b"-_./#".contains(&byte);
        if !text.bytes().all(is_word) {
            self.unusable(key, "has characters that no such name has");
        }
        text
    }

    /// What is left, and what was wrong.
    fn end(mut self, problems: &mut Vec<EntryError>, dropped: &mut Vec<Dropped>) {
        let is_read = !self.errors.contains(&EntryError::NotAnObject(self.entry));
        problems.append(&mut self.errors);
        if !self.missing.is_empty() && is_read {
            problems.push(EntryError::Missing {
                entry: self.entry,
                keys: self.missing,
            });
        }
        dropped.extend(self.left.into_keys().map(|key| Dropped {
            entry: self.entry,
            why: why_dropped(&key).to_owned(),
            key,
        }));
    }
}

/// Why a key is not taken over.
fn why_dropped(key: &str) -> &'static str {
    match key {
        "name" | "endpoint" | "certificate_authority" => {
            "the Step Function reached the cluster by it; the operator runs in the cluster"
        }
        "logcopy_image" => "logcopy is part of the operator's own image",
        "uploader_image" | "monitor_image" => "the operator's own image does this",
        "instance_type" => "write it into nodeSelector of the tracks, where it is g5.12xlarge",
        "parallelization_workers" => "write it into pairs, where it is 4",
        "routes" => "write it into routesFile of the tracks",
        _ => "the operator has nothing of this name",
    }
}

/// Reads the entries of these Leaderboards. All that is wrong is named at once.
pub(super) fn parse(texts: &Texts, boards: &[Board]) -> Result<Entries, Vec<EntryError>> {
    let (mut problems, mut dropped) = (Vec::new(), Vec::new());
    let mut evalai = Fields::parse(EVALAI, texts);
    let api_server = evalai.required("api_server").trim_end_matches('/').to_owned();
    if !api_server.is_empty() && !is_root(&api_server) {
        evalai.unusable("api_server", "is not the root of a server, such as https://eval.ai");
    }
    let token = evalai.required("auth_token");
    evalai.end(&mut problems, &mut dropped);
    let mut phases = phases(texts, &mut problems, &mut dropped);
    let mut found = Vec::new();
    for &board in boards {
        let tracks = phases.remove(board.entry()).unwrap_or_default();
        if tracks.is_empty() && !problems.contains(&EntryError::NotAnObject(TRACKS)) {
            problems.push(EntryError::NoTrack(board.entry()));
        }
        found.push(board_entry(board, tracks, texts, &mut problems, &mut dropped));
    }
    if problems.is_empty() {
        Ok(Entries {
            api_server,
            token: Token::parse(&token).map(|token| token.expires()),
            boards: found,
            dropped,
        })
    } else {
        Err(problems)
    }
}

fn is_root(server: &str) -> bool {
    let rest = server
        .strip_prefix("https://")
        .or_else(|| server.strip_prefix("http://"));
    rest.is_some_and(|rest| !rest.is_empty() && !rest.contains(['?', '#', '@', ' ']) && !server.ends_with("/api"))
}

fn board_entry(
    board: Board,
    tracks: Vec<TrackEntry>,
    texts: &Texts,
    problems: &mut Vec<EntryError>,
    dropped: &mut Vec<Dropped>,
) -> BoardEntry {
    let mut fields = Fields::parse(board.entry(), texts);
    let (simulator_image, contents_image) = (fields.image("simulator_image"), fields.image("leaderboard_image"));
    let bucket = fields.required("s3_bucket");
    let bucket = fields.name("s3_bucket", bucket);
    // The original's documentation spells it in two ways.
    let table = fields.optional("dynamodb_submissinons_table");
    let table = table.unwrap_or_else(|| fields.required("dynamodb_submissions_table"));
    let table = fields.name("dynamodb_submissions_table", table);
    let log_group = fields.optional("cloudwatch_log_group");
    let log_group = log_group.map(|group| fields.name("cloudwatch_log_group", group));
    fields.end(problems, dropped);
    BoardEntry {
        board,
        simulator_image,
        contents_image,
        bucket,
        table,
        log_group,
        tracks,
    }
}

/// The phases of each Leaderboard: `"<phase>": "<entry>-<track>"`, and `:` in place of the hyphen in the newest pipeline.
fn phases(
    texts: &Texts,
    problems: &mut Vec<EntryError>,
    dropped: &mut Vec<Dropped>,
) -> BTreeMap<&'static str, Vec<TrackEntry>> {
    let mut fields = Fields::parse(TRACKS, texts);
    let mut phases: BTreeMap<&'static str, Vec<TrackEntry>> = BTreeMap::new();
    let keys: Vec<String> = fields.left.keys().cloned().collect();
    for key in keys {
        let Some(text) = fields.optional(&key) else { continue };
        let Some(phase) = key.parse().ok().filter(|phase: &i64| *phase > 0) else {
            fields.unusable(&key, "is not the id of a phase");
            continue;
        };
        let (entry, track) = text
            .split_once(':')
            .or_else(|| text.rsplit_once('-'))
            .unwrap_or_default();
        let is_name = |byte: u8| byte.is_ascii_alphanumeric() || b"_.-".contains(&byte);
        if track.is_empty() || track.len() > 24 || !track.bytes().all(is_name) {
            fields.unusable(&key, "is not of the form leaderboard-20-sensors");
            continue;
        }
        match Board::ALL.into_iter().find(|board| board.entry() == entry) {
            Some(board) => phases.entry(board.entry()).or_default().push(TrackEntry {
                phase,
                codename: track.to_ascii_uppercase(),
            }),
            None => dropped.push(Dropped {
                entry: TRACKS,
                key,
                why: "it is a phase of neither leaderboard-10 nor leaderboard-20".to_owned(),
            }),
        }
    }
    fields.end(problems, dropped);
    for tracks in phases.values_mut() {
        tracks.sort_by_key(|track| track.phase);
    }
    phases
}

#[cfg(test)]
#[path = "entries_tests.rs"]
mod tests;
