//! The global record: what a finished run sums up to. Called by the merge with complete records only; the two formats
//! differ in almost every formula and are kept apart in `v1` and `v2`.

mod v1;
mod v2;

pub(crate) use v1::global as v1;
pub(crate) use v2::global as v2;

use crate::json::Node;
use crate::names::{self, Metric, Score, Source};
use crate::number::Number;
use crate::{Format, RecordName, Refusal};

/// The global record.
#[derive(Clone, Debug)]
pub(crate) struct Global {
    pub(crate) format: Format,
    pub(crate) status: String,
    /// In the order of [`names::infractions`].
    pub(crate) infractions: Vec<Number>,
    pub(crate) means: PerScore<Number>,
    /// `None`: a single route has no deviation.
    pub(crate) deviations: Option<PerScore<Number>>,
    pub(crate) totals: Totals,
    pub(crate) exceptions: Vec<Exception>,
}

/// One value for each score, in the order of [`Score::ALL`].
pub(crate) type PerScore<T> = [T; 3];

/// Plain sums over the routes: meters and seconds.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Totals {
    pub(crate) length: Number,
    pub(crate) game: Number,
    pub(crate) system: Number,
}

/// A route that did not go well.
#[derive(Clone, Debug)]
pub(crate) struct Exception {
    pub(crate) route_id: String,
    /// The index in the merged file, or what the worker's file has.
    pub(crate) index: Option<crate::json::Value>,
    pub(crate) status: String,
}

impl Global {
    pub(crate) fn mean(&self, score: Score) -> Number {
        let place = Score::ALL.iter().position(|s| *s == score);
        place
            .and_then(|place| self.means.get(place))
            .copied()
            .unwrap_or(Number::ZERO)
    }

    /// The value EvalAI gets for a metric.
    pub(crate) fn metric(&self, metric: &Metric) -> Number {
        match metric.source {
            Source::Score(score) => self.mean(score),
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
                scores(&self.means),
            ),
            ("scores_std_dev", self.deviations_node()),
            ("meta", Node::Object(meta)),
        ])
    }

    fn deviations_node(&self) -> Node<'_> {
        match (&self.deviations, self.format) {
            (Some(deviations), _) => scores(deviations),
            (None, Format::V1) => per_score(|_| Node::Str("NaN")),
            (None, Format::V2) => per_score(|_| Node::Number(Number::ZERO)),
        }
    }
}

impl Exception {
    fn node(&self) -> Node<'_> {
        let index = self
            .index
            .as_ref()
            .map_or(Node::Value(&crate::json::Value::Null), Node::Value);
        Node::List(vec![Node::Str(&self.route_id), index, Node::Str(&self.status)])
    }
}

fn scores(numbers: &PerScore<Number>) -> Node<'static> {
    let [composed, route, penalty] = *numbers;
    per_score(|score| {
        Node::Number(match score {
            Score::Composed => composed,
            Score::Route => route,
            Score::Penalty => penalty,
        })
    })
}

fn per_score<'a>(node: impl Fn(Score) -> Node<'a>) -> Node<'a> {
    Node::object(Score::ALL.map(|score| (score.key(), node(score))))
}

/// Plain sums, in the order the records come.
fn totals(records: &[&crate::checkpoint::Record]) -> Totals {
    let zero = Totals {
        length: Number::ZERO,
        game: Number::ZERO,
        system: Number::ZERO,
    };
    records.iter().fold(zero, |sum, record| Totals {
        length: sum.length.plus(record.meta.length),
        game: sum.game.plus(record.meta.game),
        system: sum.system.plus(record.meta.system),
    })
}

/// The standard deviation of a sample around `mean`.
fn deviation(records: &[&crate::checkpoint::Record], score: Score, mean: f64) -> Result<f64, Refusal> {
    let mut sum = 0.0;
    for record in records {
        let difference = record.scores.get(score).as_f64() - mean;
        sum += crate::number::square(difference).ok_or_else(|| refused(&record.name, "its scores are too large"))?;
    }
    Ok((sum / (crate::number::count(records.len()) - 1.0)).sqrt())
}

fn refused(record: &RecordName, problem: &'static str) -> Refusal {
    Refusal::Statistics {
        record: record.clone(),
        problem,
    }
}
