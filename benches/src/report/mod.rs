//! Makes the tables and plots of the documentation from the lines of a run. They replace the text between two marks of a document.

mod aims;
mod plots;

use std::fmt::Write as _;
use std::path::Path;

use crate::bench::Outcome;
use crate::record::{Line, read};
use crate::scale;
use crate::stats::{Summary, number};

/// The summary for people who choose, below docs/.
const SUMMARY: &str = "performance.md";
/// Every figure and the machine, below docs/.
const FIGURES: &str = "performance/figures.md";

/// Writes everything that the lines are enough for.
pub fn write(file: &Path, docs: &Path) -> Outcome<()> {
    let lines = read(file)?;
    if lines.is_empty() {
        return Err(format!("{} has no line", file.display()).into());
    }
    let plots = plots::write(&lines, &docs.join("performance"))?;
    let summary = [
        ("aims", aims::table(&lines)),
        ("plots", plots),
        ("simulation", scale::table(&lines)?),
    ];
    fill(&docs.join(SUMMARY), &summary)?;
    fill(
        &docs.join(FIGURES),
        &[("machine", machine(&lines)), ("figures", figures(&lines))],
    )
}

/// Replaces the content of each mark of a document.
fn fill(document: &Path, contents: &[(&str, String)]) -> Outcome<()> {
    let mut text = std::fs::read_to_string(document)?;
    for (mark, content) in contents {
        text = replaced(&text, mark, content)?;
    }
    Ok(std::fs::write(document, text)?)
}

/// The text with another content between two marks.
fn replaced(text: &str, mark: &str, content: &str) -> Outcome<String> {
    let (begin, end) = (format!("<!-- begin {mark} -->\n"), format!("<!-- end {mark} -->"));
    let parts = text
        .split_once(&begin)
        .and_then(|(before, rest)| Some((before, rest.split_once(&end)?.1)));
    let (before, after) = parts.ok_or_else(|| format!("the marks of \"{mark}\" are missing"))?;
    Ok(format!("{before}{begin}{}\n{end}{after}", content.trim_end()))
}

/// The machine of the lines, in words.
fn machine(lines: &[Line]) -> String {
    let mut text = String::new();
    let Some(first) = lines.first() else { return text };
    let machine = &first.machine;
    let day = first.time.get(..10).unwrap_or_default();
    let kind = if first.quick {
        "`make bench-quick`"
    } else {
        "`make bench`"
    };
    let _ = writeln!(
        text,
        "{kind} of {day}: {} cores ({}), {} GiB, Linux {}; operator built with `--profile {}`.",
        machine.cores, machine.processor, machine.memory_gib, machine.kernel, first.profile
    );
    let foreign: Vec<f64> = lines
        .iter()
        .filter_map(|line| line.foreign.as_ref())
        .map(|share| share.median)
        .collect();
    if let Some(share) = Summary::of(&foreign) {
        let _ = writeln!(
            text,
            "Share of all cores that other processes took: median {:.0} % of the cases, {:.0} to {:.0} %.",
            100.0 * share.median,
            100.0 * share.low,
            100.0 * share.high
        );
    }
    if let Some(line) = lines.iter().find(|line| line.scale < 1.0) {
        let _ = writeln!(
            text,
            "**Numbers of submissions at {} of the full size: these figures show nothing.**",
            line.scale
        );
    }
    text
}

/// Every figure of every case.
fn figures(lines: &[Line]) -> String {
    let mut text = String::new();
    for line in lines {
        let _ = writeln!(
            text,
            "### {}\n\n| figure | median | range | runs |\n|---|---:|---:|---:|",
            line.case
        );
        for (name, summary) in &line.figures {
            let range = format!("{} to {}", number(summary.low), number(summary.high));
            let range = if summary.runs.len() > 1 { range } else { String::new() };
            let _ = writeln!(
                text,
                "| {name} | {} | {range} | {} |",
                number(summary.median),
                summary.runs.len()
            );
        }
        for (name, count) in &line.counts {
            let _ = writeln!(text, "| {name} | {} | | 1 |", number(*count));
        }
        for note in &line.notes {
            let _ = writeln!(text, "\nNote: {note}.");
        }
        let _ = writeln!(text);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_is_between_the_marks_changes() {
        let text = "a\n<!-- begin x -->\nold\n<!-- end x -->\nb\n";
        let new = replaced(text, "x", "new\n\n").unwrap();
        assert_eq!(new, "a\n<!-- begin x -->\nnew\n<!-- end x -->\nb\n");
        assert_eq!(replaced(&new, "x", "new").unwrap(), new);
        assert!(replaced(text, "y", "new").is_err());
    }

    #[test]
    fn the_documents_have_their_marks() {
        let docs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs");
        for (file, marks) in [
            (SUMMARY, vec!["aims", "plots", "simulation"]),
            (FIGURES, vec!["machine", "figures"]),
        ] {
            let text = std::fs::read_to_string(docs.join(file)).unwrap();
            for mark in marks {
                replaced(&text, mark, "").unwrap();
            }
        }
    }
}
