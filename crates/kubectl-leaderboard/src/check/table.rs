//! The findings of a check as a table, and whether it passed. Pure.

use kube::ResourceExt;
use leaderboard_api::Submission;

use super::finding::{Finding, Mark};
use crate::bucket;
use crate::facts::command;
use crate::text::{Frame, clean, wrap};

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
pub fn lines(findings: &[Finding], outcome: Outcome, width: usize) -> Vec<String> {
    let mut lines: Vec<String> = findings.iter().flat_map(|finding| row(finding, width)).collect();
    lines.push(String::new());
    lines.extend(wrap(&verdict(findings, outcome), width));
    lines
}

/// What is begun.
pub fn begun(check: &Submission, frame: Frame) -> Vec<String> {
    let (spec, mut page) = (&check.spec, frame.page());
    page.paragraph(&format!(
        "Check {} of Leaderboard {}: one route of track {} with {}.",
        check.name_any(),
        spec.leaderboard_name,
        spec.track.as_deref().unwrap_or_default(),
        spec.image.as_deref().unwrap_or_default()
    ));
    page.into_lines()
}

/// The results that the check leaves in the bucket, and how to remove them.
pub fn left(check: &Submission, frame: Frame) -> Vec<String> {
    let status = check.status.as_ref().filter(|status| status.times.started.is_some());
    let Some(results) = status.and_then(|status| status.results_url.as_deref()) else {
        return Vec::new();
    };
    let storage = status.and_then(|status| status.plan.as_ref()).map(|plan| &plan.storage);
    let mut page = frame.page();
    page.paragraph(&format!("Its results stay in {results}/. To remove them:"));
    let mut lines = page.into_lines();
    lines.push(format!("  {}", clean(&bucket::remove(&format!("{results}/"), storage))));
    lines
}

/// That the Submission is kept, and how to remove it.
pub fn kept(check: &Submission, frame: Frame) -> Vec<String> {
    let (name, namespace) = (check.name_any(), check.namespace().unwrap_or_default());
    let mut page = frame.page();
    page.paragraph(&format!(
        "{name} is kept, for `{}`. To remove it:",
        command("why", check)
    ));
    let mut lines = page.into_lines();
    lines.push(format!("  kubectl delete submission {name} -n {namespace}"));
    lines
}

fn row(finding: &Finding, width: usize) -> Vec<String> {
    let mark = match finding.mark {
        Mark::Works => '✔',
        Mark::Broken => '✘',
        Mark::Note => '!',
        Mark::Open => '–',
    };
    let width = width.saturating_sub(INDENT);
    let mut texts = wrap(&finding.found, width);
    if texts.is_empty() {
        texts.push(String::new());
    }
    let step = finding.step.iter().flat_map(|step| wrap(&format!("→ {step}"), width));
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
        0 => "The check did not pass: nothing is known to be broken, but its route was not driven to the end. Run it again."
            .to_owned(),
        1 => "The check failed: 1 part is broken (✘). Parts that were not reached may be broken, too.".to_owned(),
        broken => {
            format!("The check failed: {broken} parts are broken (✘). Parts that were not reached may be broken, too.")
        }
    }
}
