//! The checkpoint file: its shapes in both versions, its text, and how it gets to disk (badly, as the original does).
//! Filled by `scenario`, `statistics` and `evaluator`; written by `faults`.

use std::{
    collections::BTreeMap,
    fs::{self, File},
    io::{self, Write},
    path::Path,
};

use serde::{Deserialize, Deserializer, Serialize, Serializer, de::Error as _, ser::SerializeMap};
use serde_json::{Number, Value, ser::PrettyFormatter};

use crate::flags::Format;

/// The entry status after a crash of the simulation.
pub const CRASHED: &str = "Crashed";

/// The infractions, in the order of V2's file. V1 has the nine that are not marked.
const INFRACTIONS: [&str; 12] = [
    "collisions_layout",
    "collisions_pedestrian",
    "collisions_vehicle",
    "red_light",
    "stop_infraction",
    "outside_route_lanes",
    "min_speed_infractions",
    "yield_emergency_vehicle_infractions",
    "scenario_timeouts",
    "route_dev",
    "vehicle_blocked",
    "route_timeout",
];
/// The infractions that came with V2.
pub const ONLY_V2: [&str; 3] = [
    "min_speed_infractions",
    "yield_emergency_vehicle_infractions",
    "scenario_timeouts",
];

/// The infractions of a version, in file order.
pub fn infractions(format: Format) -> impl Iterator<Item = &'static str> {
    INFRACTIONS
        .into_iter()
        .filter(move |name| format == Format::V2 || !ONLY_V2.contains(name))
}

/// Scores of a route: `score_route` 0 to 100, often an integer.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Scores {
    pub score_route: Number,
    pub score_penalty: f64,
    pub score_composed: f64,
}

/// Meters and seconds.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Meta {
    pub route_length: f64,
    pub duration_game: f64,
    pub duration_system: f64,
}

/// One route's record.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Record {
    /// Read from a file, not made by this process.
    #[serde(skip, default = "from_file")]
    pub from_file: bool,
    pub index: usize,
    pub route_id: String,
    pub status: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub num_infractions: Option<usize>,
    #[serde(serialize_with = "in_file_order")]
    pub infractions: BTreeMap<String, Vec<String>>,
    pub scores: Scores,
    pub meta: Meta,
}

/// A mean, or a deviation, of each score.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct ScoreTriple<T> {
    pub score_composed: T,
    pub score_route: T,
    pub score_penalty: T,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct GlobalMeta {
    pub total_length: f64,
    pub duration_game: f64,
    pub duration_system: f64,
    /// `(route id, index, status)` of each failed route. V1 leaves the key out when there is none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub exceptions: Option<Vec<(String, usize, String)>>,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct GlobalRecord {
    pub index: i8,
    pub route_id: i8,
    pub status: String,
    #[serde(serialize_with = "in_file_order")]
    pub infractions: BTreeMap<String, Value>,
    /// V1's name for the means.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scores: Option<ScoreTriple<f64>>,
    /// V2's name for the means.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scores_mean: Option<ScoreTriple<f64>>,
    pub scores_std_dev: ScoreTriple<Value>,
    pub meta: GlobalMeta,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Routes {
    #[serde(serialize_with = "object", deserialize_with = "filled")]
    pub global_record: Option<GlobalRecord>,
    /// Routes done and all routes; empty in a file of V1 that an evaluator made of nothing when it was to resume.
    pub progress: Vec<usize>,
    pub records: Vec<Record>,
}

/// The whole file.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Checkpoint {
    #[serde(rename = "_checkpoint")]
    pub routes: Routes,
    pub entry_status: String,
    /// A bool, but V1 starts with an empty text.
    pub eligible: Value,
    pub sensors: Vec<String>,
    pub values: Vec<String>,
    pub labels: Vec<String>,
}

impl Checkpoint {
    /// The file before the first route.
    pub fn new(format: Format, total: usize) -> Self {
        let (entry_status, eligible) = match format {
            Format::V1 => ("", Value::from("")),
            Format::V2 => ("Started", Value::from(false)),
        };
        Self {
            routes: Routes {
                global_record: None,
                progress: vec![0, total],
                records: Vec::new(),
            },
            entry_status: entry_status.to_owned(),
            eligible,
            sensors: Vec::new(),
            values: Vec::new(),
            labels: Vec::new(),
        }
    }

    /// The file's text: indent 4, no final newline; V1 sorts its keys. A number that is not one is written `NaN`, as
    /// Python does.
    pub fn text(&self, format: Format) -> serde_json::Result<String> {
        let mut bytes = Vec::new();
        let mut writer = serde_json::Serializer::with_formatter(&mut bytes, PrettyFormatter::with_indent(b"    "));
        match format {
            Format::V2 => self.serialize(&mut writer)?,
            Format::V1 => {
                let mut value = serde_json::to_value(self)?;
                value.sort_all_objects();
                value.serialize(&mut writer)?;
            }
        }
        Ok(String::from_utf8_lossy(&bytes).replace(": null", ": NaN"))
    }
}

/// Truncates, then writes in pieces, calling `between` before each: a reader meanwhile finds an empty or half file.
pub fn write_in_pieces(path: &Path, text: &str, mut between: impl FnMut()) -> io::Result<()> {
    const PIECES: usize = 4;
    let mut file = File::create(path)?;
    for piece in text.as_bytes().chunks(text.len().div_ceil(PIECES).max(1)) {
        between();
        file.write_all(piece)?;
        file.flush()?;
    }
    Ok(())
}

/// The checkpoint that an earlier run left; None if there is no file or it is not a checkpoint.
pub fn saved(path: &Path) -> Option<Checkpoint> {
    serde_json::from_slice(&fs::read(path).ok()?).ok()
}

fn from_file() -> bool {
    true
}

/// An object with nothing in it is no global record.
fn filled<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<GlobalRecord>, D::Error> {
    let value = Value::deserialize(deserializer)?;
    if value.as_object().is_some_and(serde_json::Map::is_empty) {
        return Ok(None);
    }
    serde_json::from_value(value).map(Some).map_err(D::Error::custom)
}

fn in_file_order<T: Serialize, S: Serializer>(map: &BTreeMap<String, T>, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_map(INFRACTIONS.iter().filter_map(|name| map.get_key_value(*name)))
}

#[expect(clippy::ref_option, reason = "serde hands the field over like this")]
fn object<S: Serializer>(record: &Option<GlobalRecord>, serializer: S) -> Result<S::Ok, S::Error> {
    match record {
        Some(record) => record.serialize(serializer),
        None => serializer.serialize_map(Some(0))?.end(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reader_sees_half_files() {
        let path = std::env::temp_dir().join(format!("pieces-{}", std::process::id()));
        let text = Checkpoint::new(Format::V2, 5).text(Format::V2).unwrap();
        let mut seen = Vec::new();
        write_in_pieces(&path, &text, || seen.push(fs::read_to_string(&path).unwrap())).unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), text);
        assert_eq!((seen.len(), seen[0].as_str()), (4, ""));
        assert!(
            seen.iter()
                .all(|half| text.starts_with(half.as_str()) && half.len() < text.len())
        );
        fs::remove_file(&path).unwrap();
    }

    #[test]
    fn the_first_file_of_each_version() {
        let v2 = Checkpoint::new(Format::V2, 5).text(Format::V2).unwrap();
        assert!(v2.starts_with("{\n    \"_checkpoint\": {\n        \"global_record\": {},\n        \"progress\": [\n"));
        assert!(v2.contains("    \"entry_status\": \"Started\",\n    \"eligible\": false,\n    \"sensors\": [],\n"));
        let v1 = Checkpoint::new(Format::V1, 5).text(Format::V1).unwrap();
        assert!(v1.contains("    \"eligible\": \"\",\n    \"entry_status\": \"\",\n    \"labels\": [],\n"));
        assert!(!v1.ends_with('\n'));
    }
}
