//! The metrics over the routes done so far, which EvalAI gets before a run is final.
#![allow(clippy::unwrap_used, reason = "the helpers of a test may fail it")]

mod common;

use common::{Drive, file, finished, merged, pod};
use leaderboard_results::{Files, Format, Merged, Plan, Strictness, metrics, offline, render};
use serde_json::{Value, json};

/// A drive with infractions, whose numbers differ from those of the others.
fn drive(id: u32) -> Drive {
    let collision = vec!["Agent collided against object".to_owned()];
    let off_road = "Agent went outside its route lanes for about 12.5 meters (1.2% of the completed route)".to_owned();
    Drive {
        infractions: vec![
            ("collisions_vehicle", collision),
            ("outside_route_lanes", vec![off_road]),
        ],
        route: 90.0 - f64::from(id),
        penalty: 0.6,
        meta: [1000.0 + 10.0 * f64::from(id), 100.0, 800.0],
        ..Drive::perfect(id)
    }
}

fn records(format: Format, ids: std::ops::Range<u32>) -> Vec<Value> {
    ids.enumerate()
        .map(|(index, id)| drive(id).json(format, index))
        .collect()
}

fn files(plan: &Plan, inputs: &[Option<Value>]) -> (Merged, Files) {
    let result = merged(plan, inputs).unwrap();
    let files = render(plan, Some(&result)).unwrap();
    (result, files)
}

fn accuracies(results: &str) -> serde_json::Map<String, Value> {
    let parsed: Value = serde_json::from_str(results).unwrap();
    assert_eq!(parsed.as_array().unwrap().len(), 1);
    assert_eq!(parsed[0]["split"], "leaderboard");
    parsed[0]["accuracies"].as_object().unwrap().clone()
}

#[test]
fn partial_metrics_are_those_of_a_run_over_the_routes_done_so_far() {
    for format in [Format::V1, Format::V2] {
        let plan = pod(format, 1, &[(0, 4), (5, 9)]);
        for (first, second) in [(1, 0), (0, 1), (2, 3), (5, 0), (5, 4)] {
            let inputs = [
                Some(file(5, &records(format, 0..first))),
                Some(file(5, &records(format, 5..5 + second))),
            ];
            let (result, partial) = files(&plan, &inputs);
            assert!(!result.is_final);
            let stored = accuracies(&partial.results_json);
            assert!(
                stored.values().all(|value| *value == json!(0)),
                "the stored file stays the original's"
            );

            let mut drives: Vec<Drive> = (0..first).map(drive).collect();
            drives.extend((5..5 + second).map(drive));
            let whole = finished(format, &drives).to_string().into_bytes();
            let (alone, whole) = offline(&Plan::lenient(format), &[Some(whole)]).unwrap_or_else(|_| {
                // The original's search for gaps in the ids: such routes alone are no run of V2.
                let renumbered: Vec<Drive> = drives
                    .iter()
                    .zip(0..)
                    .map(|(d, id)| Drive { id, ..d.clone() })
                    .collect();
                let whole = finished(format, &renumbered).to_string().into_bytes();
                offline(&Plan::lenient(format), &[Some(whole)]).unwrap()
            });
            assert!(alone.is_final);
            assert_eq!(
                partial.partial_json,
                Some(whole.results_json.clone()),
                "{format:?} {first} {second}"
            );
            assert_eq!(accuracies(&whole.results_json).len(), metrics(format).len());
            assert_eq!(whole.partial_json, None, "what is final is not partial");
        }
    }
}

#[test]
fn a_partial_row_has_the_score_that_the_report_has() {
    let plan = pod(Format::V2, 1, &[(0, 1), (2, 3)]);
    let mut crashed = finished(Format::V2, &[drive(0), drive(1).status("Failed - Simulation crashed")]);
    crashed["entry_status"] = json!("Crashed");
    let (result, partial) = files(&plan, &[Some(crashed), Some(file(2, &records(Format::V2, 2..3)))]);
    assert_eq!(result.done, 2, "the crashed route is going to be repeated");
    let score = accuracies(&partial.partial_json.unwrap())["Driving score"]
        .as_f64()
        .unwrap();
    assert!((score - 89.0 * 0.6).abs() < 1e-6, "{score}");
    assert!(
        (result.partial_score.unwrap() - score).abs() < 1e-6,
        "{:?}",
        result.partial_score
    );
}

#[test]
fn there_are_no_partial_metrics_without_a_route_as_the_original_or_without_a_finite_value() {
    let plan = pod(Format::V2, 1, &[(0, 1)]);
    assert_eq!(render(&plan, None).unwrap().partial_json, None);
    let (_, nothing) = files(&plan, &[Some(file(2, &[]))]);
    assert_eq!(nothing.partial_json, None);

    let one = || vec![Some(file(2, &records(Format::V2, 0..1)))];
    assert!(files(&plan, &one()).1.partial_json.is_some());
    let original = Plan {
        as_original: true,
        ..plan
    };
    assert_eq!(files(&original, &one()).1.partial_json, None);

    // V1 can't divide by no length; before the end that refuses nothing.
    let plan = Plan {
        strictness: Strictness::Offline,
        ..pod(Format::V1, 1, &[(0, 1)])
    };
    let stuck = Drive {
        meta: [0.0, 1.0, 1.0],
        ..drive(0)
    };
    let (result, partial) = files(&plan, &[Some(file(2, &[stuck.json(Format::V1, 0)]))]);
    assert_eq!((result.done, partial.partial_json), (1, None));
}
