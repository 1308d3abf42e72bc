//! Every stored case against what the original made of it: merged.json, results.json and stdout.txt.
#![allow(clippy::unwrap_used, reason = "the helpers of a test may fail it")]

mod common;

use std::fs;
use std::path::{Path, PathBuf};

use common::{assert_refusals, say};

use leaderboard_results::{Files, Format, Merged, Outcome, Plan, Refusal, offline, read_worker, render};

struct Case {
    format: Format,
    name: String,
    is_normal: bool,
    dir: PathBuf,
}

impl Case {
    fn inputs(&self) -> Vec<Option<Vec<u8>>> {
        (1..=4)
            .map(|i| fs::read(self.dir.join(format!("in{i}.json"))).ok())
            .collect()
    }

    fn expected(&self, file: &str) -> Option<String> {
        fs::read_to_string(self.dir.join(file)).ok()
    }

    /// True if the original failed, and in which step.
    fn failed(&self, step: &str) -> bool {
        self.expected("expected_error.txt")
            .is_some_and(|text| text.lines().any(|line| line.starts_with(step)))
    }

    fn plan(&self, as_original: bool) -> Plan {
        Plan {
            as_original,
            ..Plan::lenient(self.format)
        }
    }
}

fn cases() -> Vec<Case> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/cases");
    let index = fs::read_to_string(root.join("index.tsv")).unwrap();
    let case = |line: &str| {
        let columns: Vec<&str> = line.split('\t').collect();
        Case {
            format: if columns[0] == "v1" { Format::V1 } else { Format::V2 },
            name: format!("{}/{}", columns[0], columns[1]),
            is_normal: columns[2] == "normal",
            dir: root.join(columns[0]).join(columns[1]),
        }
    };
    index.lines().skip(1).map(case).collect()
}

fn run(case: &Case, as_original: bool) -> Result<(Merged, Files), Refusal> {
    offline(&case.plan(as_original), &case.inputs())
}

fn count(cases: &[Case], format: Format, is_normal: bool) -> usize {
    cases
        .iter()
        .filter(|case| case.format == format && case.is_normal == is_normal)
        .count()
}

/// Texts of a case: merged.json (absent if the merge fails), results.json, stdout.txt.
fn texts(case: &Case, as_original: bool) -> [Option<String>; 3] {
    match run(case, as_original) {
        Ok((merged, files)) => {
            assert_eq!(files.metadata_json.as_ref(), Some(&merged.text), "{}", case.name);
            [Some(merged.text), Some(files.results_json), Some(files.stdout_txt)]
        }
        // The original's loop goes on to render nothing.
        Err(refusal) => {
            assert!(case.failed("merge"), "{}: {refusal}", case.name);
            let files = render(&case.plan(as_original), None).unwrap();
            [None, Some(files.results_json), Some(files.stdout_txt)]
        }
    }
}

#[test]
fn normal_cases_are_the_originals_byte_for_byte() {
    const FILES: [&str; 3] = ["merged.json", "results.json", "stdout.txt"];
    let cases = cases();
    for format in [Format::V1, Format::V2] {
        let mut equal = [0; 3];
        let mut differing = Vec::new();
        let normal: Vec<&Case> = cases.iter().filter(|c| c.is_normal && c.format == format).collect();
        for case in &normal {
            for ((file, text), equal) in FILES.iter().zip(texts(case, true)).zip(&mut equal) {
                if text == case.expected(file) {
                    *equal += 1;
                } else {
                    differing.push(format!("{} {file}", case.name));
                }
            }
        }
        let refused = normal.iter().filter(|case| run(case, true).is_err()).count();
        let ([merged, results, stdout], total) = (equal, normal.len());
        say(&format!(
            "differential {format:?}: merged {merged}/{total}, results {results}/{total}, stdout {stdout}/{total} equal to the \
             byte; {refused} of them refused, as by the original"
        ));
        assert_eq!(differing, [""; 0]);
        assert_eq!((total, refused), (27, if format == Format::V1 { 1 } else { 5 }));
    }
}

/// Without `as_original` only the documented parts of V1's merged file may differ.
#[test]
fn deliberate_differences_are_where_they_are_documented() {
    let (mut equal, mut differing) = (0, 0);
    for case in cases().iter().filter(|case| case.is_normal && !case.failed("merge")) {
        let name = &case.name;
        let (merged, files) = run(case, false).unwrap();
        assert_eq!(Some(files.results_json), case.expected("results.json"), "{name}");
        assert_eq!(Some(files.stdout_txt), case.expected("stdout.txt"), "{name}");
        let original = case.expected("merged.json").unwrap();
        differing += usize::from(merged.text != original);
        equal += usize::from(merged.text == original);
        if case.format == Format::V2 {
            assert_eq!(merged.text, original, "{name}");
        } else {
            assert_eq!(
                without_differences(&merged.text),
                without_differences(&original),
                "{name}"
            );
        }
    }
    say(&format!(
        "differential, as published: {equal} merged files equal, {differing} of V1 differ in status, exceptions or eligible only"
    ));
    assert!(differing > 0);
}

fn without_differences(text: &str) -> serde_json::Value {
    let mut value: serde_json::Value = serde_json::from_str(text).unwrap();
    value["eligible"] = serde_json::Value::Null;
    if let Some(global) = value["_checkpoint"]["global_record"]
        .as_object_mut()
        .filter(|global| !global.is_empty())
    {
        global.remove("status");
        global["meta"].as_object_mut().unwrap().remove("exceptions");
    }
    value
}

#[test]
fn computed_statuses_of_v1() {
    let find = |name: &str| cases().into_iter().find(|case| case.name == name).unwrap();
    let global = |case: &Case, as_original| -> serde_json::Value {
        let (merged, _) = run(case, as_original).unwrap();
        serde_json::from_str::<serde_json::Value>(&merged.text).unwrap()["_checkpoint"]["global_record"].clone()
    };
    let perfect = find("v1/case02");
    assert_eq!(global(&perfect, false)["status"], "Completed");
    assert_eq!(global(&perfect, false)["meta"].get("exceptions"), None);
    assert_eq!(global(&perfect, true)["status"], "Failed");
    assert_eq!(
        global(&perfect, true)["meta"]["exceptions"].as_array().unwrap().len(),
        4
    );

    let mixed = find("v1/case01");
    assert_eq!(global(&mixed, false)["status"], "Failed");
    assert_eq!(global(&mixed, false)["meta"]["exceptions"][0][0], "RouteScenario_1");

    for (case, outcome) in [("v1/case11", Outcome::Crashed), ("v1/case12", Outcome::Rejected)] {
        let (merged, _) = run(&find(case), false).unwrap();
        assert_eq!((merged.eligible, merged.outcome), (false, outcome));
        assert!(run(&find(case), true).unwrap().0.eligible);
    }
}

/// Outcome of each hostile case, for people to read and for the test to hold still.
#[test]
fn hostile_cases_are_refused_or_have_a_known_outcome() {
    let cases = cases();
    let mut refused = Vec::new();
    let mut merged = Vec::new();
    for case in cases.iter().filter(|case| !case.is_normal) {
        match run(case, false) {
            Err(refusal) => refused.push((case.name.as_str(), refusal.to_string())),
            Ok((result, files)) => {
                assert!(
                    !case.failed("merge") && !case.failed("stdout"),
                    "{}: the original fails",
                    case.name
                );
                assert_eq!(Some(files.stdout_txt), case.expected("stdout.txt"), "{}", case.name);
                assert_eq!(Some(files.results_json), case.expected("results.json"), "{}", case.name);
                if case.format == Format::V2 {
                    assert_eq!(Some(result.text), case.expected("merged.json"), "{}", case.name);
                }
                merged.push(case.name.as_str());
            }
        }
    }
    say(&format!(
        "hostile: {} cases refused, {} merged as by the original",
        refused.len(),
        merged.len()
    ));
    for (name, why) in &refused {
        println!("  {name}: {why}");
    }
    let [v1, v2] = [Format::V1, Format::V2].map(|format| count(&cases, format, false));
    assert_eq!((v1, v2), (14, 14));
    for case in cases
        .iter()
        .filter(|case| !case.is_normal && (case.failed("merge") || case.failed("stdout:")))
    {
        assert!(refused.iter().any(|(name, _)| *name == case.name), "{}", case.name);
    }
}

/// A pod publishes what it reads, so it takes less.
#[test]
fn a_pod_refuses_what_must_not_be_published() {
    let names = [
        "v2/case16",
        "v2/case27",
        "v2/case28",
        "v2/case34",
        "v2/case38",
        "v1/case24",
        "v1/case27",
        "v1/case34",
        "v1/case37",
    ];
    let refusals = names.map(|name| {
        let case = cases().into_iter().find(|case| case.name == name).unwrap();
        let plan = Plan {
            strictness: leaderboard_results::Strictness::Pod,
            ..case.plan(false)
        };
        let refusal = offline(&plan, &case.inputs()).err();
        (
            name.to_owned(),
            refusal.unwrap_or_else(|| panic!("{name} is not refused")),
        )
    });
    assert_refusals("cases", &refusals);
}

#[test]
fn nothing_merged_yet_renders_as_the_original_renders_it() {
    for case in cases().iter().filter(|case| case.expected("merged.json").is_none()) {
        let files = render(&case.plan(false), None).unwrap();
        assert_eq!(Some(files.results_json), case.expected("results.json"), "{}", case.name);
        assert_eq!(Some(files.stdout_txt), case.expected("stdout.txt"), "{}", case.name);
        assert_eq!(files.metadata_json, None);
    }
}

/// A file cut anywhere is no file, not an error: it is being written.
#[test]
fn a_half_written_file_counts_as_none() {
    for name in ["v1/case01", "v2/case01", "v2/case34"] {
        let case = cases().into_iter().find(|case| case.name == name).unwrap();
        let whole = case.inputs()[1].clone().unwrap();
        for end in 0..whole.len() {
            let read = read_worker(&case.plan(false), 1, &whole[..end]);
            assert!(matches!(read, Ok(None)), "{name} cut at {end}");
        }
        assert!(
            read_worker(&case.plan(false), 1, &whole)
                .unwrap()
                .is_some_and(|read| read.done() > 0)
        );
    }
}
