//! Cost of one submission, counted where the machine makes no difference: requests to the API server, S3, EvalAI and DynamoDB,
//! reconciles, and allocations. The table is `counts/expected.json`; `UPDATE_COUNTS=1` writes it anew.
//!
//! The whole controller runs on the real API server. Job controller, kubelet and logcopy are played, so that the controller alone decides
//! on each request and write.

pub mod lifecycle;
pub mod rest;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::{env, fs};

use futures::future::{join_all, join3};
use serde::{Deserialize, Serialize};

use lifecycle::Scenario;
use rest::Rest;

const TABLE: &str = "tests/api/counts/expected.json";
const UPDATE: &str = "UPDATE_COUNTS";
/// Tolerated part of each expected count, besides one. Counts that depend on a moment vary, such as reads of a report while a run ends.
const TOLERANCE: f64 = 0.25;
/// On a busy machine a write can be refused as a conflict and sent again. A real change is there each time.
const TRIES: usize = 3;

/// Cost of one submission from its creation until its end causes no further request.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct Cost {
    /// Requests to the API server by verb and resource. Watches, the Lease and questions after rights are the process's own.
    pub writes: BTreeMap<String, u64>,
    /// Writes of its Leaderboard's counts, which all submissions share: at most one in five seconds.
    pub leaderboard_writes: BTreeMap<String, u64>,
    pub reads: BTreeMap<String, u64>,
    pub s3_requests: u64,
    /// About the submission itself: the lists of EvalAI are one for all.
    pub evalai_requests: u64,
    pub table_requests: u64,
    pub reconciles: u64,
    pub allocations: u64,
    pub allocated_kilobytes: u64,
}

/// The whole table.
#[derive(Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
struct Table {
    lifecycles: BTreeMap<String, Cost>,
    /// A minute in which nothing is new.
    minutes_at_rest: BTreeMap<String, Rest>,
}

fn path() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(TABLE)
}

fn expected() -> Table {
    serde_json::from_str(&fs::read_to_string(path()).unwrap()).unwrap()
}

#[test]
fn a_hosts_own_evaluator_costs_the_same_writes_as_carla() {
    let table = expected();
    let writes = |of: Scenario| &table.lifecycles[of.name].writes;
    for evaluated in Scenario::EVALUATED {
        assert_eq!(writes(evaluated), writes(Scenario::PUBLISHED), "{}", evaluated.name);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_submission_costs_what_the_table_expects() {
    if env::var_os(UPDATE).is_some() {
        return fs::write(path(), text(&measured().await)).unwrap();
    }
    let expected = expected();
    let mut found = Vec::new();
    for _ in 0..TRIES {
        found = differences(&expected, &measured().await);
        if found.is_empty() {
            return;
        }
        println!("{}", found.join("\n"));
    }
    panic!(
        "what a submission costs has changed; if it should, {UPDATE}=1 writes {TABLE} anew:\n{}",
        found.join("\n")
    );
}

async fn measured() -> Table {
    let lifecycles =
        join_all(Scenario::ALL.map(async |scenario| (scenario.name.to_owned(), Box::pin(scenario.cost()).await)));
    let (lifecycles, live, refused) = join3(
        lifecycles,
        Box::pin(rest::of_live_runs()),
        Box::pin(rest::of_refused_jobs()),
    )
    .await;
    let rests = [("4 live runs", live), ("4 Jobs refused by a quota", refused)];
    let table = Table {
        lifecycles: lifecycles.into_iter().collect(),
        minutes_at_rest: rests.map(|(what, rest)| (what.to_owned(), rest)).into(),
    };
    println!("{}", text(&table));
    table
}

fn text(table: &Table) -> String {
    serde_json::to_string_pretty(table).unwrap() + "\n"
}

fn differences(expected: &Table, seen: &Table) -> Vec<String> {
    let mut found = Vec::new();
    let names = |table: &Table| table.lifecycles.keys().cloned().collect::<Vec<_>>();
    if names(expected) != names(seen) {
        found.push(format!("lifecycles: {:?}, expected {:?}", names(seen), names(expected)));
    }
    for (name, cost) in &seen.lifecycles {
        let expected = expected.lifecycles.get(name).cloned().unwrap_or_default();
        if expected.writes != cost.writes {
            let (before, now): (u64, u64) = (expected.writes.values().sum(), cost.writes.values().sum());
            found.push(format!(
                "{name}: {now} writes {:?}, expected {before} {:?}",
                cost.writes, expected.writes
            ));
        }
        for (what, expected, seen) in [
            (
                "writes of the Leaderboard's counts",
                expected.leaderboard_writes.values().sum(),
                cost.leaderboard_writes.values().sum(),
            ),
            ("reads", expected.reads.values().sum(), cost.reads.values().sum()),
            ("S3 requests", expected.s3_requests, cost.s3_requests),
            ("EvalAI requests", expected.evalai_requests, cost.evalai_requests),
            ("DynamoDB requests", expected.table_requests, cost.table_requests),
            ("reconciles", expected.reconciles, cost.reconciles),
            ("allocations", expected.allocations, cost.allocations),
            (
                "kilobytes allocated",
                expected.allocated_kilobytes,
                cost.allocated_kilobytes,
            ),
        ] {
            found.extend(differs(expected, seen).then(|| format!("{name}: {seen} {what}, expected {expected}")));
        }
    }
    found.extend(unrest(&expected.minutes_at_rest, &seen.minutes_at_rest));
    found
}

/// Differences of a minute at rest from the expected one, a sentence each. A Leaderboard's own looks may fall into that minute.
fn unrest(expected: &BTreeMap<String, Rest>, seen: &BTreeMap<String, Rest>) -> Vec<String> {
    let sum = |requests: &BTreeMap<String, u64>| requests.values().sum();
    let mut found = Vec::new();
    for (name, rest) in seen {
        let expected = expected.get(name).cloned().unwrap_or_default();
        for (what, expected, seen) in [
            ("writes", sum(&expected.writes), sum(&rest.writes)),
            ("reads", sum(&expected.reads), sum(&rest.reads)),
            ("S3 requests", expected.s3_requests, rest.s3_requests),
            ("reconciles", expected.reconciles, rest.reconciles),
        ] {
            let text = || format!("a minute with {name}: {seen} {what}, expected {expected}: {rest:?}");
            found.extend(differs(expected, seen).then(text));
        }
    }
    found
}

#[allow(clippy::cast_precision_loss, reason = "no count comes near 2^52")]
fn differs(expected: u64, seen: u64) -> bool {
    let allowed = (expected as f64 * TOLERANCE).max(1.0);
    expected.abs_diff(seen) as f64 > allowed
}

#[test]
fn exact_numbers_must_be_met_and_others_nearly() {
    let cost = |events: u64, allocations: u64| Cost {
        writes: [("create events".to_owned(), events)].into(),
        allocations,
        ..Cost::default()
    };
    let table = |cost| Table {
        lifecycles: [("local".to_owned(), cost)].into(),
        ..Table::default()
    };
    let expected = table(cost(4, 1000));
    assert!(differences(&expected, &table(cost(4, 1200))).is_empty());
    let found = differences(&expected, &table(cost(5, 1300)));
    assert_eq!(
        found,
        [
            r#"local: 5 writes {"create events": 5}, expected 4 {"create events": 4}"#,
            "local: 1300 allocations, expected 1000",
        ]
    );
    assert_eq!(differences(&Table::default(), &expected).len(), 3);
    let at_rest = |s3_requests: u64, reads: u64| Table {
        minutes_at_rest: [(
            "4 live runs".to_owned(),
            Rest {
                reads: [("list events".to_owned(), reads)].into(),
                s3_requests,
                ..Rest::default()
            },
        )]
        .into(),
        ..Table::default()
    };
    assert!(differences(&at_rest(24, 0), &at_rest(26, 1)).is_empty());
    assert_eq!(differences(&at_rest(24, 0), &at_rest(48, 4)).len(), 2);
}
