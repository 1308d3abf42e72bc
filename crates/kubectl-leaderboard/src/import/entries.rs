//! The four entries of the original pipeline, as `aws secretsmanager get-secret-value --output json` prints them. Pure.
//!
//! No text of an entry is in an error: an entry may hold anything, the token among it. The token is never looked at.

use std::collections::BTreeMap;

use leaderboard_api::ImageReference;
use serde::Deserialize;
use serde_json::{Map, Value};

/// The entry with the token and the server.
pub(super) const EVALAI: &str = "evalai";
/// The key of the token in it.
pub(super) const TOKEN_KEY: &str = "auth_token";
/// The entry with the phases.
const TRACKS: &str = "evalai-tracks";
/// EvalAI's own server, where the answer has no text of the entry.
const API_SERVER: &str = "https://eval.ai";

/// A Leaderboard of the original, with what its scripts hold and no entry does.
#[derive(Debug, PartialEq)]
pub(super) struct Original {
    /// Name of its entry.
    pub(super) entry: &'static str,
    pub(super) version: &'static str,
    pub(super) repetitions: u8,
    pub(super) display: &'static str,
    pub(super) scenarios_file: Option<&'static str>,
    /// The most nodes of its node group.
    pub(super) nodes: u8,
}

/// Both.
const ORIGINALS: [Original; 2] = [
    Original {
        entry: "leaderboard-10",
        version: "V1",
        repetitions: 5,
        display: "Offscreen",
        scenarios_file: Some("/workspace/leaderboard/data/all_towns_traffic_scenarios_private.json"),
        nodes: 2,
    },
    Original {
        entry: "leaderboard-20",
        version: "V2",
        repetitions: 1,
        display: "X11Socket",
        scenarios_file: None,
        nodes: 4,
    },
];

/// The entries that are given, by name.
pub(super) type Entries = BTreeMap<String, Entry>;

/// The answer of AWS for one entry.
#[derive(Deserialize)]
pub(super) struct Entry {
    #[serde(rename = "ARN")]
    arn: String,
    #[serde(rename = "Name")]
    name: String,
    /// Absent where the reader has left it out.
    #[serde(rename = "SecretString")]
    text: Option<String>,
}

impl Entry {
    /// True if the entry holds EvalAI's token.
    pub(super) fn has_token(&self) -> bool {
        self.text.as_ref().is_some_and(|text| text.contains(TOKEN_KEY))
    }
}

/// Reads the answers of a text. The error is the line at which it stops being one.
pub(super) fn answers(text: &str) -> Result<Entries, usize> {
    let answers = serde_json::Deserializer::from_str(text).into_iter::<Entry>();
    let named = answers.map(|entry| {
        let entry = entry.map_err(|error| error.line())?;
        Ok((entry.name.clone(), entry))
    });
    named.collect()
}

/// Where an entry is, by its ARN.
#[derive(Debug, PartialEq)]
pub(super) struct Place {
    pub(super) region: String,
    /// The role that docs/migrate.md makes for the Pods.
    pub(super) role: String,
}

impl Place {
    fn of(arn: &str) -> Option<Self> {
        let mut parts = arn.strip_prefix("arn:")?.split(':');
        let is_word = |text: &&str| text.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'-');
        let partition = parts.next().filter(is_word)?;
        parts.next().filter(|service| *service == "secretsmanager")?;
        let region = parts.next().filter(is_word)?.to_owned();
        let account = parts.next().filter(is_word)?;
        let role = format!("arn:{partition}:iam::{account}:role/leaderboard-submission-worker");
        Some(Self { region, role })
    }
}

/// The original pipeline, as its entries describe it.
#[derive(Debug, PartialEq)]
pub(super) struct Pipeline {
    /// Root of EvalAI's server.
    pub(super) api_server: String,
    /// Region of the token's entry.
    pub(super) token_region: String,
    /// Each Leaderboard whose entry is given.
    pub(super) boards: Vec<Board>,
    /// Settings that are not taken over, each with its cause.
    pub(super) dropped: Vec<String>,
}

/// The entry of one Leaderboard, with its tracks.
#[derive(Debug, PartialEq)]
pub(super) struct Board {
    pub(super) original: &'static Original,
    pub(super) place: Place,
    pub(super) simulator_image: String,
    pub(super) contents_image: String,
    pub(super) bucket: String,
    pub(super) table: String,
    pub(super) log_group: Option<String>,
    pub(super) tracks: Vec<Track>,
}

impl Board {
    /// The name that a phase's track gets.
    pub(super) fn track_name(&self, track: &Track) -> String {
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
#[derive(Debug, PartialEq)]
pub(super) struct Track {
    pub(super) phase: i64,
    /// In upper case, as agents get it.
    pub(super) codename: String,
}

impl Track {
    /// The codename as a DNS label has it.
    fn short_name(&self) -> String {
        let short = self.codename.to_ascii_lowercase().replace(['_', '.'], "-");
        short.trim_matches('-').to_owned()
    }
}

/// Problems that stop the import, and settings that are not taken over.
#[derive(Default)]
struct Found {
    problems: Vec<String>,
    dropped: Vec<String>,
}

/// The keys of an entry that are not asked for yet.
struct Fields<'a> {
    entry: &'static str,
    place: Place,
    left: Map<String, Value>,
    missing: Vec<&'static str>,
    found: &'a mut Found,
}

impl<'a> Fields<'a> {
    /// The keys of one entry. None, with the problem in `found`, if its ARN or its text cannot be read.
    fn of(entry: &'static str, Entry { arn, text, .. }: &Entry, found: &'a mut Found) -> Option<Self> {
        let Some(place) = Place::of(arn) else {
            found.problems.push(format!(
                "the answer for {entry} has no ARN of Secrets Manager; print it with its ARN"
            ));
            return None;
        };
        // Only the token's entry may come without its text.
        let empty = (entry == EVALAI).then_some("{}");
        let Some(Ok(left)) = text.as_deref().or(empty).map(serde_json::from_str) else {
            let problem = format!("the entry {entry} is not a JSON object; store it as {{\"key\": \"text\", …}}");
            found.problems.push(problem);
            return None;
        };
        let missing = Vec::new();
        Some(Self {
            entry,
            place,
            left,
            missing,
            found,
        })
    }

    fn unusable(&mut self, key: &str, what: &str) {
        let problem = format!("the entry {}: {key} {what}", self.entry);
        self.found.problems.push(problem);
    }

    fn optional(&mut self, key: &str) -> Option<String> {
        let Value::String(text) = self.left.remove(key)? else {
            self.unusable(key, "is not a text");
            return None;
        };
        Some(text.trim().to_owned()).filter(|text| !text.is_empty())
    }

    fn required(&mut self, key: &'static str) -> String {
        let known = self.found.problems.len();
        let text = self.optional(key);
        if text.is_none() && known == self.found.problems.len() {
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

    /// A name without white space, as those of buckets, tables and log groups in this pipeline.
    fn name(&mut self, key: &'static str, text: String) -> String {
        let is_word = |byte: u8| byte.is_ascii_alphanumeric() || b"-_./#".contains(&byte);
        if !text.bytes().all(is_word) {
            self.unusable(key, "has characters that no such name has");
        }
        text
    }

    /// Reports what is missing and what is left.
    fn end(self) -> Place {
        let entry = self.entry;
        if !self.missing.is_empty() {
            let missing = self.missing.join(", ");
            let problem = format!("the entry {entry} lacks {missing}; add what is missing");
            self.found.problems.push(problem);
        }
        let left = self.left.keys();
        let dropped = left.map(|key| format!("{entry}: {key} ({})", why_dropped(key)));
        self.found.dropped.extend(dropped);
        self.place
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

/// Reads the entries. All that is wrong is named at once.
pub(super) fn parse(entries: &Entries) -> Result<Pipeline, Vec<String>> {
    let mut found = Found::default();
    let required = [EVALAI, TRACKS].into_iter();
    let absent = required.filter(|entry| !entries.contains_key(*entry));
    let absent = absent.map(|entry| format!("there is no answer for the entry {entry}; print that entry too"));
    found.problems.extend(absent);
    let (token_region, api_server) = entries
        .get(EVALAI)
        .and_then(|entry| evalai(entry, &mut found))
        .unwrap_or_default();
    let mut phases = entries
        .get(TRACKS)
        .map(|entry| phases(entry, &mut found))
        .unwrap_or_default();
    let mut boards = Vec::new();
    for original in &ORIGINALS {
        let Some(entry) = entries.get(original.entry) else {
            continue;
        };
        let tracks = phases.remove(original.entry).unwrap_or_default();
        boards.extend(board(original, entry, tracks, &mut found));
    }
    let left = phases.into_keys();
    let left = left.map(|entry| format!("{TRACKS}: the phases of {entry} (there is no answer for that entry)"));
    found.dropped.extend(left);
    if boards.is_empty() && found.problems.is_empty() {
        found
            .problems
            .push("there is no answer for leaderboard-10 or leaderboard-20; print one of them too".to_owned());
    }
    let Found { problems, dropped } = found;
    if !problems.is_empty() {
        return Err(problems);
    }
    Ok(Pipeline {
        api_server,
        token_region,
        boards,
        dropped,
    })
}

/// Region of the token's entry, and the server.
fn evalai(entry: &Entry, found: &mut Found) -> Option<(String, String)> {
    let mut fields = Fields::of(EVALAI, entry, found)?;
    let server = if entry.text.is_some() {
        fields.required("api_server")
    } else {
        API_SERVER.to_owned()
    };
    let server = server.trim_end_matches('/').to_owned();
    if !server.is_empty() && !is_root(&server) {
        fields.unusable("api_server", "is not the root of a server, such as https://eval.ai");
    }
    fields.left.remove(TOKEN_KEY);
    Some((fields.end().region, server))
}

fn is_root(server: &str) -> bool {
    let rest = server
        .strip_prefix("https://")
        .or_else(|| server.strip_prefix("http://"));
    let is_plain = |rest: &str| {
        rest.bytes()
            .all(|byte| byte.is_ascii_graphic() && !b"?#@".contains(&byte))
    };
    rest.is_some_and(|rest| !rest.is_empty() && is_plain(rest) && !server.ends_with("/api"))
}

fn board(original: &'static Original, entry: &Entry, tracks: Vec<Track>, found: &mut Found) -> Option<Board> {
    let mut fields = Fields::of(original.entry, entry, found)?;
    let (simulator_image, contents_image) = (fields.image("simulator_image"), fields.image("leaderboard_image"));
    let bucket = fields.required("s3_bucket");
    let bucket = fields.name("s3_bucket", bucket);
    // The original's documentation spells it in two ways.
    let table = fields.optional("dynamodb_submissinons_table");
    let table = table.unwrap_or_else(|| fields.required("dynamodb_submissions_table"));
    let table = fields.name("dynamodb_submissions_table", table);
    let log_group = fields.optional("cloudwatch_log_group");
    let log_group = log_group.map(|group| fields.name("cloudwatch_log_group", group));
    if tracks.is_empty() {
        let entry = original.entry;
        let problem = format!(
            "{TRACKS} names no phase of {entry}; add \"<phase id>\": \"{entry}-sensors\" and so on, or leave {entry} out"
        );
        fields.found.problems.push(problem);
    }
    Some(Board {
        original,
        place: fields.end(),
        simulator_image,
        contents_image,
        bucket,
        table,
        log_group,
        tracks,
    })
}

/// The phases of each Leaderboard: `"<phase>": "<entry>-<track>"`, and `:` in place of the hyphen in the newest pipeline.
fn phases(entry: &Entry, found: &mut Found) -> BTreeMap<&'static str, Vec<Track>> {
    let mut phases: BTreeMap<&'static str, Vec<Track>> = BTreeMap::new();
    let Some(mut fields) = Fields::of(TRACKS, entry, found) else {
        return phases;
    };
    let keys: Vec<String> = fields.left.keys().cloned().collect();
    for key in keys {
        let Some(text) = fields.optional(&key) else { continue };
        let Some(phase) = key.parse().ok().filter(|phase: &i64| *phase > 0) else {
            fields.unusable(&key, "is not the id of a phase");
            continue;
        };
        let (board, track) = text
            .split_once(':')
            .or_else(|| text.rsplit_once('-'))
            .unwrap_or_default();
        let is_name = |byte: u8| byte.is_ascii_alphanumeric() || b"_.-".contains(&byte);
        if track.is_empty() || track.len() > 24 || !track.bytes().all(is_name) {
            fields.unusable(&key, "is not of the form leaderboard-20-sensors");
            continue;
        }
        let Some(original) = ORIGINALS.iter().find(|original| original.entry == board) else {
            let line = format!("{TRACKS}: {key} (it is a phase of neither leaderboard-10 nor leaderboard-20)");
            fields.found.dropped.push(line);
            continue;
        };
        let codename = track.to_ascii_uppercase();
        phases
            .entry(original.entry)
            .or_default()
            .push(Track { phase, codename });
    }
    fields.end();
    for tracks in phases.values_mut() {
        tracks.sort_by_key(|track| track.phase);
    }
    phases
}

#[cfg(test)]
mod tests;
