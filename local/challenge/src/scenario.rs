//! The end of each route: the table `scenario.json` beside the routes file, and the record that it makes. Called by `evaluator`; the
//! penalties follow the Leaderboard's formulas (V1, and V2.0).

use std::collections::BTreeMap;

use serde::Deserialize;
use serde_json::Number;

use crate::{
    checkpoint::{Meta, Record, Scores, infractions},
    flags::Format,
};

/// Why a route has not begun: its world can't be loaded.
pub const NOT_LOADED: &str = "Simulation crashed";

/// The table.
#[derive(Debug, Deserialize)]
pub struct Scenario {
    pub sensors: Vec<String>,
    /// By route id.
    pub routes: BTreeMap<String, Outcome>,
}

/// How one route ends. Lengths in meters, times in seconds.
#[derive(Clone, Debug, Deserialize)]
pub struct Outcome {
    pub status: String,
    pub score_route: Number,
    pub route_length: f64,
    pub duration_game: f64,
    pub duration_system: f64,
    #[serde(default)]
    pub infractions: BTreeMap<String, Vec<String>>,
}

/// One route of a worker's list.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Leg {
    /// From 0, per worker.
    pub index: usize,
    pub route: String,
    pub repetition: usize,
}

impl Leg {
    /// V1's repetitions share one id.
    pub fn id(&self, format: Format) -> String {
        match format {
            Format::V1 => format!("RouteScenario_{}", self.route),
            Format::V2 => format!("RouteScenario_{}_rep{}", self.route, self.repetition),
        }
    }
}

impl Outcome {
    /// The record of a route that was driven to its end.
    pub fn record(&self, format: Format, leg: &Leg) -> Record {
        let found: BTreeMap<_, _> = infractions(format)
            .map(|name| (name.to_owned(), self.infractions.get(name).cloned().unwrap_or_default()))
            .collect();
        let penalty = penalty(&found);
        let status = match (format, self.status.as_str()) {
            (Format::V1, "Perfect") => "Completed",
            (_, other) => other,
        };
        let score = self.score_route.as_f64().unwrap_or_default();
        Record {
            scores: Scores {
                score_route: self.score_route.clone(),
                score_penalty: rounded(format, penalty, 6),
                score_composed: rounded(format, (score * penalty).max(0.0), 6),
            },
            meta: Meta {
                route_length: self.route_length,
                duration_game: self.duration_game,
                duration_system: self.duration_system,
            },
            ..empty(format, leg, status, found)
        }
    }

    /// The record of a route that never began. Its length is known unless V2 could not load its world.
    pub fn not_begun(&self, format: Format, leg: &Leg, why: &str) -> Record {
        let none = infractions(format).map(|name| (name.to_owned(), Vec::new())).collect();
        let mut record = empty(format, leg, &format!("Failed - {why}"), none);
        record.scores.score_penalty = 1.0;
        if format == Format::V1 || why != NOT_LOADED {
            record.meta.route_length = self.route_length;
        }
        record
    }

    /// The record of a route in whose middle the simulator died.
    pub fn broken_off(&self, format: Format, leg: &Leg) -> Record {
        let score = rounded(format, self.score_route.as_f64().unwrap_or_default() / 2.0, 6);
        let none = infractions(format).map(|name| (name.to_owned(), Vec::new())).collect();
        Record {
            scores: Scores {
                score_route: number(score),
                score_penalty: 1.0,
                score_composed: score,
            },
            meta: Meta {
                route_length: self.route_length,
                duration_game: rounded(format, self.duration_game / 2.0, 3),
                duration_system: rounded(format, self.duration_system / 2.0, 3),
            },
            ..empty(format, leg, "Failed - Simulation crashed", none)
        }
    }
}

fn empty(format: Format, leg: &Leg, status: &str, found: BTreeMap<String, Vec<String>>) -> Record {
    Record {
        from_file: false,
        index: leg.index,
        route_id: leg.id(format),
        status: status.to_owned(),
        num_infractions: (format == Format::V2).then(|| found.values().map(Vec::len).sum()),
        infractions: found,
        scores: Scores {
            score_route: number(0.0),
            score_penalty: 0.0,
            score_composed: 0.0,
        },
        meta: Meta {
            route_length: 0.0,
            duration_game: 0.0,
            duration_system: 0.0,
        },
    }
}

/// V2 rounds what it writes; V1 does not.
pub fn rounded(format: Format, value: f64, digits: usize) -> f64 {
    match format {
        Format::V1 => value,
        Format::V2 => format!("{value:.digits$}").parse().unwrap_or(value),
    }
}

fn number(value: f64) -> Number {
    Number::from_f64(value).unwrap_or_else(|| Number::from(0))
}

/// The product over all infractions, V2.0's formula; V1's is the same over its own nine.
fn penalty(found: &BTreeMap<String, Vec<String>>) -> f64 {
    found
        .iter()
        .flat_map(|(name, messages)| messages.iter().map(|message| factor(name, message)))
        .product()
}

fn factor(name: &str, message: &str) -> f64 {
    match name {
        "collisions_pedestrian" => 0.5,
        "collisions_vehicle" => 0.6,
        "collisions_layout" => 0.65,
        "red_light" | "scenario_timeouts" | "yield_emergency_vehicle_infractions" => 0.7,
        "stop_infraction" => 0.8,
        "outside_route_lanes" => 1.0 - percentage(message) / 100.0,
        "min_speed_infractions" => 1.0 - 0.3 * (1.0 - percentage(message) / 100.0),
        _ => 1.0,
    }
}

/// The number before the message's `%`; without one the infraction costs nothing.
fn percentage(message: &str) -> f64 {
    let before = message.split('%').next().unwrap_or_default();
    let digits = before
        .rsplit(|letter: char| letter != '.' && !letter.is_ascii_digit())
        .next();
    digits.and_then(|digits| digits.parse().ok()).unwrap_or(100.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn outcome(infractions: &[(&str, &[&str])]) -> Outcome {
        Outcome {
            status: "Perfect".into(),
            score_route: Number::from(100),
            route_length: 1000.0,
            duration_game: 1.0,
            duration_system: 2.0,
            infractions: infractions
                .iter()
                .map(|(name, messages)| ((*name).to_owned(), messages.iter().map(|&one| one.to_owned()).collect()))
                .collect(),
        }
    }

    #[test]
    fn penalties_of_both_versions() {
        let off = "Agent went outside its route lanes for about 36.3 meters (5.0% of the completed route)";
        let slow = "Average speed is 60.0% of the surrounding traffic's one";
        let leg = Leg {
            index: 0,
            route: "7".into(),
            repetition: 2,
        };
        for (infractions, v2, v1) in [
            (
                &[("collisions_pedestrian", &["x"][..]), ("red_light", &["x", "y"])][..],
                0.245,
                0.245,
            ),
            (
                &[("outside_route_lanes", &[off]), ("stop_infraction", &["x"])],
                0.76,
                0.76,
            ),
            (
                &[("min_speed_infractions", &[slow]), ("scenario_timeouts", &["x"])],
                0.616,
                1.0,
            ),
            (&[("route_dev", &["x"]), ("collisions_layout", &["x"])], 0.65, 0.65),
            (
                &[
                    ("yield_emergency_vehicle_infractions", &["x"]),
                    ("collisions_vehicle", &["x"]),
                ],
                0.42,
                0.6,
            ),
        ] {
            for (format, expected) in [(Format::V2, v2), (Format::V1, v1)] {
                let record = outcome(infractions).record(format, &leg);
                assert!(
                    (record.scores.score_penalty - expected).abs() < 1e-12,
                    "{infractions:?} {format:?}"
                );
                assert!(
                    (record.scores.score_composed - expected * 100.0).abs() < 1e-9,
                    "{infractions:?} {format:?}"
                );
            }
        }
    }

    #[test]
    fn records_of_both_versions() {
        let leg = Leg {
            index: 4,
            route: "7".into(),
            repetition: 2,
        };
        let v2 = outcome(&[]).record(Format::V2, &leg);
        assert_eq!(
            (v2.route_id.as_str(), v2.status.as_str(), v2.num_infractions),
            ("RouteScenario_7_rep2", "Perfect", Some(0))
        );
        let v1 = outcome(&[]).record(Format::V1, &leg);
        assert_eq!(
            (v1.route_id.as_str(), v1.status.as_str(), v1.num_infractions),
            ("RouteScenario_7", "Completed", None)
        );
        assert_eq!((v2.infractions.len(), v1.infractions.len()), (12, 9));
    }
}
