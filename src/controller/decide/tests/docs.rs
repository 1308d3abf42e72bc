//! docs/states.md names every reason there is.

const REASONS: &str = include_str!("../../../api/reasons.rs");
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
