//! Files of an evaluator that was started again: a route that it repeats does not count, and a complete run stays complete.
#![allow(clippy::unwrap_used, reason = "the helpers of a test may fail it")]

mod common;

use std::fs;
use std::path::Path;

use common::{Drive, file, merged, pod, read};
use leaderboard_results::{Checkpoint, Format, Merged, Outcome, Plan, merge, offline, render};
use serde_json::{Value, json};

const V1: Format = Format::V1;
const V2: Format = Format::V2;

/// The mean driving score of the real files.
const SCORE: f64 = 29.488_048;

fn text(name: &str) -> String {
    let tests = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests");
    fs::read_to_string(tests.join(name)).unwrap()
}

fn value(name: &str) -> Value {
    serde_json::from_str(&text(name)).unwrap()
}

/// The plan of the real files: 16 routes on four pairs.
fn four_pairs() -> Plan {
    pod(V2, 1, &[(0, 3), (4, 7), (8, 11), (12, 15)])
}

/// The complete files of all pairs after each evaluator was started once more.
fn started_once_more() -> Vec<Option<Value>> {
    let of = |pair: usize| Some(value(&format!("restarted/done/in{pair}.json")));
    (1..=4).map(of).collect()
}

/// Their content before that.
fn complete() -> Vec<Option<Value>> {
    let sensors = value("restarted/last.json")["sensors"].clone();
    let mut files = started_once_more();
    for file in files.iter_mut().flatten() {
        file["sensors"] = sensors.clone();
    }
    files
}

fn with_pair(pair: usize, name: &str) -> Merged {
    let mut files = complete();
    files[pair - 1] = Some(value(name));
    merged(&four_pairs(), &files).unwrap()
}

#[test]
fn complete_pairs_that_were_started_once_more_count_although_the_merged_file_is_the_originals() {
    let files: Vec<_> = (1..=4)
        .map(|pair| Some(text(&format!("restarted/done/in{pair}.json")).into_bytes()))
        .collect();
    for plan in [four_pairs(), Plan::lenient(V2)] {
        let (result, texts) = offline(&plan, &files).unwrap();
        assert!(result.text == text("restarted/done/merged.json"), "it differs");
        assert_eq!(texts.metadata_json.as_ref(), Some(&result.text));
        assert_eq!(
            (result.entry_status.as_str(), result.ended_as()),
            ("Invalid", "Finished")
        );
        assert_eq!(
            (result.is_final, result.eligible, result.outcome),
            (true, true, Outcome::Finished)
        );
        assert_eq!((result.done, result.total, result.score), (16, 16, Some(SCORE)));
    }
    let original = Plan {
        as_original: true,
        ..four_pairs()
    };
    let (result, _) = offline(&original, &files).unwrap();
    assert_eq!(
        (result.eligible, result.outcome, result.ended_as()),
        (false, Outcome::Invalid, "Invalid")
    );
}

#[test]
fn a_route_that_is_being_repeated_does_not_count() {
    for name in ["restarted/crashed.json", "restarted/resumed.json"] {
        let result = with_pair(4, name);
        assert_eq!((result.done, result.total, result.is_final), (15, 16, false), "{name}");
        assert_eq!((result.pairs[3].done, result.outcome), (3, Outcome::Running), "{name}");
        let files = render(&four_pairs(), Some(&result)).unwrap();
        assert!(
            files.stdout_txt.contains("- Completed 15 out of the 16 routes\n"),
            "{name}"
        );
        assert!(files.partial_json.is_some(), "{name}");
    }
    // One that died before its global record has nothing to repeat.
    let result = with_pair(1, "restarted/last.json");
    assert_eq!((result.done, result.pairs[0].ended), (16, false));
    assert!(result.eligible);
}

#[test]
fn a_record_that_its_evaluator_does_not_count_yet_is_not_done() {
    for format in [V1, V2] {
        let plan = pod(format, 1, &[(0, 2)]);
        for (progress, status, done) in [
            (2, "Started", 2),
            (1, "Started", 1),
            (2, "Crashed", 1),
            (3, "Started", 2),
        ] {
            let mut worker = file(
                3,
                &[Drive::perfect(0).json(format, 0), Drive::perfect(1).json(format, 1)],
            );
            worker["_checkpoint"]["progress"] = json!([progress, 3]);
            worker["entry_status"] = json!(status);
            assert_eq!(
                read(&plan, 0, &worker).unwrap().unwrap().done(),
                done,
                "{format:?} {progress} {status}"
            );
        }
    }
}

/// Two routes of one pair: what the evaluator has after so many of them.
fn step(done: usize, sensors: bool) -> Value {
    let drives: Vec<Value> = (0..2).map(|id| Drive::perfect(id).json(V2, 0)).collect();
    let mut worker = file(2, &drives[..done]);
    if !sensors {
        worker["sensors"] = json!([]);
    }
    worker
}

/// The end of an evaluator of V2 that comes to it without having set up an agent.
fn ended(mut worker: Value) -> Value {
    worker["_checkpoint"]["global_record"] = json!({"index": -1});
    worker["entry_status"] = json!("Finished");
    worker["eligible"] = json!(true);
    worker
}

/// The outcome of files that are read one after the other.
fn outcome_of(files: &[Value]) -> Outcome {
    let plan = pod(V2, 1, &[(0, 1)]);
    let mut known: Option<Checkpoint> = None;
    for file in files {
        let found = read(&plan, 0, file).unwrap().unwrap();
        known = match &known {
            Some(earlier) => found.after(earlier).or(known),
            None => Some(found),
        };
    }
    merge(&plan, &[known.as_ref()]).unwrap().outcome
}

#[test]
fn sensors_that_were_named_once_are_not_missed_in_a_file_that_goes_on_from_there() {
    let rest_failed_before_its_set_up = || {
        let mut worker = ended(step(2, false));
        worker["_checkpoint"]["records"][1]["status"] = json!("Failed - Agent couldn't be set up");
        worker
    };
    let named = [step(0, false), step(0, true), step(1, true), step(1, false)];
    assert_eq!(
        outcome_of(&[&named[..], &[rest_failed_before_its_set_up()]].concat()),
        Outcome::Finished
    );
    // This reader has begun after the restart.
    assert_eq!(
        outcome_of(&[step(1, false), rest_failed_before_its_set_up()]),
        Outcome::Finished
    );
    assert_eq!(outcome_of(&[rest_failed_before_its_set_up()]), Outcome::Finished);
}

#[test]
fn an_agent_that_never_names_its_sensors_gains_nothing_by_it() {
    let never = [step(0, false), step(1, false), ended(step(2, false))];
    assert_eq!(outcome_of(&never), Outcome::Invalid);
    // Sensors of a drive are no word for another one with a better score.
    let mut worse = step(1, true);
    worse["_checkpoint"]["records"][0]["scores"] =
        json!({"score_route": 50.0, "score_penalty": 1.0, "score_composed": 50.0});
    assert_eq!(outcome_of(&[worse, ended(step(2, false))]), Outcome::Invalid);
    // Its own evaluator does not call it good: an agent without sensors, or a file that lacks its end.
    let mut own = ended(step(2, false));
    own["entry_status"] = json!("Invalid");
    own["eligible"] = json!(false);
    assert_eq!(outcome_of(&[own]), Outcome::Invalid);
    assert_eq!(outcome_of(&[step(2, false)]), Outcome::Invalid);
    // No agent was ever set up.
    let mut none = ended(step(2, false));
    for record in none["_checkpoint"]["records"].as_array_mut().unwrap() {
        record["status"] = json!("Failed - Agent couldn't be set up");
    }
    assert_eq!(outcome_of(&[none]), Outcome::Invalid);
    let mut crashed = ended(step(2, false));
    crashed["_checkpoint"]["records"][1]["status"] = json!("Failed - Simulation crashed");
    assert_eq!(outcome_of(&[step(1, true), crashed]), Outcome::Crashed);
}

#[test]
fn what_a_checkpoint_once_had_is_not_lost_by_a_later_one() {
    let plan = four_pairs();
    let is_taken = |pair: usize, earlier: &Value, later: &Value| {
        let [earlier, later] = [earlier, later].map(|file| read(&plan, pair - 1, file).unwrap().unwrap());
        later.after(&earlier).is_some()
    };
    for pair in 1..=4 {
        let (before, after) = (complete(), started_once_more());
        let [before, after] = [before, after].map(|files| files[pair - 1].clone().unwrap());
        assert!(!is_taken(pair, &before, &after), "the sensors are gone");
        assert!(is_taken(pair, &after, &before));
        assert!(is_taken(pair, &before, &before));
        let mut begun = before.clone();
        begun["_checkpoint"]["global_record"] = json!({});
        assert!(!is_taken(pair, &before, &begun), "the global record is gone");
        let mut fewer = before.clone();
        fewer["_checkpoint"]["records"].as_array_mut().unwrap().pop();
        assert!(!is_taken(pair, &before, &fewer), "a record is gone");
        // From such an end an evaluator starts over.
        let mut invalid = before.clone();
        invalid["entry_status"] = json!("Invalid");
        assert!(is_taken(pair, &invalid, &fewer));
    }
    let [crashed, resumed] = ["crashed", "resumed"].map(|name| value(&format!("restarted/{name}.json")));
    assert!(!is_taken(4, &crashed, &resumed), "the sensors are gone");
    let repeated = complete()[3].clone().unwrap();
    assert!(is_taken(4, &crashed, &repeated) && is_taken(4, &resumed, &repeated));
}
