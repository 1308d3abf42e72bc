//! The global record: what a finished run sums up to. Called by the merge with complete records only; the two formats
//! differ in almost every formula and are kept apart in `v1` and `v2`.

mod v1;
mod v2;

pub(crate) use v1::global as v1;
pub(crate) use v2::global as v2;

use crate::checkpoint::{Meta, Record, Scores};
use crate::json::{Node, Value};
use crate::names::{self, Metric, Score, Source};
use crate::number::{Number, count, square};
use crate::{Format, RecordName, Refusal};

/// The global record.
#[derive(Clone, Debug)]
pub(crate) struct Global {
    pub(crate) format: Format,
    pub(crate) status: String,
    /// In the order of [`names::infractions`].
    pub(crate) infractions: Vec<Number>,
    pub(crate) means: Scores,
    /// `None`: a single route has no deviation.
    pub(crate) deviations: Option<Scores>,
    /// Plain sums over the routes.
    pub(crate) totals: Meta,
    pub(crate) exceptions: Vec<Exception>,
}

/// A route that did not go well.
#[derive(Clone, Debug)]
pub(crate) struct Exception {
    pub(crate) route_id: String,
    /// The index in the merged file, or what the worker's file has.
    pub(crate) index: Value,
    pub(crate) status: String,
}

impl Global {
    /// The value EvalAI gets for a metric.
    pub(crate) fn metric(&self, metric: &Metric) -> Number {
        match metric.source {
            Source::Score(score) => self.means.get(score),
            Source::Infraction(key) => {
                let place = names::infractions(self.format).iter().position(|k| *k == key);
                place
                    .and_then(|place| self.infractions.get(place))
                    .copied()
                    .unwrap_or(Number::ZERO)
            }
        }
    }

    /// The `values` of the merged file, in the order of its `labels`.
    pub(crate) fn values(&self) -> Vec<String> {
        let text = |metric| match self.format {
            Format::V1 => self.metric(metric).fixed3(),
            Format::V2 => self.metric(metric).text(),
        };
        names::metrics(self.format).iter().map(text).collect()
    }

    pub(crate) fn node(&self) -> Node<'_> {
        let infractions = names::infractions(self.format).iter().zip(&self.infractions);
        let infractions = infractions
            .map(|(key, number)| (key.as_bytes(), Node::Number(*number)))
            .collect();
        let mut meta = vec![
            (b"total_length".as_slice(), Node::Number(self.totals.length)),
            (b"duration_game".as_slice(), Node::Number(self.totals.game)),
            (b"duration_system".as_slice(), Node::Number(self.totals.system)),
        ];
        if self.format == Format::V2 || !self.exceptions.is_empty() {
            meta.push((
                b"exceptions",
                Node::List(self.exceptions.iter().map(Exception::node).collect()),
            ));
        }
        let minus_one = || Node::Number(Number::Int(-1));
        Node::object([
            ("index", minus_one()),
            ("route_id", minus_one()),
            ("status", Node::Str(&self.status)),
            ("infractions", Node::Object(infractions)),
            (
                if self.format == Format::V1 {
                    "scores"
                } else {
                    "scores_mean"
                },
                scores(self.means),
            ),
            ("scores_std_dev", self.deviations_node()),
            ("meta", Node::Object(meta)),
        ])
    }

    fn deviations_node(&self) -> Node<'_> {
        match (self.deviations, self.format) {
            (Some(deviations), _) => scores(deviations),
            (None, Format::V1) => per_score(|_| Node::Str("NaN")),
            (None, Format::V2) => per_score(|_| Node::Number(Number::ZERO)),
        }
    }
}

impl Exception {
    fn of(record: &Record, index: Value) -> Self {
        Self {
            route_id: record.route_id.clone(),
            index,
            status: record.status.clone(),
        }
    }

    fn node(&self) -> Node<'_> {
        Node::List(vec![
            Node::Str(&self.route_id),
            Node::Value(&self.index),
            Node::Str(&self.status),
        ])
    }
}

fn scores(numbers: Scores) -> Node<'static> {
    per_score(|score| Node::Number(numbers.get(score)))
}

fn per_score<'a>(node: impl Fn(Score) -> Node<'a>) -> Node<'a> {
    Node::object(Score::ALL.map(|score| (score.key(), node(score))))
}

/// Plain sums, in the order the records come.
fn totals(records: &[&Record]) -> Meta {
    records.iter().fold(Meta::ZERO, |sum, record| Meta {
        length: sum.length.plus(record.meta.length),
        game: sum.game.plus(record.meta.game),
        system: sum.system.plus(record.meta.system),
    })
}

/// The standard deviations of a sample around `means`, each as `shown`. A single route has none.
fn deviations(records: &[&Record], means: Scores, shown: fn(f64) -> f64) -> Result<Option<Scores>, Refusal> {
    if records.len() == 1 {
        return Ok(None);
    }
    let deviation = |score: Score| -> Result<Number, Refusal> {
        let (mean, mut sum) = (means.get(score).as_f64(), 0.0);
        for record in records {
            let difference = record.scores.get(score).as_f64() - mean;
            sum += square(difference).ok_or_else(|| refused(&record.name, "its scores are too large"))?;
        }
        Ok(Number::Float(shown((sum / (count(records.len()) - 1.0)).sqrt())))
    };
    Ok(Some(Scores {
        composed: deviation(Score::Composed)?,
        route: deviation(Score::Route)?,
        penalty: deviation(Score::Penalty)?,
    }))
}

fn refused(record: &RecordName, problem: &'static str) -> Refusal {
    Refusal::Statistics {
        record: record.clone(),
        problem,
    }
}
