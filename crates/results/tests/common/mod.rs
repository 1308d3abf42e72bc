//! Checkpoints as an evaluator writes them, built from a few numbers.
#![allow(dead_code, reason = "each test file uses its part")]

use std::fmt::Write as _;
use std::io::Write as _;
use std::path::Path;

use leaderboard_results::{Checkpoint, Format, Merged, Plan, Refusal, Slice, Strictness, Verify, merge, read_worker};
use serde_json::{Map, Value, json};

const V1: [&str; 9] = [
    "collisions_pedestrian",
    "collisions_vehicle",
    "collisions_layout",
    "red_light",
    "stop_infraction",
    "outside_route_lanes",
    "route_dev",
    "route_timeout",
    "vehicle_blocked",
];
const V2_ONLY: [&str; 3] = [
    "min_speed_infractions",
    "yield_emergency_vehicle_infractions",
    "scenario_timeouts",
];

/// One drive of one route.
#[derive(Clone, Debug)]
pub struct Drive {
    pub id: u32,
    pub repetition: u32,
    pub status: String,
    pub infractions: Vec<(&'static str, Vec<String>)>,
    pub route: f64,
    pub penalty: f64,
    /// Meters, game seconds, real seconds.
    pub meta: [f64; 3],
}

impl Drive {
    pub fn perfect(id: u32) -> Self {
        Self {
            id,
            repetition: 0,
            status: "Completed".to_owned(),
            infractions: Vec::new(),
            route: 100.0,
            penalty: 1.0,
            meta: [1234.5, 100.25, 800.125],
        }
    }

    pub fn repeated(self, repetition: u32) -> Self {
        Self { repetition, ..self }
    }

    pub fn status(self, status: &str) -> Self {
        Self {
            status: status.to_owned(),
            ..self
        }
    }

    pub fn json(&self, format: Format, index: usize) -> Value {
        let names: Vec<&str> = if format == Format::V1 {
            V1.to_vec()
        } else {
            V1.into_iter().chain(V2_ONLY).collect()
        };
        let mut infractions: Map<String, Value> = names.into_iter().map(|name| (name.to_owned(), json!([]))).collect();
        for (name, messages) in &self.infractions {
            infractions.insert((*name).to_owned(), json!(messages));
        }
        let suffix = if format == Format::V1 {
            String::new()
        } else {
            format!("_rep{}", self.repetition)
        };
        let [length, game, system] = self.meta;
        json!({
            "index": index,
            "route_id": format!("RouteScenario_{}{suffix}", self.id),
            "status": self.status,
            "infractions": infractions,
            "scores": {
                "score_route": self.route,
                "score_penalty": self.penalty,
                "score_composed": self.route * self.penalty,
            },
            "meta": {"route_length": length, "duration_game": game, "duration_system": system},
        })
    }
}

/// A worker's file with `records` of `total`.
pub fn file(total: usize, records: &[Value]) -> Value {
    json!({
        "_checkpoint": {"global_record": {}, "progress": [records.len(), total], "records": records},
        "entry_status": "Started",
        "eligible": false,
        "sensors": ["carla_camera", "carla_gnss", "carla_camera"],
        "values": [],
        "labels": [],
    })
}

/// A worker's file that holds all its drives.
pub fn finished(format: Format, drives: &[Drive]) -> Value {
    let records: Vec<Value> = drives
        .iter()
        .enumerate()
        .map(|(i, drive)| drive.json(format, i))
        .collect();
    file(records.len(), &records)
}

/// A pod's plan over slices `(first, last)`.
pub fn pod(format: Format, repetitions: u32, slices: &[(u32, u32)]) -> Plan {
    let pairs: Vec<Slice> = slices
        .iter()
        .map(|(first, last)| Slice {
            first: *first,
            last: *last,
        })
        .collect();
    Plan {
        format,
        strictness: Strictness::Pod,
        routes: pairs.iter().map(|slice| slice.routes()).sum(),
        pairs,
        repetitions,
        verify: Verify::Warn,
        as_original: false,
    }
}

pub fn read(plan: &Plan, pair: usize, file: &Value) -> Result<Option<Checkpoint>, Refusal> {
    read_worker(plan, pair, file.to_string().as_bytes())
}

pub fn merged(plan: &Plan, files: &[Option<Value>]) -> Result<Merged, Refusal> {
    let mut read_files = Vec::new();
    for (pair, value) in files.iter().enumerate() {
        read_files.push(match value {
            Some(value) => read(plan, pair, value)?,
            None => None,
        });
    }
    merge(plan, &read_files.iter().map(Option::as_ref).collect::<Vec<_>>())
}

/// Prints how many cases ran, past the harness, which hides what a passing test prints.
pub fn say(line: &str) {
    // In one piece, among the lines of the harness. A closed standard error does not fail a test.
    let _ = std::io::stderr().write_all(format!("{line}\n").as_bytes());
}

/// Compares refusals with their file in `tests/refusals`: for each what was refused, its kind, and the participant's words.
/// UPDATE_GOLDEN=1 writes it; read the difference then.
pub fn assert_refusals(name: &str, refusals: &[(String, Refusal)]) {
    let mut text = String::new();
    for (what, refusal) in refusals {
        let kind = format!("{refusal:?}");
        let kind = kind.split([' ', '(']).next().unwrap_or_default();
        writeln!(text, "{what}\n    {kind}: {refusal}\n    {}", refusal.next_step()).unwrap();
    }
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/refusals/{name}.txt"));
    if std::env::var_os("UPDATE_GOLDEN").is_some() {
        return std::fs::write(file, text).unwrap();
    }
    let known = std::fs::read_to_string(file).unwrap_or_default();
    assert_eq!(text, known, "{name}: set UPDATE_GOLDEN=1 and read the difference");
}
