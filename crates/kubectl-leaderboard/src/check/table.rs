//! The findings of a check as a table, and whether it passed. Pure.

use super::finding::{Finding, Mark};
use crate::text::{WIDTH, clean, wrap};

/// Columns before a finding.
const INDENT: usize = 17;

/// How a check came out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Outcome {
    pub has_passed: bool,
}

impl Outcome {
    /// A check passes if nothing is broken and its run has come to its end.
    pub fn of(findings: &[Finding], has_finished: bool) -> Self {
        let is_broken = findings.iter().any(|finding| finding.mark == Mark::Broken);
        Self {
            has_passed: has_finished && !is_broken,
        }
    }
}

/// The table.
pub fn lines(findings: &[Finding], outcome: Outcome) -> Vec<String> {
    let mut lines: Vec<String> = findings.iter().flat_map(row).collect();
    lines.push(String::new());
    lines.push(verdict(findings, outcome));
    lines
}

fn row(finding: &Finding) -> Vec<String> {
    let mark = match finding.mark {
        Mark::Works => '✔',
        Mark::Broken => '✘',
        Mark::Note => '!',
        Mark::Open => '–',
    };
    let mut texts = wrap(&finding.found, WIDTH - INDENT);
    if texts.is_empty() {
        texts.push(String::new());
    }
    let step = finding
        .step
        .iter()
        .flat_map(|step| wrap(&format!("→ {step}"), WIDTH - INDENT));
    let commands = finding.commands.iter().map(|command| format!("  {}", clean(command)));
    let mut label = format!("{mark} {}", finding.part.title());
    let all = texts.into_iter().chain(step).chain(commands);
    all.map(|text| {
        let line = format!("{label:<INDENT$}{text}");
        label.clear();
        line.trim_end().to_owned()
    })
    .collect()
}

fn verdict(findings: &[Finding], outcome: Outcome) -> String {
    let count = |mark: Mark| findings.iter().filter(|finding| finding.mark == mark).count();
    if outcome.has_passed {
        return match count(Mark::Note) {
            0 => "The check passed.".to_owned(),
            1 => "The check passed, with 1 note (!).".to_owned(),
            notes => format!("The check passed, with {notes} notes (!)."),
        };
    }
    match count(Mark::Broken) {
        0 => "The check did not pass.".to_owned(),
        1 => "The check failed: 1 part is broken (✘). Parts that were not reached may be broken, too.".to_owned(),
        broken => {
            format!("The check failed: {broken} parts are broken (✘). Parts that were not reached may be broken, too.")
        }
    }
}
