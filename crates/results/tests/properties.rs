//! Properties of any run: how it is shared out, interrupted or extended changes nothing, and nothing makes it panic.
#![allow(clippy::unwrap_used, reason = "the helpers of a test may fail it")]

mod common;

use std::cell::Cell;

use common::{Drive, file, finished, merged, pod, say};
use leaderboard_results::{Format, Plan, Verify, merge, offline, read_worker, render};
use proptest::prelude::*;
use serde_json::{Map, Value, json};

const STATUSES: [&str; 4] = [
    "Completed",
    "Failed",
    "Failed - Agent got blocked",
    "Failed - Agent crashed",
];

fn drive(id: u32, repetition: u32) -> impl Strategy<Value = Drive> {
    let messages = |text: &str, n| vec![text.to_owned(); n];
    (
        0..4_usize,
        0.1..100.0,
        0.0..1.0,
        0..3_usize,
        0..2_usize,
        [1.0..9e3, 0.0..2e3, 0.0..2e4],
    )
        .prop_map(move |(status, route, penalty, lights, off_road, meta)| Drive {
            id,
            repetition,
            status: STATUSES[status].to_owned(),
            infractions: vec![
                ("red_light", messages("Agent ran a red light", lights)),
                (
                    "outside_route_lanes",
                    messages(
                        "Agent went outside its route lanes for about 4.5 meters (1.5% x",
                        off_road,
                    ),
                ),
            ],
            route,
            penalty,
            meta,
        })
}

/// A whole run: up to 12 routes, up to 3 repetitions, in order.
fn run(max_repetitions: u32) -> impl Strategy<Value = Vec<Drive>> {
    (1..=12_u32, 1..=max_repetitions).prop_flat_map(|(routes, repetitions)| {
        (0..routes)
            .flat_map(|id| (0..repetitions).map(move |k| drive(id, k)))
            .collect::<Vec<_>>()
    })
}

/// The run shared out: drive i goes to worker `owners[i]` of four.
fn shared(format: Format, drives: &[Drive], owners: &[usize]) -> Vec<Option<Value>> {
    (0..4)
        .map(|worker| {
            let own = drives
                .iter()
                .zip(owners)
                .filter(|(_, owner)| **owner == worker)
                .map(|(drive, _)| drive.clone());
            let own: Vec<Drive> = own.collect();
            (!own.is_empty()).then(|| finished(format, &own))
        })
        .collect()
}

fn contiguous(drives: &[Drive], mut cuts: [usize; 3]) -> Vec<usize> {
    cuts.sort_unstable();
    (0..drives.len())
        .map(|i| cuts.iter().filter(|cut| i >= **cut % (drives.len() + 1)).count())
        .collect()
}

fn numbers(results: &str) -> Vec<f64> {
    let value: Value = serde_json::from_str(results).unwrap();
    value[0]["accuracies"]
        .as_object()
        .unwrap()
        .values()
        .map(|number| number.as_f64().unwrap())
        .collect()
}

/// Any JSON a fork may add.
fn extra() -> impl Strategy<Value = Value> {
    let leaf = prop_oneof![
        Just(Value::Null),
        any::<bool>().prop_map(Value::from),
        any::<i64>().prop_map(Value::from),
        any::<i32>().prop_map(|i| Value::from(f64::from(i) / 8.0)),
        ".*".prop_map(Value::from),
    ];
    leaf.prop_recursive(3, 16, 4, |inner| {
        prop_oneof![
            prop::collection::vec(inner.clone(), 0..4).prop_map(Value::from),
            prop::collection::btree_map("[a-z]{1,6}", inner, 0..4)
                .prop_map(|map| Value::Object(map.into_iter().collect::<Map<_, _>>())),
        ]
    })
}

fn config(cases: u32) -> ProptestConfig {
    ProptestConfig {
        failure_persistence: None,
        ..ProptestConfig::with_cases(cases)
    }
}

/// Counts the cases of one property.
struct Ran(Cell<u32>);

impl Ran {
    fn new() -> Self {
        Self(Cell::new(0))
    }

    fn once(&self) {
        self.0.set(self.0.get() + 1);
    }

    fn say(&self, name: &str) {
        say(&format!("property: {name}, {} cases", self.0.get()));
    }
}

#[test]
fn v2_is_the_same_for_any_split() {
    let ran = Ran::new();
    proptest!(config(128), |(drives in run(3), owners in prop::collection::vec(0..4_usize, 36))| {
        ran.once();
        let plan = Plan::lenient(Format::V2);
        let alone = merged(&plan, &[Some(finished(Format::V2, &drives))]).unwrap();
        let split = merged(&plan, &shared(Format::V2, &drives, &owners)).unwrap();
        prop_assert!(alone.is_final);
        prop_assert_eq!(alone.text, split.text);
    });
    ran.say("v2_is_the_same_for_any_split");
}

#[test]
fn v1_is_the_same_for_a_contiguous_split() {
    let ran = Ran::new();
    proptest!(config(128), |(drives in run(1), cuts in any::<[usize; 3]>())| {
        ran.once();
        let plan = Plan::lenient(Format::V1);
        let alone = merged(&plan, &[Some(finished(Format::V1, &drives))]).unwrap();
        let split = merged(&plan, &shared(Format::V1, &drives, &contiguous(&drives, cuts))).unwrap();
        prop_assert!(alone.is_final);
        prop_assert_eq!(alone.text, split.text);
    });
    ran.say("v1_is_the_same_for_a_contiguous_split");
}

#[test]
fn v1_is_nearly_the_same_for_any_split() {
    let ran = Ran::new();
    proptest!(config(128), |(drives in run(3), owners in prop::collection::vec(0..4_usize, 36))| {
        ran.once();
        let plan = Plan::lenient(Format::V1);
        let rendered = |files: &[Option<Value>]| {
            render(&plan, Some(&merged(&plan, files).unwrap())).unwrap().results_json
        };
        let alone = numbers(&rendered(&[Some(finished(Format::V1, &drives))]));
        let split = numbers(&rendered(&shared(Format::V1, &drives, &owners)));
        prop_assert_eq!(alone.len(), 12);
        for (a, b) in alone.into_iter().zip(split) {
            prop_assert!((a - b).abs() <= 1e-9 * a.abs(), "{a} {b}");
        }
    });
    ran.say("v1_is_nearly_the_same_for_any_split");
}

/// The merged file of an interrupted run, and the rest of the run beside it, are the run. In V1 each route once, since its
/// repetitions share an id and its sums depend on their order.
#[test]
fn a_resumed_run_is_an_uninterrupted_one() {
    let ran = Ran::new();
    let owners = prop::collection::vec(0..4_usize, 24);
    let cut = any::<prop::sample::Index>();
    proptest!(config(256), |(drives in run(2), owners in owners, cut in cut, crashed: bool, v1: bool)| {
        ran.once();
        let format = if v1 { Format::V1 } else { Format::V2 };
        let drives: Vec<Drive> = drives.into_iter().filter(|drive| !v1 || drive.repetition == 0).collect();
        let plan = Plan::lenient(format);
        let whole = merged(&plan, &[Some(finished(format, &drives))]).unwrap();
        let (mut early, late) = drives.split_at(cut.index(drives.len() + 1));
        let mut late = late.to_vec();
        if crashed && let Some((last, before)) = early.split_last() {
            // The evaluator repeats a crashed route and overwrites its record.
            late.insert(0, last.clone());
            early = before;
        }
        let interrupted = merged(&plan, &shared(format, early, &owners)).unwrap();
        prop_assert_eq!(interrupted.done as usize, early.len());
        let late = finished(format, &late).to_string();
        let files = [interrupted.text, late].map(|text| Some(text.into_bytes()));
        let (resumed, _) = offline(&plan, &files).unwrap();
        prop_assert_eq!(whole.text, resumed.text);
    });
    ran.say("a_resumed_run_is_an_uninterrupted_one");
}

#[test]
fn merging_the_merged_file_changes_nothing() {
    let ran = Ran::new();
    proptest!(config(128), |(drives in run(2), v1 in any::<bool>())| {
        ran.once();
        let format = if v1 { Format::V1 } else { Format::V2 };
        let plan = Plan::lenient(format);
        let once = merged(&plan, &[Some(finished(format, &drives))]).unwrap();
        let (twice, _) = offline(&plan, &[Some(once.text.clone().into_bytes())]).unwrap();
        prop_assert_eq!(once.text, twice.text);
    });
    ran.say("merging_the_merged_file_changes_nothing");
}

#[test]
fn unknown_keys_survive() {
    let ran = Ran::new();
    proptest!(config(128), |(extra in extra(), infraction in extra(), v1 in any::<bool>())| {
        ran.once();
        let format = if v1 { Format::V1 } else { Format::V2 };
        let mut record = Drive::perfect(0).json(format, 0);
        record["save_name"] = extra.clone();
        record["infractions"]["custom"] = infraction.clone();
        let result = merged(&Plan::lenient(format), &[Some(file(2, &[record]))]).unwrap();
        let text: Value = serde_json::from_str(&result.text).unwrap();
        let kept = &text["_checkpoint"]["records"][0];
        prop_assert_eq!(kept["save_name"].to_string(), extra.to_string());
        prop_assert_eq!(kept["infractions"]["custom"].to_string(), infraction.to_string());
    });
    ran.say("unknown_keys_survive");
}

/// Cuts, bytes and tokens put where they do not belong.
#[derive(Clone, Debug)]
enum Damage {
    Cut(prop::sample::Index),
    Byte(prop::sample::Index, u8),
    Token(prop::sample::Index, &'static str),
    Value(prop::sample::Index, &'static str),
}

const TOKENS: [&str; 16] = [
    "NaN",
    "-Infinity",
    "1e999",
    "[]",
    "{}",
    "null",
    "\"\\ud800\"",
    "-1",
    "1e-320",
    "true",
    "99999999999999999999999",
    "\"RouteScenario_-1_rep\"",
    "{\"a\":1,\"a\":2}",
    "\"<script>\"",
    "1e300",
    "0",
];

fn damage() -> impl Strategy<Value = Damage> {
    let index = any::<prop::sample::Index>;
    let token = || prop::sample::select(TOKENS.to_vec());
    prop_oneof![
        1 => index().prop_map(Damage::Cut),
        2 => (index(), any::<u8>()).prop_map(|(i, byte)| Damage::Byte(i, byte)),
        2 => (index(), token()).prop_map(|(i, token)| Damage::Token(i, token)),
        8 => (index(), token()).prop_map(|(i, token)| Damage::Value(i, token)),
    ]
}

fn damaged(text: &str, damages: &[Damage]) -> Vec<u8> {
    let mut bytes = text.as_bytes().to_vec();
    for damage in damages {
        match damage {
            Damage::Cut(at) => bytes.truncate(at.index(bytes.len() + 1)),
            Damage::Byte(at, byte) if !bytes.is_empty() => {
                let at = at.index(bytes.len());
                bytes[at] = *byte;
            }
            Damage::Byte(..) => {}
            Damage::Token(at, token) => {
                let at = at.index(bytes.len() + 1);
                bytes.splice(at..at, token.bytes());
            }
            // A whole scalar is replaced, so that the file stays JSON.
            Damage::Value(at, token) => {
                let starts: Vec<usize> = (1..bytes.len()).filter(|i| bytes[*i - 1] == b':').collect();
                if starts.is_empty() {
                    continue;
                }
                let start = starts[at.index(starts.len())];
                let end = bytes[start..]
                    .iter()
                    .position(|byte| b",}]".contains(byte))
                    .map_or(bytes.len(), |n| start + n);
                if !matches!(bytes[start], b'{' | b'[') {
                    bytes.splice(start..end, token.bytes());
                }
            }
        }
    }
    bytes
}

/// True if EvalAI's summary holds only texts of closed sets.
fn is_closed(stdout: &str) -> bool {
    let is_number = |text: &str| text.trim_end_matches('x').parse::<f64>().is_ok_and(f64::is_finite);
    stdout
        .lines()
        .all(|line| match line.trim_start_matches([' ', '-']).split_once(": ") {
            Some(("Route ID", id)) => {
                let digits = id
                    .strip_prefix("RouteScenario_")
                    .map(|rest| rest.replacen("_rep", "", 1));
                digits.is_some_and(|digits| digits.bytes().all(|byte| byte.is_ascii_digit()))
            }
            Some(("Status", status)) => ["Perfect", "Started"].contains(&status) || STATUSES.contains(&status),
            Some((_, value)) => is_number(value),
            None => line.chars().all(|c| c.is_ascii_alphanumeric() || " -:.'".contains(c)),
        })
}

#[test]
fn nothing_makes_it_panic_and_a_pod_publishes_closed_sets_only() {
    let ran = Ran::new();
    proptest!(config(512), |(drives in run(1), damages in prop::collection::vec(damage(), 0..4), v1 in any::<bool>())| {
        ran.once();
        let format = if v1 { Format::V1 } else { Format::V2 };
        let bytes = damaged(&finished(format, &drives).to_string(), &damages);
        for as_original in [false, true] {
            let lenient = Plan { as_original, verify: Verify::Warn, ..Plan::lenient(format) };
            let outcome = offline(&lenient, &[Some(bytes.clone()), None]);
            prop_assert!(outcome.is_ok_and(|(merged, _)| !merged.text.is_empty()) || !damages.is_empty());
        }
        let last = u32::try_from(drives.len()).unwrap() - 1;
        let plan = pod(format, 1, &[(0, last)]);
        if let Ok(Some(worker)) = read_worker(&plan, 0, &bytes)
            && let Ok(merged) = merge(&plan, &[Some(&worker)])
        {
            let files = render(&plan, Some(&merged)).unwrap();
            prop_assert!(is_closed(&files.stdout_txt), "{}", files.stdout_txt);
            prop_assert!(numbers(&files.results_json).into_iter().all(f64::is_finite));
        } else {
            prop_assert!(!damages.is_empty());
        }
    });
    ran.say("nothing_makes_it_panic_and_a_pod_publishes_closed_sets_only");
}

#[test]
fn any_bytes_are_read_or_refused() {
    let ran = Ran::new();
    let bytes = prop::collection::vec(any::<u8>(), 0..200);
    let text = "[\\[\\]{}\",:0-9eE.+\\-ntfu \\\\]{0,200}";
    proptest!(config(512), |(bytes in bytes, text in text)| {
        ran.once();
        let plan = Plan::lenient(Format::V2);
        for input in [bytes, text.into_bytes()] {
            let read = read_worker(&plan, 0, &input);
            prop_assert!(!matches!(read, Ok(Some(_))), "no checkpoint is that short");
        }
    });
    ran.say("any_bytes_are_read_or_refused");
}

#[test]
fn a_merge_of_nothing_is_not_final() {
    for format in [Format::V1, Format::V2] {
        let result = merged(&Plan::lenient(format), &[None, Some(file(0, &[]))]).unwrap();
        assert!(!result.is_final);
        assert_eq!((result.done, result.total, result.partial_score), (0, 0, None));
        assert_eq!(json!(result.entry_status), json!("Started"));
    }
}
