//! `leaderboard-operator labels`: the metrics of the CARLA Leaderboard as the schema of a leaderboard in EvalAI.
//!
//! The names are those of `crates/results`, which every result is made with.

use std::collections::BTreeMap;
use std::io::Write as _;
use std::process::ExitCode;

use clap::Args;
use leaderboard_results::{Format, Metric, Source, metrics};
use serde::Serialize;

use super::offline::formats;

/// Print the metric labels that a phase of the CARLA Leaderboard needs, as the schema of its leaderboard in EvalAI.
#[derive(Args, Debug)]
pub(super) struct Labels {
    /// Leaderboard 1.0 (v1) or 2.0 (v2).
    #[arg(long, value_parser = formats())]
    format: Format,
}

/// `leaderboard[].schema` of a challenge's configuration.
#[derive(Serialize)]
struct Schema {
    labels: Vec<&'static str>,
    default_order_by: &'static str,
    metadata: BTreeMap<&'static str, Order>,
}

#[derive(Serialize)]
struct Order {
    sort_ascending: bool,
}

impl Labels {
    pub(super) fn run(&self) -> ExitCode {
        let all = metrics(self.format);
        let Some(schema) = schema(all).and_then(|schema| serde_json::to_string_pretty(&schema).ok()) else {
            eprintln!("leaderboard-operator labels: the format has no metrics");
            return ExitCode::FAILURE;
        };
        // A closed pipe is ignored.
        let _ = writeln!(std::io::stdout(), "{schema}");
        ExitCode::SUCCESS
    }
}

fn schema(all: &'static [Metric]) -> Option<Schema> {
    let order = |metric: &Metric| Order {
        sort_ascending: matches!(metric.source, Source::Infraction(_)),
    };
    Some(Schema {
        labels: all.iter().map(|metric| metric.name).collect(),
        default_order_by: all.first()?.name,
        metadata: all.iter().map(|metric| (metric.name, order(metric))).collect(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn a_schema_has_every_metric_of_its_format_and_ranks_by_the_driving_score() {
        for (format, count) in [(Format::V1, 12), (Format::V2, 15)] {
            let schema = serde_json::to_value(schema(metrics(format))).unwrap();
            assert_eq!(schema["labels"].as_array().unwrap().len(), count);
            assert_eq!(schema["default_order_by"], json!("Driving score"));
            for (label, ascending) in [("Route completion", false), ("Agent blocked", true)] {
                assert_eq!(
                    schema["metadata"][label],
                    json!({"sort_ascending": ascending}),
                    "{label}"
                );
            }
        }
    }

    /// A host copies it from there.
    #[test]
    fn the_page_shows_the_schema() {
        let page = include_str!("../../docs/import.md");
        let (_, rest) = page.split_once("```json\n").unwrap();
        let (shown, _) = rest.split_once("```").unwrap();
        let shown: serde_json::Value = serde_json::from_str(shown).unwrap();
        assert_eq!(shown, serde_json::to_value(schema(metrics(Format::V2))).unwrap());
    }
}
