//! `leaderboard-operator results` as a process: the files it writes, its exit code, its words.
#![allow(clippy::unwrap_used, reason = "the helpers of a test may fail it")]

use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use tempfile::TempDir;

const FILES: [&str; 4] = ["agent_results.json", "results.json", "stdout.txt", "metadata.json"];

fn cases() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("crates/results/tests/cases")
}

/// The four files of a case, absent ones too.
fn inputs(case: &str) -> Vec<PathBuf> {
    (1..=4)
        .map(|i| cases().join(case).join(format!("in{i}.json")))
        .collect()
}

fn results(format: &str, out: &Path, flags: &[&str], inputs: &[PathBuf]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_leaderboard-operator"))
        .args(["results", "--format", format, "--out"])
        .arg(out)
        .args(flags)
        .args(inputs)
        .output()
        .unwrap()
}

fn stderr(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).unwrap()
}

fn stdout(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).unwrap()
}

fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).into_iter().flatten();
    let mut names: Vec<String> = entries
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    names
}

fn contents(folder: &Path) -> Vec<Vec<u8>> {
    FILES.iter().map(|name| fs::read(folder.join(name)).unwrap()).collect()
}

/// A folder with the good files of case01.
fn good(format: &str) -> (TempDir, Vec<Vec<u8>>) {
    let folder = tempfile::tempdir().unwrap();
    let output = results(format, folder.path(), &[], &inputs(&format!("{format}/case01")));
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let before = contents(folder.path());
    (folder, before)
}

/// Exit code and words of a run that must leave the good files as they are.
fn leaves_all(format: &str, flags: &[&str], inputs: &[PathBuf], code: i32) -> String {
    let (folder, before) = good(format);
    let output = results(format, folder.path(), flags, inputs);
    assert_eq!(output.status.code(), Some(code), "{}", stderr(&output));
    assert_eq!(stdout(&output), "");
    assert_eq!(contents(folder.path()), before);
    assert_eq!(names(folder.path()).len(), FILES.len(), "nothing is left behind");
    stderr(&output)
}

/// Compares output with its file in `tests/results_command`. UPDATE_GOLDEN=1 writes it; read the difference then.
fn assert_said(name: &str, said: &[(&str, String)]) {
    let cases = cases().display().to_string();
    let text = said.iter().map(|(what, said)| format!("=== {what}\n{said}"));
    let text = text.collect::<String>().replace(&cases, "CASES");
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/results_command/{name}.txt"));
    if std::env::var_os("UPDATE_GOLDEN").is_some() {
        return fs::write(file, text).unwrap();
    }
    let known = fs::read_to_string(file).unwrap_or_default();
    assert_eq!(text, known, "{name}: set UPDATE_GOLDEN=1 and read the difference");
}

#[test]
fn every_normal_case_gives_the_originals_files() {
    let index = fs::read_to_string(cases().join("index.tsv")).unwrap();
    let (mut written, mut refused) = (0, 0);
    for line in index.lines().filter(|line| line.contains("\tnormal\t")) {
        let columns: Vec<&str> = line.split('\t').collect();
        let case = format!("{}/{}", columns[0], columns[1]);
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("made/for/it");
        let output = results(columns[0], &out, &["--as-original"], &inputs(&case));
        if columns[6].contains("merge:") {
            assert_eq!(output.status.code(), Some(2), "{case}");
            assert_eq!(names(&out), [""; 0], "{case}");
            refused += 1;
            continue;
        }
        assert_eq!(output.status.code(), Some(0), "{case}: {}", stderr(&output));
        let original = ["merged.json", "results.json", "stdout.txt", "merged.json"];
        for (name, original) in FILES.iter().zip(original) {
            let expected = fs::read_to_string(cases().join(&case).join(original)).unwrap();
            assert_eq!(fs::read_to_string(out.join(name)).unwrap(), expected, "{case} {name}");
        }
        assert_eq!(names(&out).len(), FILES.len(), "{case}");
        written += 1;
    }
    // Written past the harness, which hides the output of a passing test. A lost line is no fault.
    let words = format!("results command: {written} normal cases equal, {refused} refused as by the original\n");
    let _ = std::io::stderr().write_all(words.as_bytes());
    assert_eq!((written, refused), (48, 6));
}

#[test]
fn an_absent_file_is_named_and_allowed() {
    let folder = tempfile::tempdir().unwrap();
    let output = results("v2", folder.path(), &[], &inputs("v2/case05"));
    assert_eq!(output.status.code(), Some(0));
    assert_said("absent", &[("v2/case05", stderr(&output))]);
    assert_eq!(names(folder.path()).len(), FILES.len());
}

#[test]
fn a_refusal_keeps_what_was_good() {
    let cases = ["v1/case14", "v2/case17", "v2/case19", "v2/case30", "v1/case24"];
    let said = cases.map(|case| (case, leaves_all(&case[..2], &[], &inputs(case), 2)));
    for (case, said) in &said {
        assert_eq!(said.lines().count(), 1, "{case}: {said}");
        assert!(said.trim_end().ends_with('.'), "with a next step: {said}");
    }
    assert_said("refusals", &said);
}

#[test]
fn workers_and_routes_make_a_missing_worker_not_final() {
    let three = inputs("v2/case05");
    let folder = tempfile::tempdir().unwrap();
    let output = results("v2", folder.path(), &[], &three);
    assert!(stdout(&output).contains(", final\n") && stdout(&output).starts_with("6 of 6 routes, "));

    let flags = ["--workers", "4", "--routes", "8"];
    let output = results("v2", folder.path(), &flags, &three);
    assert!(stdout(&output).contains(", not final\n"));
    let summary = fs::read_to_string(folder.path().join("stdout.txt")).unwrap();
    let said = [
        ("printed", stdout(&output)),
        ("said", stderr(&output)),
        ("stdout.txt", summary),
    ];
    assert_said("worker-missing", &said);

    let flags = ["--workers", "4", "--routes", "8", "--as-original"];
    let output = results("v2", folder.path(), &flags, &three);
    assert!(stdout(&output).contains(", final\n"), "the original believes the files");
}

#[test]
fn slices_of_a_hosts_own_are_final_and_the_operators_show_which_worker_differs() {
    let folder = tempfile::tempdir().unwrap();
    let three = &inputs("v2/case05")[..3];
    // Two routes each, and the plan of another split.
    let flags = ["--slices", "0-1,2-3,4-5"];
    let output = results("v2", folder.path(), &flags, three);
    assert!(
        stdout(&output).ends_with(", final\n"),
        "{}{}",
        stdout(&output),
        stderr(&output)
    );
    assert_eq!(stderr(&output), "");

    let output = results("v2", folder.path(), &["--slices", "0-2,3-4,5-5"], three);
    assert!(stdout(&output).contains(", not final\n"));
    assert_said("slices", &[("printed", stdout(&output)), ("said", stderr(&output))]);
}

#[test]
fn files_that_lost_their_sensors_are_the_originals_and_count() {
    let folder = tempfile::tempdir().unwrap();
    let real = cases().join("../restarted/done");
    let files: Vec<PathBuf> = (1..=4).map(|i| real.join(format!("in{i}.json"))).collect();
    let output = results("v2", folder.path(), &["--workers", "4", "--routes", "16"], &files);
    assert_said("sensors", &[("printed", stdout(&output)), ("said", stderr(&output))]);
    let merged = fs::read(folder.path().join("agent_results.json")).unwrap();
    assert!(merged == fs::read(real.join("merged.json")).unwrap(), "it differs");
}

#[test]
fn as_original_keeps_its_mistakes() {
    let folder = tempfile::tempdir().unwrap();
    let status = |flags: &[&str]| -> String {
        let output = results("v1", folder.path(), flags, &inputs("v1/case02"));
        assert_eq!(output.status.code(), Some(0));
        let merged: serde_json::Value =
            serde_json::from_slice(&fs::read(folder.path().join("agent_results.json")).unwrap()).unwrap();
        merged["_checkpoint"]["global_record"]["status"]
            .as_str()
            .unwrap()
            .to_owned()
    };
    assert_eq!(status(&[]), "Completed");
    assert_eq!(status(&["--as-original"]), "Failed");
}

#[test]
fn scores_that_do_not_follow_are_reported_or_refused() {
    let folder = tempfile::tempdir().unwrap();
    let case = inputs("v2/case25");
    let told = |flags: &[&str]| stderr(&results("v2", folder.path(), flags, &case));
    assert!(told(&[]).lines().all(|line| line.starts_with("warning: pair ")) && !told(&[]).is_empty());
    assert_eq!(told(&["--verify", "disabled"]), "");
    let refused = leaves_all("v2", &["--verify", "refuse"], &case, 2);
    assert_said("scores", &[("warned", told(&[])), ("refused", refused)]);
}

#[test]
fn arguments_that_can_not_be_meant_are_refused() {
    let four = inputs("v2/case01");
    let flags = [
        "--workers 3 --routes 20",
        "--workers 4 --routes 3",
        "--workers 4 --routes 20 --repetitions 0",
        "--workers 4",
        "--repetitions 2",
        "--slices 0-4,5-9",
        "--slices 0-4,5,6-7,8-9",
        "--slices 0-4,4-9,10-14,15-19",
        "--slices 0-4,5-9,10-14,15-19 --workers 4",
        "--verify maybe",
    ];
    let said = flags.map(|flags| {
        let words: Vec<&str> = flags.split(' ').collect();
        (flags, leaves_all("v2", &words, &four, 2))
    });
    assert_said("arguments", &said);
}

#[test]
fn files_that_are_none_are_refused_without_being_read_whole() {
    let folder = tempfile::tempdir().unwrap();
    let large = folder.path().join("large.json");
    fs::File::create(&large).unwrap().set_len(10 << 30).unwrap();
    let folder = folder.path().to_owned();
    let place = folder.display().to_string();
    let said = [
        ("10 GiB", leaves_all("v2", &[], &[large], 2)),
        (
            "a folder",
            leaves_all("v2", &[], &[folder], 1).replace(&place, "FOLDER"),
        ),
    ];
    assert_said("no-files", &said);
}

/// All four files or none of them, even when it is the last that can't be written.
#[test]
fn a_file_that_can_not_be_written_leaves_the_others_as_they_were() {
    for blocked in FILES {
        let (folder, before) = good("v1");
        let place = folder.path().join(blocked);
        fs::remove_file(&place).unwrap();
        fs::create_dir(&place).unwrap();
        let output = results("v1", folder.path(), &[], &inputs("v1/case13"));
        assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
        assert!(
            stderr(&output).contains(&format!("{blocked} can't be written")),
            "{}",
            stderr(&output)
        );
        for (name, before) in FILES.iter().zip(&before).filter(|(name, _)| **name != blocked) {
            assert_eq!(&fs::read(folder.path().join(name)).unwrap(), before, "{name}");
        }
        assert_eq!(names(folder.path()).len(), FILES.len(), "nothing is left behind");
    }
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("file");
    fs::write(&file, "").unwrap();
    let output = results("v1", &file, &[], &inputs("v1/case01"));
    assert_eq!(output.status.code(), Some(1));
    assert!(stderr(&output).contains("can't be made"), "{}", stderr(&output));
}
