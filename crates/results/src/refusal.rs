//! Why a checkpoint or a merge is refused, for the participant. Every module returns these; none of them
//! repeats a text the agent wrote, so they may be published.

use std::fmt;

use crate::json::Limit;
use crate::number::number_text;

/// A refusal: what failed, on which pair and route. [`Refusal::next_step`] says what to do about it.
///
/// Pairs are positions in [`Plan::pairs`](crate::Plan::pairs), from 0; the texts count from 1, as the folders `agent1` …
/// do.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Refusal {
    /// The plan contradicts itself or the number of workers.
    #[error("the plan of the run does not hold: {problem}")]
    Plan {
        /// Contradiction.
        problem: String,
    },
    /// The file, or what would be written from it, is too large in some way.
    #[error("pair {}: the checkpoint {limit}", ordinal(*pair))]
    Limit {
        /// Pair whose file it is.
        pair: usize,
        /// The bound.
        limit: Limit,
    },
    /// The merged file would be too large.
    #[error("the checkpoints together are too large: this {limit}")]
    Output {
        /// The bound.
        limit: Limit,
    },
    /// The bytes are no text.
    #[error("pair {}: the checkpoint is not UTF-8 text", ordinal(*pair))]
    NotUtf8 {
        /// Pair whose file it is.
        pair: usize,
    },
    /// The JSON has not the shape of a checkpoint.
    #[error("pair {}: `{place}` in the checkpoint is not {wanted}", ordinal(*pair))]
    Shape {
        /// Pair whose file it is.
        pair: usize,
        /// The key, as a path from the top.
        place: &'static str,
        /// Expected type.
        wanted: &'static str,
    },
    /// The file was written for other routes or repetitions.
    #[error("pair {}: the checkpoint is for {found} route runs, but this pair has {expected}", ordinal(*pair))]
    Total {
        /// Pair whose file it is.
        pair: usize,
        /// Number in the file.
        found: u32,
        /// Number in the plan.
        expected: u32,
    },
    /// More records than route runs.
    #[error("pair {}: the checkpoint has {found} records for {expected} route runs", ordinal(*pair))]
    TooManyRecords {
        /// Pair whose file it is.
        pair: usize,
        /// Records in the file.
        found: usize,
        /// Number in the plan.
        expected: u32,
    },
    /// A sensor of no known kind.
    #[error("{}sensor {sensor} is not one of the known kinds", .pair.map_or(String::new(), |pair| format!("pair {}: ", ordinal(pair))))]
    Sensor {
        /// Pair whose file it is, when it was found there.
        pair: Option<usize>,
        /// Which sensor of the list, from 1.
        sensor: usize,
    },
    /// Two workers ran different sensors.
    #[error("pairs {} and {} have different sensor configurations", ordinal(*first), ordinal(*second))]
    SensorsDiffer {
        /// One worker.
        first: usize,
        /// The other.
        second: usize,
    },
    /// A record is wrong.
    #[error("pair {}, {record}: {problem}", ordinal(*pair))]
    Record {
        /// Pair whose file it is.
        pair: usize,
        /// Which record.
        record: RecordName,
        /// Problem of the record.
        problem: RecordProblem,
    },
    /// A route was reported twice in a finished run.
    #[error("{record} has more than one record")]
    Duplicate {
        /// The route.
        record: RecordName,
    },
    /// A route is missing although the counts show that the run is finished.
    #[error("results are missing: the records jump from {} to {after}", .before.as_ref().map_or("the start".to_owned(), ToString::to_string))]
    Gap {
        /// The record before the gap.
        before: Option<RecordName>,
        /// The record after it.
        after: RecordName,
    },
    /// A sum or a quotient has no finite value.
    #[error("the statistics can't be computed: {record}: {problem}")]
    Statistics {
        /// The record that spoils them.
        record: RecordName,
        /// How.
        problem: &'static str,
    },
    /// A metric is no finite number, which EvalAI does not take.
    #[error("the metric \"{metric}\" is not a finite number")]
    Metric {
        /// Its name on EvalAI.
        metric: &'static str,
    },
}

/// People count from 1.
fn ordinal(index: usize) -> usize {
    index.saturating_add(1)
}

impl Refusal {
    /// True if the file has a route that is none of the pair's: it is of another run, or of this one before its plan was changed.
    pub fn is_of_other_routes(&self) -> bool {
        let Self::Record { problem, .. } = self else {
            return false;
        };
        matches!(
            problem,
            RecordProblem::OutsideSlice { .. } | RecordProblem::Repetition { .. }
        )
    }

    /// Position of the pair whose file it is, from 0; none where it is of several.
    pub fn pair(&self) -> Option<usize> {
        match self {
            Self::Limit { pair, .. }
            | Self::NotUtf8 { pair }
            | Self::Shape { pair, .. }
            | Self::Total { pair, .. }
            | Self::TooManyRecords { pair, .. }
            | Self::Record { pair, .. } => Some(*pair),
            Self::Sensor { pair, .. } => *pair,
            Self::Plan { .. }
            | Self::Output { .. }
            | Self::SensorsDiffer { .. }
            | Self::Duplicate { .. }
            | Self::Gap { .. }
            | Self::Statistics { .. }
            | Self::Metric { .. } => None,
        }
    }

    /// Next step for the reader, as one sentence.
    pub fn next_step(&self) -> &'static str {
        match self {
            Self::Plan { .. } => "Correct pairs, routes and repetitions of the leaderboard.",
            Self::SensorsDiffer { .. } | Self::Sensor { .. } => {
                "Let the agent's sensors() return the same known sensors in every run."
            }
            Self::Duplicate { .. } | Self::Gap { .. } | Self::Total { .. } | Self::TooManyRecords { .. } => {
                "Check that every pair ran its own slice of the routes file, and start without old results."
            }
            Self::Limit { .. } | Self::Output { .. } => {
                "The checkpoint holds far more than an evaluation writes; leave it to the evaluator."
            }
            Self::NotUtf8 { .. }
            | Self::Shape { .. }
            | Self::Record { .. }
            | Self::Statistics { .. }
            | Self::Metric { .. } => {
                "Leave the checkpoint to the evaluator, and check that the leaderboard's format matches its version."
            }
        }
    }
}

/// A record, by its route or, where that is not of the usual form, by its place in the file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum RecordName {
    /// `RouteScenario_<id>` or `RouteScenario_<id>_rep<k>`.
    Route {
        /// The route's id in the routes file.
        id: i64,
        /// The repetition, where the format has it in the name.
        repetition: Option<i64>,
    },
    /// The place in the file, from 1.
    Place(usize),
}

impl fmt::Display for RecordName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Route { id, repetition: None } => write!(f, "route RouteScenario_{id}"),
            Self::Route {
                id,
                repetition: Some(k),
            } => write!(f, "route RouteScenario_{id}_rep{k}"),
            Self::Place(place) => write!(f, "record {place}"),
        }
    }
}

/// Problem of one record.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RecordProblem {
    /// Not a JSON object.
    #[error("it is not an object")]
    NotAnObject,
    /// A key is missing or of another type.
    #[error("`{key}` is not {wanted}")]
    Shape {
        /// The key.
        key: &'static str,
        /// Expected type.
        wanted: &'static str,
    },
    /// The id is not the evaluator's.
    #[error("its route_id is not of the form RouteScenario_<number>{}", if *.repetition { "_rep<number>" } else { "" })]
    RouteId {
        /// True if the format has the repetition in the name.
        repetition: bool,
    },
    /// Another pair's route.
    #[error("the route is outside this pair's routes {first}-{last}")]
    OutsideSlice {
        /// First route of the slice.
        first: u32,
        /// Last route of the slice.
        last: u32,
    },
    /// More repetitions than are driven.
    #[error("the run has only {repetitions} repetitions, counted from 0")]
    Repetition {
        /// Repetitions of the run.
        repetitions: u32,
    },
    /// This route run again in the same file.
    #[error("the route run is there more often than it is driven")]
    Repeated,
    /// A status no evaluator writes.
    #[error("its status is not one of the known ones")]
    Status,
    /// NaN or infinite.
    #[error("{field} is {}", match () { () if .value.is_nan() => "NaN", () if *.value > 0.0 => "Infinity", () => "-Infinity" })]
    NotFinite {
        /// The key.
        field: &'static str,
        /// Value found.
        value: f64,
    },
    /// A number no route can have.
    #[error("{field} is {}, which is not between {} and {}", number_text(*.value), number_text(*.low), number_text(*.high))]
    Range {
        /// The key.
        field: &'static str,
        /// Value found.
        value: f64,
        /// The lowest possible.
        low: f64,
        /// The highest possible.
        high: f64,
    },
    /// An infraction message that should show how far the agent was off the road does not.
    #[error("an outside_route_lanes message does not hold the distance")]
    OffRoadMessage,
    /// The driving score is not the product.
    #[error("score_composed is {}, but score_route x score_penalty is {}", number_text(*.found), number_text(*.expected))]
    Composed {
        /// Value in the record.
        found: f64,
        /// Value that follows from its scores.
        expected: f64,
    },
    /// The penalty is better than the infractions allow.
    #[error("score_penalty is {}, but its infractions allow {} at most", number_text(*.found), number_text(*.allowed))]
    Penalty {
        /// Value in the record.
        found: f64,
        /// The most that follows from its infractions.
        allowed: f64,
    },
}
