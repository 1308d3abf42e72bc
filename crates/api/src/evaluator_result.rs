//! `result.json` of a host's evaluator: read as hostile text, into a type that holds no nonsense. Pure.
//!
//! `logcopy` reads it in the Pod, and the plugin on a host's machine. The evaluator is the host's, and it talks to a stranger's program.
//! `docs/evaluator-result.schema.json` has the same rules for hosts.

use std::collections::BTreeSet;

use serde::Deserialize;
use serde::de::{Deserializer, MapAccess, Visitor};
use serde_json::value::RawValue;

use super::container::ScoreMetric;
use super::progress::{MAX_METRICS, MAX_NAME};
use super::text::one_line;

/// Version of the document.
pub const SCHEMA: u64 = 1;
/// Largest document that is read, in bytes.
pub const MAX_BYTES: usize = 1 << 20;
/// Most units of one worker.
pub const MAX_UNITS: u32 = 1_000_000_000;
/// Most splits.
pub const MAX_SPLITS: usize = 16;
/// Longest text that is shown, in characters.
pub const MAX_TEXT: usize = 1024;
/// Longest number that is shown as it was written, in characters.
const MAX_NUMBER: usize = 32;
/// Stands for a refusal without a text.
const REFUSED: &str = "The evaluator refused the submission.";

/// A result, within its bounds.
#[derive(Clone, Debug, PartialEq)]
pub struct ResultFile {
    /// Units of work done.
    pub done: u32,
    /// Units in all.
    pub total: u32,
    /// Nothing more comes, and no unit is missing.
    pub is_final: bool,
    /// True if the result counts.
    pub eligible: bool,
    /// In the order of the document; no two have one name.
    pub splits: Vec<Split>,
    /// Why the submission is refused, in one line, if it is.
    pub refused: Option<String>,
    /// For the participant, in one line.
    pub message: Option<String>,
}

/// One split of a result.
#[derive(Clone, Debug, PartialEq)]
pub struct Split {
    /// Codename in EvalAI.
    pub name: String,
    /// In the order of the document; no two have one name.
    pub metrics: Vec<(String, Number)>,
}

/// A finite number, with the digits that it was written with.
#[derive(Clone, Debug, PartialEq)]
pub struct Number {
    value: f64,
    text: String,
}

/// Why a document is no result, as one sentence, and a second one with the next step.
#[derive(thiserror::Error, Clone, Debug, PartialEq, Eq)]
pub enum ResultError {
    #[error("it has {0} bytes, more than the {MAX_BYTES} that are read. Write less into it.")]
    TooLarge(usize),
    #[error("it is not the JSON of a result: {0}. Compare it with evaluator-result.schema.json.")]
    Malformed(String),
    #[error("its schema is {0}, and this operator reads {SCHEMA}. Write \"schema\": {SCHEMA}.")]
    Schema(u64),
    #[error("total is {0}, more than {MAX_UNITS}. Count larger units.")]
    TooManyUnits(u64),
    #[error("done is {done}, more than total, which is {total}. Count the same units in both.")]
    MoreDone { done: u64, total: u64 },
    #[error(
        "final is true, but done is {done} and total is {total}. Write final once all units are done, of which there is at least one."
    )]
    Unfinished { done: u32, total: u32 },
    #[error("it has {0} splits, more than {MAX_SPLITS}. Write those that the phase has.")]
    TooManySplits(usize),
    #[error(
        "the split {split} has {metrics} metrics, more than {MAX_METRICS}. Write those that the leaderboard shows."
    )]
    TooManyMetrics { split: String, metrics: usize },
    #[error("{0:?} is no name of a split or a metric. Take 1 to {MAX_NAME} characters that can be seen.")]
    Name(String),
    #[error("two splits have the name {0}. Write each split once.")]
    TwoSplits(String),
    #[error("the split {split} has two metrics with the name {metric}. Write each metric once.")]
    TwoMetrics { split: String, metric: String },
    #[error("the metric {metric} of the split {split} is no finite number. Write a number, or leave the metric out.")]
    NotFinite { split: String, metric: String },
    #[error("it has {0} splits, and the score names none. Set tracks[].container.score.split.")]
    SeveralSplits(usize),
    #[error(
        "it is final without the metric {metric} of {split}, which is the score. Write it, or correct tracks[].container.score."
    )]
    NoScore { split: String, metric: String },
}

/// Reads a document.
pub fn parse(bytes: &[u8]) -> Result<ResultFile, ResultError> {
    if bytes.len() > MAX_BYTES {
        return Err(ResultError::TooLarge(bytes.len()));
    }
    // Another version may have other fields.
    let Numbered { schema } = serde_json::from_slice(bytes).map_err(|error| malformed(&error))?;
    if schema != SCHEMA {
        return Err(ResultError::Schema(schema));
    }
    let document: Document<'_> = serde_json::from_slice(bytes).map_err(|error| malformed(&error))?;
    document.checked()
}

fn malformed(error: &serde_json::Error) -> ResultError {
    ResultError::Malformed(one_line(&error.to_string(), MAX_TEXT))
}

#[derive(Deserialize)]
struct Numbered {
    schema: u64,
}

#[derive(Deserialize)]
struct Document<'a> {
    done: u64,
    total: u64,
    #[serde(rename = "final")]
    is_final: bool,
    #[serde(default = "yes")]
    eligible: bool,
    #[serde(borrow)]
    splits: Vec<DocumentSplit<'a>>,
    #[serde(default)]
    refused: Option<String>,
    #[serde(default)]
    message: Option<String>,
}

#[derive(Deserialize)]
struct DocumentSplit<'a> {
    name: String,
    #[serde(borrow)]
    metrics: Entries<'a>,
}

/// The entries of an object, also those of one name.
struct Entries<'a>(Vec<(String, &'a RawValue)>);

impl<'de: 'a, 'a> Deserialize<'de> for Entries<'a> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct All;
        impl<'de> Visitor<'de> for All {
            type Value = Vec<(String, &'de RawValue)>;

            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("an object of numbers")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Self::Value, A::Error> {
                let mut entries = Vec::new();
                while let Some(entry) = map.next_entry()? {
                    entries.push(entry);
                }
                Ok(entries)
            }
        }
        deserializer.deserialize_map(All).map(Entries)
    }
}

fn yes() -> bool {
    true
}

impl Document<'_> {
    fn checked(self) -> Result<ResultFile, ResultError> {
        let (done, total) = units(self.done, self.total)?;
        let refused = self.refused.map(|why| one_line(&why, MAX_TEXT));
        if self.is_final && refused.is_none() && (done < total || total == 0) {
            return Err(ResultError::Unfinished { done, total });
        }
        Ok(ResultFile {
            done,
            total,
            is_final: self.is_final,
            eligible: self.eligible,
            splits: splits(self.splits)?,
            refused: refused.map(|why| if why.is_empty() { REFUSED.to_owned() } else { why }),
            message: self
                .message
                .map(|text| one_line(&text, MAX_TEXT))
                .filter(|text| !text.is_empty()),
        })
    }
}

fn units(done: u64, total: u64) -> Result<(u32, u32), ResultError> {
    if done > total {
        return Err(ResultError::MoreDone { done, total });
    }
    let bounded = |units: u64| u32::try_from(units).ok().filter(|units| *units <= MAX_UNITS);
    let (Some(done), Some(total)) = (bounded(done), bounded(total)) else {
        return Err(ResultError::TooManyUnits(total));
    };
    Ok((done, total))
}

fn splits(all: Vec<DocumentSplit<'_>>) -> Result<Vec<Split>, ResultError> {
    if all.len() > MAX_SPLITS {
        return Err(ResultError::TooManySplits(all.len()));
    }
    let mut names = BTreeSet::new();
    let splits = all.into_iter().map(|split| {
        let name = named(split.name)?;
        if !names.insert(name.clone()) {
            return Err(ResultError::TwoSplits(name));
        }
        Ok(Split {
            metrics: metrics(&name, split.metrics)?,
            name,
        })
    });
    splits.collect()
}

fn metrics(split: &str, Entries(all): Entries<'_>) -> Result<Vec<(String, Number)>, ResultError> {
    let split = || split.to_owned();
    if all.len() > MAX_METRICS {
        return Err(ResultError::TooManyMetrics {
            split: split(),
            metrics: all.len(),
        });
    }
    let mut names = BTreeSet::new();
    let metrics = all.into_iter().map(|(name, value)| {
        let metric = named(name)?;
        if !names.insert(metric.clone()) {
            return Err(ResultError::TwoMetrics { split: split(), metric });
        }
        match Number::read(value.get()) {
            Some(number) => Ok((metric, number)),
            None => Err(ResultError::NotFinite { split: split(), metric }),
        }
    });
    metrics.collect()
}

/// A name that is the same in a status, in EvalAI and on a terminal.
fn named(name: String) -> Result<String, ResultError> {
    let shown = one_line(&name, MAX_NAME);
    if name.is_empty() || shown != name {
        return Err(ResultError::Name(shown));
    }
    Ok(name)
}

impl Number {
    /// A number as it is written here; `None` for one that is not finite.
    pub fn new(value: f64) -> Option<Self> {
        value.is_finite().then(|| Self {
            value,
            text: format!("{value:?}"),
        })
    }

    /// A number of JSON.
    pub fn read(text: &str) -> Option<Self> {
        // Rust reads `inf` and `nan` as numbers, too; neither these nor a text in quotes begin so.
        let is_number = text.starts_with(|first: char| first == '-' || first.is_ascii_digit());
        let value: f64 = text.parse().ok().filter(|_| is_number)?;
        let number = Self::new(value)?;
        let is_short = text.len() <= MAX_NUMBER;
        Some(if is_short {
            Self {
                text: text.to_owned(),
                ..number
            }
        } else {
            number
        })
    }

    /// Its value.
    pub fn value(&self) -> f64 {
        self.value
    }

    /// Its digits, as JSON.
    pub fn text(&self) -> &str {
        &self.text
    }
}

impl Split {
    /// The metric of this name.
    pub fn metric(&self, name: &str) -> Option<&Number> {
        let found = self.metrics.iter().find(|(known, _)| known == name);
        found.map(|(_, number)| number)
    }
}

impl ResultFile {
    /// The split of this name.
    pub fn split(&self, name: &str) -> Option<&Split> {
        self.splits.iter().find(|split| split.name == name)
    }

    /// An error unless it has the score of a track, or may still get it.
    pub fn check_score(&self, score: &ScoreMetric) -> Result<(), ResultError> {
        let (split, named) = match (&score.split, self.splits.as_slice()) {
            (None, all @ [_, _, ..]) => return Err(ResultError::SeveralSplits(all.len())),
            (None, all) => (all.first(), "its split".to_owned()),
            (Some(name), _) => (self.split(name), format!("the split {name}")),
        };
        let is_there = split.is_some_and(|split| split.metric(&score.metric).is_some());
        if is_there || !self.is_final || self.refused.is_some() {
            return Ok(());
        }
        Err(ResultError::NoScore {
            split: named,
            metric: score.metric.clone(),
        })
    }
}

#[cfg(test)]
mod tests;
