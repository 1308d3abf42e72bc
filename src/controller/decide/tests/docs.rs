//! docs/states.md names every reason there is.

const REASONS: &str = include_str!("../../../../crates/api/src/reasons.rs");
const STATES: &str = include_str!("../../../../docs/states.md");

/// The values of the constants in `api::reasons`.
fn reasons() -> Vec<&'static str> {
    let lines = REASONS.lines().filter(|line| line.starts_with("pub const "));
    lines.map(|line| line.split('"').nth(1).unwrap()).collect()
}

#[test]
fn every_reason_is_explained() {
    let known = reasons();
    assert!(known.len() > 50, "the constants were not found");
    for reason in known {
        let row = STATES.lines().find(|line| line.starts_with(&format!("| `{reason}` |")));
        let row = row.unwrap_or_else(|| panic!("docs/states.md has no row for {reason}"));
        let cells = row.split('|').map(str::trim).filter(|cell| !cell.is_empty()).count();
        assert_eq!(cells, 3, "{reason} needs a meaning and a next step: {row}");
    }
}

#[test]
fn every_explained_reason_exists() {
    let known = reasons();
    let rows = STATES
        .lines()
        .filter_map(|line| line.strip_prefix("| `")?.split('`').next());
    for reason in rows {
        assert!(
            known.contains(&reason),
            "docs/states.md explains {reason}, which nobody gives"
        );
    }
}

/// The constants below a comment of `api::reasons`, up to the next empty line.
fn group(comment: &str) -> Vec<&'static str> {
    let (_, rest) = REASONS.split_once(comment).unwrap();
    let lines = rest.lines().take_while(|line| !line.is_empty());
    lines
        .filter_map(|line| line.strip_prefix("pub const ")?.split('"').nth(1))
        .collect()
}

/// The rows below a heading of docs/states.md.
fn section(heading: &str) -> Vec<&'static str> {
    let (_, rest) = STATES.split_once(heading).unwrap();
    let (text, _) = rest.split_once("\n## ").unwrap();
    let rows = text
        .lines()
        .filter_map(|line| line.strip_prefix("| `")?.split('`').next());
    rows.collect()
}

#[test]
fn a_failures_class_is_that_of_its_section() {
    for (comment, heading) in [
        (
            "// Failures of the participant.\n",
            "## Failures of the participant (charged)\n",
        ),
        (
            "// Failures of the infrastructure.\n",
            "## Failures of the infrastructure (never charged)\n",
        ),
    ] {
        let (mut known, mut told) = (group(comment), section(heading));
        assert!(known.len() >= 8, "{comment}{known:?}");
        known.sort_unstable();
        told.sort_unstable();
        assert_eq!(known, told, "{heading}");
    }
}
