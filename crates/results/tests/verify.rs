//! Forged and honest records: scores that follow from the infractions, and scores that do not.
#![allow(clippy::unwrap_used, reason = "the helpers of a test may fail it")]

mod common;

use std::fs;
use std::path::Path;

use common::{Drive, finished, pod, read};
use leaderboard_results::{Format, Plan, Verify, read_worker};

const V1: Format = Format::V1;
const V2: Format = Format::V2;

const OFF_ROAD: &str = "outside_route_lanes";
const SLOW: &str = "min_speed_infractions";

fn off_road(meters: f64, percentage: f64) -> String {
    format!("Agent went outside its route lanes for about {meters} meters ({percentage}% of the completed route)")
}

fn slow(percentage: f64) -> String {
    format!("Average speed is {percentage}% of the surrounding traffic's one")
}

fn drive(route: f64, penalty: f64, infractions: &[(&'static str, Vec<String>)]) -> Drive {
    Drive {
        route,
        penalty,
        infractions: infractions.to_vec(),
        ..Drive::perfect(0)
    }
}

fn times(name: &'static str, n: usize) -> (&'static str, Vec<String>) {
    (name, vec!["Agent did it at (x=1.0, y=2.0, z=3.0)".to_owned(); n])
}

/// Finding of verify in one drive, if it has one.
fn said(format: Format, drive: &Drive) -> Option<String> {
    let plan = pod(format, 1, &[(0, 0)]);
    let warnings = |plan: &Plan| read(plan, 0, &finished(format, std::slice::from_ref(drive)));
    let refuse = warnings(&Plan {
        verify: Verify::Refuse,
        ..plan.clone()
    });
    let off = warnings(&Plan {
        verify: Verify::Disabled,
        ..plan.clone()
    });
    assert!(off.is_ok(), "off means off");
    let worker = warnings(&plan).unwrap().unwrap();
    let merged = leaderboard_results::merge(&plan, &[Some(&worker)]).unwrap();
    assert_eq!(refuse.is_err(), !merged.warnings.is_empty(), "warn and refuse agree");
    if let Err(refusal) = refuse {
        assert_eq!(merged.warnings, [refusal.to_string()]);
    }
    merged.warnings.into_iter().next()
}

/// Drives as the evaluator of version 1 writes them.
fn honest_of_v1() -> Vec<(Format, Drive)> {
    vec![
        (V1, drive(100.0, 1.0, &[])),
        (V1, drive(56.235_168_948_938_26, 0.7, &[times("red_light", 1)])),
        (
            V1,
            drive(
                80.0,
                0.6 * 0.65,
                &[times("collisions_vehicle", 1), times("collisions_layout", 1)],
            ),
        ),
        (
            V1,
            drive(
                50.0,
                0.5 * 0.8 * 0.8,
                &[times("collisions_pedestrian", 1), times("stop_infraction", 2)],
            ),
        ),
        (
            V1,
            drive(90.0, 1.0 - 7.9187 / 100.0, &[(OFF_ROAD, vec![off_road(9.466, 7.92)])]),
        ),
        (
            V1,
            drive(
                40.0,
                1.0,
                &[
                    times("route_dev", 1),
                    times("vehicle_blocked", 1),
                    times("route_timeout", 1),
                ],
            ),
        ),
        (V1, drive(0.0, 1.0, &[])),
    ]
}

/// Drives as the evaluators of 2.0 and 2.1 write them.
fn honest_of_v2() -> Vec<(Format, Drive)> {
    vec![
        (
            V2,
            drive(100.0, 0.455, &[times("collisions_layout", 1), times("red_light", 1)]),
        ),
        (
            V2,
            drive(
                100.0,
                0.5 * 0.6 * 0.7 * 0.7,
                &[
                    times("collisions_pedestrian", 1),
                    times("collisions_vehicle", 1),
                    times("scenario_timeouts", 1),
                    times("yield_emergency_vehicle_infractions", 1),
                ],
            ),
        ),
        (
            V2,
            drive(
                100.0,
                0.59496,
                &[times("collisions_vehicle", 1), (SLOW, vec![slow(97.2)])],
            ),
        ),
        (V2, drive(60.0, 1.087, &[(SLOW, vec![slow(129.0)])])),
        (V2, drive(30.0, 0.961_234, &[(OFF_ROAD, vec![off_road(4.046, 3.88)])])),
        // 2.1: one over one plus the sum.
        (
            V2,
            drive(
                100.0,
                0.370_370,
                &[times("collisions_pedestrian", 1), times("collisions_vehicle", 1)],
            ),
        ),
        (
            V2,
            drive(
                100.0,
                0.558_659,
                &[
                    times("red_light", 1),
                    times("stop_infraction", 1),
                    (SLOW, vec![slow(65.0)]),
                ],
            ),
        ),
        (V2, drive(0.0, 0.0, &[])),
    ]
}

#[test]
fn honest_records_are_accepted() {
    let table = [honest_of_v1(), honest_of_v2()].concat();
    for (format, drive) in &table {
        assert_eq!(said(*format, drive), None, "{format:?} {drive:?}");
    }
    common::say(&format!("verify: {} honest records pass", table.len()));
}

type Forged = (Format, Drive, &'static str);

/// Drives whose scores no evaluator of 1.0 would write, each with words of the finding.
fn forged_of_v1() -> Vec<Forged> {
    vec![
        (
            V1,
            drive(100.0, 1.0, &[times("red_light", 1)]),
            "score_penalty is 1.0, but its infractions allow 0.7 at most",
        ),
        (
            V1,
            drive(100.0, 0.701, &[times("red_light", 1)]),
            "score_penalty is 0.701, but",
        ),
        (
            V1,
            drive(100.0, 0.9, &[times("red_light", 1), (SLOW, vec![slow(250.0)])]),
            "score_penalty is 0.9, but its infractions allow 0.7 at most",
        ),
    ]
}

/// Drives whose scores no evaluator of 2.0 or 2.1 would write.
fn forged_of_v2() -> Vec<Forged> {
    vec![
        (
            V2,
            drive(100.0, 1.0, &[times("collisions_vehicle", 3)]),
            "score_penalty is 1.0, but its infractions allow 0.322581 at most",
        ),
        (
            V2,
            drive(100.0, 0.61, &[times("collisions_vehicle", 1)]),
            "score_penalty is 0.61, but its infractions allow 0.6 at most",
        ),
        (
            V2,
            drive(
                100.0,
                0.65,
                &[times("collisions_vehicle", 1), (OFF_ROAD, vec![off_road(4.0, 3.88)])],
            ),
            "score_penalty is 0.65, but its infractions allow 0.6 at most",
        ),
        (
            V2,
            drive(50.0, 1.1, &[(SLOW, vec![slow(97.2)])]),
            "score_penalty is 1.1, but its infractions allow 1.0 at most",
        ),
        (
            V2,
            drive(50.0, 1.2, &[(SLOW, vec![slow(129.0)])]),
            "score_penalty is 1.2, but its infractions allow 1.131222 at most",
        ),
    ]
}

#[test]
fn forged_records_are_reported() {
    let name = |format| {
        if format == V1 {
            "pair 1, route RouteScenario_0: "
        } else {
            "pair 1, route RouteScenario_0_rep0: "
        }
    };
    let table = [forged_of_v1(), forged_of_v2()].concat();
    for (format, drive, words) in &table {
        let said = said(*format, drive).unwrap_or_default();
        assert!(said.starts_with(name(*format)) && said.contains(words), "{said:?}");
    }
    common::say(&format!("verify: {} forged records are found", table.len()));
}

#[test]
fn a_driving_score_that_is_no_product_is_reported() {
    for format in [V1, V2] {
        let mut file = finished(format, &[drive(50.0, 1.0, &[])]);
        file["_checkpoint"]["records"][0]["scores"]["score_composed"] = 90.into();
        let plan = Plan {
            verify: Verify::Refuse,
            ..pod(format, 1, &[(0, 0)])
        };
        let refusal = read(&plan, 0, &file).unwrap_err().to_string();
        assert!(
            refusal.ends_with("score_composed is 90.0, but score_route x score_penalty is 50.0"),
            "{refusal}"
        );
    }
}

/// A score below the one that the infractions give is no gain. It comes from a percentage that counts, a fork that punishes
/// more, or a message that is not the evaluator's.
#[test]
fn what_is_no_gain_is_not_reported() {
    let foreign = vec!["Agent collided with “café” 车".to_owned()];
    for (format, drive) in [
        (V1, drive(100.0, 0.9208, &[(OFF_ROAD, vec![off_road(9.466, 7.92)])])),
        (V2, drive(100.0, 0.5, &[times("collisions_vehicle", 1)])),
        (V2, drive(100.0, 0.9, &[])),
        (V2, drive(100.0, 1.0, &[(SLOW, vec!["slow".to_owned()])])),
        (
            V2,
            drive(100.0, 0.7, &[times("red_light", 1), ("collisions_vehicle", foreign)]),
        ),
    ] {
        assert_eq!(said(format, &drive), None, "{format:?} {drive:?}");
    }
}

/// Every normal case is honest, and taken as such; but for case25, which tries number texts with scores that are no
/// product in any of its records.
#[test]
fn normal_cases_are_honest() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/cases");
    let index = fs::read_to_string(root.join("index.tsv")).unwrap();
    let (mut honest, mut records, mut told) = (0, 0, Vec::new());
    for line in index.lines().filter(|line| line.contains("\tnormal\t")) {
        let columns: Vec<&str> = line.split('\t').collect();
        let format = if columns[0] == "v1" { V1 } else { V2 };
        let case = format!("{}/{}", columns[0], columns[1]);
        let before = told.len();
        for pair in 1..=4 {
            let Ok(bytes) = fs::read(root.join(&case).join(format!("in{pair}.json"))) else {
                continue;
            };
            let warn = Plan {
                verify: Verify::Warn,
                ..Plan::lenient(format)
            };
            let Some(worker) = read_worker(&warn, pair - 1, &bytes).unwrap() else {
                continue;
            };
            let refuse = Plan {
                verify: Verify::Refuse,
                ..warn.clone()
            };
            let warnings = worker.warnings();
            assert_eq!(
                read_worker(&refuse, pair - 1, &bytes).is_err(),
                !warnings.is_empty(),
                "{case}"
            );
            records += worker.done();
            told.extend(warnings.iter().map(|warning| format!("{case} {warning}")));
        }
        honest += usize::from(told.len() == before);
    }
    common::say(&format!(
        "verify: {honest} of 54 normal cases are honest, {records} records; {} records told, all of case25",
        told.len()
    ));
    let is_invented = |line: &&String| line.contains("/case25 ") && line.contains("score_composed is ");
    assert_eq!(
        (honest, told.iter().filter(is_invented).count()),
        (52, told.len()),
        "{told:#?}"
    );
    assert_eq!(told.len(), 16);
}
