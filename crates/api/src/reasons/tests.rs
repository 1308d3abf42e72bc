//! Rules for every row of the table, and for the tables of docs/states.md that are made from it.

use std::fmt::Write as _;

use super::*;

const STATES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/states.md");
const CLASSES: [Class; 11] = [
    Class::Pending,
    Class::Running,
    Class::End,
    Class::Participant,
    Class::Infrastructure,
    Class::System,
    Class::Scores,
    Class::CloudWatch,
    Class::Event,
    Class::Leaderboard,
    Class::Isolation,
];

/// `make docs` sets UPDATE_DOCS: the tables are then written, not compared.
#[test]
fn the_tables_of_the_documentation_are_generated() {
    let found = std::fs::read_to_string(STATES).unwrap();
    let mut wanted = found.clone();
    for class in CLASSES {
        wanted = with_section(&wanted, &format!("{class:?}"), &rows_of(class));
    }
    wanted = with_section(&wanted, "Logs", &logs());
    if std::env::var_os("UPDATE_DOCS").is_some() {
        std::fs::write(STATES, &wanted).unwrap();
        return;
    }
    assert!(
        found == wanted,
        "docs/states.md does not show the table of reasons: run `make docs`"
    );
}

/// The document with what lies between the marks of a section replaced.
fn with_section(text: &str, name: &str, table: &str) -> String {
    let start = format!("<!-- generated from crates/api/src/reasons.rs: {name} -->\n");
    let (before, rest) = text
        .split_once(&start)
        .unwrap_or_else(|| panic!("docs/states.md lacks {start}"));
    let (_, after) = rest.split_once("<!-- end -->").expect("each section has an end");
    format!("{before}{start}\n{table}\n<!-- end -->{after}")
}

fn rows_of(class: Class) -> String {
    let mut table = String::from("| reason | meaning | next step |\n|---|---|---|\n");
    for reason in Reason::ALL.into_iter().filter(|reason| reason.class() == class) {
        let (meaning, next_step) = (reason.meaning(), reason.next_step());
        let after = reason
            .own_after_failure()
            .map(|step| format!(" Once it has failed: {step}"));
        let after = after.unwrap_or_default();
        writeln!(
            table,
            "{}",
            linked(&format!("| `{reason}` | {meaning} | {next_step}{after} |"))
        )
        .unwrap();
    }
    table
}

/// A row whose pages are links.
fn linked(row: &str) -> String {
    let mut parts = row.split("docs/");
    let mut linked = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        let (page, rest) = part.split_once(".md").expect("a page");
        write!(linked, "[{page}.md]({page}.md){rest}").unwrap();
    }
    linked
}

/// Whose log explains which failures.
fn logs() -> String {
    let mut table = String::from("| whose log | failures |\n|---|---|\n");
    let mut logs: Vec<&str> = Vec::new();
    for log in Reason::ALL.into_iter().filter_map(Reason::log) {
        if !logs.contains(&log) {
            logs.push(log);
        }
    }
    for log in logs {
        let names = Reason::ALL.into_iter().filter(|reason| reason.log() == Some(log));
        let names: Vec<String> = names.map(|reason| format!("`{reason}`")).collect();
        writeln!(table, "| {log} | {} |", names.join(", ")).unwrap();
    }
    table.push_str("| none: nothing has run, or the message explains it all | all others |\n");
    table
}

#[test]
fn every_reason_is_explained_in_sentences() {
    for reason in Reason::ALL {
        for text in [reason.meaning(), reason.next_step(), reason.after_failure()] {
            assert!(text.ends_with('.'), "{reason}: {text}");
            assert!(!text.contains(['|', '[', '\n']), "{reason}: {text}");
            assert_eq!(text.matches('`').count() % 2, 0, "{reason}: {text}");
            assert!(!plain(text).contains('`'));
        }
    }
}

#[test]
fn every_name_is_as_kubernetes_writes_reasons_and_leads_back() {
    for reason in Reason::ALL {
        let name = reason.as_str();
        assert!(name.starts_with(|c: char| c.is_ascii_uppercase()), "{name}");
        assert!(name.chars().all(|c| c.is_ascii_alphanumeric()), "{name}");
        assert!(name.len() <= 64, "{name}");
        assert_eq!(Reason::of(name), Some(reason));
    }
    assert_eq!(Reason::of("NoSuchReason"), None);
}

#[test]
fn only_a_failure_has_a_log() {
    for reason in Reason::ALL.into_iter().filter(|reason| reason.log().is_some()) {
        assert!(
            matches!(reason.class(), Class::Participant | Class::Infrastructure),
            "{reason}"
        );
    }
}

#[test]
fn the_step_after_a_failure_is_that_of_the_reason_unless_it_has_another() {
    assert_eq!(
        Reason::NodeLost.after_failure(),
        "Look at the node, then resume the submission."
    );
    assert_eq!(
        Reason::ImagePull.after_failure(),
        "Fix this, then resume the submission."
    );
}
