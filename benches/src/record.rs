//! One line of JSON for each case: what was measured, on which machine, and how much of it others used meanwhile.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Write as _;
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::bench::Outcome;
use crate::machine::Machine;
use crate::stats::{Summary, ratios};

/// A measured case.
#[derive(Serialize, Deserialize, Clone, Debug, Default)]
#[serde(rename_all = "camelCase")]
pub struct Line {
    pub case: String,
    /// Cargo profile of the measured operator.
    pub profile: String,
    pub quick: bool,
    /// Share of the full size.
    pub scale: f64,
    /// When it began.
    pub time: String,
    pub took_seconds: f64,
    pub machine: Machine,
    /// Share of all cores that others took, over the runs.
    pub foreign: Option<Summary>,
    pub figures: BTreeMap<String, Summary>,
    /// Counts by name, of one run.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub counts: BTreeMap<String, f64>,
    /// Values over time, for the plots.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub series: BTreeMap<String, Vec<(f64, f64)>>,
    /// Sentences that a reader of the figures needs, such as a limit of time that was reached.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub notes: Vec<String>,
}

/// The figures of a case while it is measured.
#[derive(Default)]
pub struct Figures {
    runs: BTreeMap<String, Vec<f64>>,
    foreign: Vec<f64>,
    pub counts: BTreeMap<String, f64>,
    pub series: BTreeMap<String, Vec<(f64, f64)>>,
    pub notes: Vec<String>,
}

impl Figures {
    /// A run's value.
    pub fn add(&mut self, name: &str, value: impl Into<Option<f64>>) {
        if let Some(value) = value.into() {
            self.runs.entry(name.to_owned()).or_default().push(value);
        }
    }

    /// Adds the runs of a repetition. Counts and series are of one run: they stay those of the first.
    pub fn extend(&mut self, other: Self) {
        for (name, mut runs) in other.runs {
            self.runs.entry(name).or_default().append(&mut runs);
        }
        self.foreign.extend(other.foreign);
        for note in other.notes {
            self.note(note);
        }
    }

    pub fn foreign(&mut self, share: f64) {
        self.foreign.push(share);
    }

    pub fn note(&mut self, text: String) {
        if !self.notes.contains(&text) {
            self.notes.push(text);
        }
    }

    /// Each run of one figure divided by its neighbor of another.
    pub fn ratio(&mut self, name: &str, of: &str, to: &str) {
        let empty = Vec::new();
        let side = |name: &str| self.runs.get(name).unwrap_or(&empty);
        let ratios = ratios(side(of), side(to));
        if !ratios.is_empty() {
            self.runs.insert(name.to_owned(), ratios);
        }
    }

    pub fn into_line(self, case: &str) -> Line {
        let figures = self
            .runs
            .into_iter()
            .filter_map(|(name, runs)| Some((name, Summary::of(&runs)?)));
        Line {
            case: case.to_owned(),
            figures: figures.collect(),
            foreign: Summary::of(&self.foreign),
            counts: self.counts,
            series: self.series,
            notes: self.notes,
            ..Line::default()
        }
    }
}

impl Line {
    /// Median of a figure.
    pub fn median(&self, figure: &str) -> Option<f64> {
        self.figures.get(figure).map(|summary| summary.median)
    }

    /// Appends it to a file.
    pub fn append(&self, file: &Path) -> Outcome<()> {
        let mut text = serde_json::to_string(self)?;
        text.push('\n');
        if let Some(folder) = file.parent() {
            std::fs::create_dir_all(folder)?;
        }
        Ok(File::options()
            .create(true)
            .append(true)
            .open(file)?
            .write_all(text.as_bytes())?)
    }

    /// For people, as it is measured.
    pub fn print(&self) {
        println!("{} ({:.0} s)", self.case, self.took_seconds);
        for (name, summary) in &self.figures {
            println!(
                "  {name:<44} {:>10.3}  [{:.3} - {:.3}]",
                summary.median, summary.low, summary.high
            );
        }
        for (name, count) in &self.counts {
            println!("  {name:<44} {count:>10.2}");
        }
        for note in &self.notes {
            println!("  note: {note}");
        }
        if let Some(foreign) = &self.foreign {
            println!(
                "  {:<44} {:>10.3}",
                "share of the cores that others took", foreign.median
            );
        }
    }
}

/// The last line of each case in a file.
pub fn read(file: &Path) -> Outcome<Vec<Line>> {
    let text = std::fs::read_to_string(file).map_err(|error| format!("{}: {error}", file.display()))?;
    let mut lines: Vec<Line> = Vec::new();
    for line in text.lines().filter(|line| !line.trim().is_empty()) {
        let line: Line = serde_json::from_str(line)?;
        lines.retain(|known| known.case != line.case);
        lines.push(line);
    }
    Ok(lines)
}

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "the expected numbers are exact")]
mod tests {
    use super::*;

    #[test]
    fn the_last_line_of_a_case_counts() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("new/lines.jsonl");
        for value in [1.0, 2.0] {
            let mut figures = Figures::default();
            figures.add("a", value);
            figures.add("b", 4.0);
            figures.add("c", None);
            figures.ratio("a/b", "a", "b");
            figures.into_line("case").append(&file).unwrap();
        }
        let lines = read(&file).unwrap();
        assert_eq!(lines.len(), 1);
        assert_eq!((lines[0].median("a"), lines[0].median("a/b")), (Some(2.0), Some(0.5)));
        assert_eq!(lines[0].median("c"), None);
    }

    #[test]
    fn a_repetition_adds_its_runs_and_the_series_stay_those_of_the_first() {
        let run = |value: f64| {
            let mut figures = Figures::default();
            figures.add("a", value);
            figures.foreign(value);
            figures.note("small".into());
            figures.series.insert("s".into(), vec![(0.0, value)]);
            figures
        };
        let mut figures = run(1.0);
        figures.extend(run(3.0));
        let line = figures.into_line("case");
        assert_eq!(line.figures["a"].runs, [1.0, 3.0]);
        assert_eq!(line.foreign.map(|share| share.runs.len()), Some(2));
        assert_eq!((line.series["s"][0].1, line.notes), (1.0, vec!["small".to_owned()]));
    }
}
