//! A worker's own global record, at the end of its routes: the Leaderboard's formulas over the worker's records. Called
//! by `evaluator`. (The operator's merge makes its own over all workers; the two share no code on purpose.)

use std::collections::BTreeMap;

use serde_json::Value;

use crate::{
    checkpoint::{GlobalMeta, GlobalRecord, Record, ScoreTriple, infractions},
    flags::Format,
    scenario::rounded,
};

const LABELS: [&str; 15] = [
    "Avg. driving score",
    "Avg. route completion",
    "Avg. infraction penalty",
    "Collisions with pedestrians",
    "Collisions with vehicles",
    "Collisions with layout",
    "Red lights infractions",
    "Stop sign infractions",
    "Off-road infractions",
    "Route deviations",
    "Route timeouts",
    "Agent blocked",
    "Yield emergency vehicles infractions",
    "Scenario timeouts",
    "Min speed infractions",
];
/// The infractions behind the labels from the fourth on.
const LABELLED: [&str; 12] = [
    "collisions_pedestrian",
    "collisions_vehicle",
    "collisions_layout",
    "red_light",
    "stop_infraction",
    "outside_route_lanes",
    "route_dev",
    "route_timeout",
    "vehicle_blocked",
    "yield_emergency_vehicle_infractions",
    "scenario_timeouts",
    "min_speed_infractions",
];

/// The names of a version's metrics.
pub fn labels(format: Format) -> Vec<String> {
    LABELS
        .iter()
        .take(metrics(format))
        .map(|&label| label.to_owned())
        .collect()
}

/// The metrics as the checkpoint's `values`: V1 with three digits, V2 as Python prints a float.
pub fn values(format: Format, global: &GlobalRecord) -> Vec<String> {
    let means = global.scores.as_ref().or(global.scores_mean.as_ref());
    let means = means
        .into_iter()
        .flat_map(|means| [means.score_composed, means.score_route, means.score_penalty]);
    let rates = LABELLED
        .iter()
        .filter_map(|name| global.infractions.get(*name))
        .filter_map(Value::as_f64);
    let print = |value: f64| match format {
        Format::V1 => format!("{value:.3}"),
        Format::V2 => format!("{value:?}"),
    };
    means.chain(rates).take(metrics(format)).map(print).collect()
}

/// How the whole evaluation ended.
pub fn entry_status(format: Format, records: &[Record]) -> &'static str {
    let last = records.iter().rev().find_map(|record| match record.status.as_str() {
        status if status.contains("Simulation crashed") => Some("Crashed"),
        status if status.contains("Agent's sensors were invalid") => Some("Rejected"),
        _ => None,
    });
    match format {
        Format::V2 => last.unwrap_or("Finished"),
        Format::V1 if records.iter().any(|record| record.status.contains("Agent")) => "Finished with agent errors",
        Format::V1 => "Finished",
    }
}

/// The global record over `records`.
pub fn global(format: Format, records: &[Record]) -> GlobalRecord {
    let means = triple(|of| mean(format, records, of));
    let deviations = ScoreTriple {
        score_composed: deviation(format, records, means.score_composed, composed),
        score_route: deviation(format, records, means.score_route, route),
        score_penalty: deviation(format, records, means.score_penalty, penalty),
    };
    let exceptions = exceptions(format, records);
    let (scores, scores_mean) = if format == Format::V1 {
        (Some(means), None)
    } else {
        (None, Some(means))
    };
    GlobalRecord {
        index: -1,
        route_id: -1,
        status: status(format, records, !exceptions.is_empty()),
        infractions: rates(format, records),
        scores,
        scores_mean,
        scores_std_dev: deviations,
        meta: GlobalMeta {
            total_length: records.iter().map(|record| record.meta.route_length).sum(),
            duration_game: records.iter().map(|record| record.meta.duration_game).sum(),
            duration_system: records.iter().map(|record| record.meta.duration_system).sum(),
            exceptions: (format == Format::V2 || !exceptions.is_empty()).then_some(exceptions),
        },
    }
}

fn metrics(format: Format) -> usize {
    if format == Format::V1 { 12 } else { 15 }
}

fn composed(record: &Record) -> f64 {
    record.scores.score_composed
}
fn route(record: &Record) -> f64 {
    record.scores.score_route.as_f64().unwrap_or_default()
}
fn penalty(record: &Record) -> f64 {
    record.scores.score_penalty
}

fn triple(mean: impl Fn(fn(&Record) -> f64) -> f64) -> ScoreTriple<f64> {
    ScoreTriple {
        score_composed: mean(composed),
        score_route: mean(route),
        score_penalty: mean(penalty),
    }
}

/// V2 divides before it adds, V1 after.
fn mean(format: Format, records: &[Record], of: fn(&Record) -> f64) -> f64 {
    let total = count(records);
    match format {
        Format::V1 => records.iter().map(of).sum::<f64>() / total,
        Format::V2 => rounded(format, records.iter().map(|record| of(record) / total).sum(), 6),
    }
}

fn deviation(format: Format, records: &[Record], mean: f64, of: fn(&Record) -> f64) -> Value {
    if records.len() == 1 {
        return if format == Format::V1 {
            Value::from("NaN")
        } else {
            Value::from(0)
        };
    }
    let squares: f64 = records.iter().map(|record| (of(record) - mean).powi(2)).sum();
    Value::from(rounded(format, (squares / (count(records) - 1.0)).sqrt(), 3))
}

/// V1 compares texts by identity, and no text that was read is identical to its own: each route of an earlier process failed.
fn exceptions(format: Format, records: &[Record]) -> Vec<(String, usize, String)> {
    let failed = |record: &&Record| match format {
        Format::V1 => record.from_file || record.status != "Completed",
        Format::V2 => record.status.contains("Failed"),
    };
    records
        .iter()
        .filter(failed)
        .map(|record| (record.route_id.clone(), record.index, record.status.clone()))
        .collect()
}

fn status(format: Format, records: &[Record], failed: bool) -> String {
    let best = if format == Format::V1 { "Completed" } else { "Perfect" };
    let first_less = records.iter().find(|record| record.status != best);
    if failed {
        "Failed".to_owned()
    } else {
        first_less.map_or(best, |record| &record.status).to_owned()
    }
}

/// V2: per driven kilometer, off-road in kilometers. V1: the sum of each route's own rate.
fn rates(format: Format, records: &[Record]) -> BTreeMap<String, Value> {
    let driven = |record: &Record| record.meta.route_length / 1000.0 * route(record) / 100.0;
    let all: f64 = records.iter().map(driven).sum::<f64>().max(0.001);
    let number_of = |name: &str, record: &Record| record.infractions.get(name).map_or(0.0, |list| count(list));
    let rate = |name: &'static str| match (format, name) {
        (Format::V1, _) => records
            .iter()
            .filter(|record| route(record) != 0.0)
            .map(|record| number_of(name, record) / driven(record))
            .sum(),
        (Format::V2, "outside_route_lanes") => {
            rounded(format, records.iter().map(|record| meters(record) / 1000.0).sum(), 3)
        }
        (Format::V2, _) => rounded(
            format,
            records.iter().map(|record| number_of(name, record)).sum::<f64>() / all,
            3,
        ),
    };
    infractions(format)
        .map(|name| (name.to_owned(), Value::from(rate(name) + 0.0)))
        .collect()
}

/// The ninth word of the first off-road message.
fn meters(record: &Record) -> f64 {
    let message = record
        .infractions
        .get("outside_route_lanes")
        .and_then(|messages| messages.first());
    message
        .and_then(|message| message.split(' ').nth(8))
        .and_then(|word| word.parse().ok())
        .unwrap_or_default()
}

#[expect(clippy::cast_precision_loss, reason = "a worker has a few hundred records at most")]
fn count<T>(list: &[T]) -> f64 {
    list.len() as f64
}
