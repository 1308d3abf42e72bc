//! The merge: several workers' checkpoints to one file, one verdict. Called once a round with whatever the workers have
//! so far; it keeps no state, so a run that was interrupted merges like one that was not.

use crate::checkpoint::{Checkpoint, Record};
use crate::json::{KeyOrder, Node, Object, Text, write};
use crate::names::{self, SENSORS_INVALID, SIMULATION_CRASHED, STARTED, Score};
use crate::number::{Number, count};
use crate::statistics::{self, Global};
use crate::{Format, Plan, RecordName, Refusal, Slice};

/// How a run ended, whatever the format calls it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Outcome {
    /// Routes are missing.
    Running,
    /// All routes were driven and count.
    Finished,
    /// A simulator crashed; the results do not count.
    Crashed,
    /// The agent asked for sensors it may not have; the results do not count.
    Rejected,
    /// The results contradict themselves; they do not count.
    Invalid,
}

impl Outcome {
    /// Why the results do not count, as one sentence; `None` when they do or may still.
    pub fn why_not(self) -> Option<&'static str> {
        match self {
            Self::Running | Self::Finished => None,
            Self::Crashed => Some("The simulation crashed in at least one route."),
            Self::Rejected => Some("The agent's sensors were invalid."),
            Self::Invalid => Some("The results name no sensors, or hold a route that was never finished."),
        }
    }
}

/// How far one pair is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PairProgress {
    /// Routes finished, each repetition counted.
    pub done: u32,
    /// Routes the pair has to drive, each repetition counted.
    pub total: u32,
    /// Whether the evaluator came to its regular end; see [`Checkpoint::ended`].
    pub ended: bool,
}

/// What the workers' files say together.
#[derive(Clone, Debug)]
pub struct Merged {
    /// The merged file, as the original writes it.
    pub text: String,
    /// Routes finished, each repetition counted.
    pub done: u32,
    /// Routes to drive: the plan's when it is known, else the sum of what the files say.
    pub total: u32,
    /// Whether nothing is missing, so that there is a global record.
    pub is_final: bool,
    /// Whether the results count.
    pub eligible: bool,
    /// The `entry_status` of the merged file.
    pub entry_status: String,
    /// How the run ended.
    pub outcome: Outcome,
    /// Mean driving score over all routes; only once the run is final.
    pub score: Option<f64>,
    /// Mean driving score over the finished routes, 0 to 100; `None` before the first.
    pub partial_score: Option<f64>,
    /// Each pair, in the order of the workers.
    pub pairs: Vec<PairProgress>,
    /// Records whose scores do not follow from their infractions, one sentence each.
    pub warnings: Vec<String>,
    pub(crate) view: View,
}

/// What the renderers need of the merged file.
#[derive(Clone, Debug)]
pub(crate) struct View {
    pub(crate) sensors: Vec<Text>,
    pub(crate) routes: Vec<Line>,
    pub(crate) global: Option<Global>,
}

/// One line of the route glossary; durations in seconds.
#[derive(Clone, Debug)]
pub(crate) struct Line {
    pub(crate) route_id: String,
    pub(crate) status: String,
    pub(crate) game: Number,
    pub(crate) system: Number,
}

/// Merges what the workers have so far; `workers` in the order of the plan's pairs, `None` for one without a readable file.
pub fn merge(plan: &Plan, workers: &[Option<&Checkpoint>]) -> Result<Merged, Refusal> {
    plan.check()?;
    if plan.decides() && plan.pairs.len() != workers.len() {
        let problem = format!(
            "it has {} pairs, but there are {} workers",
            plan.pairs.len(),
            workers.len()
        );
        return Err(Refusal::Plan { problem });
    }
    let sensors = sensors(workers)?;
    let unsorted: Vec<&Record> = workers.iter().flatten().flat_map(|worker| &worker.records).collect();
    let mut sorted = unsorted.clone();
    sorted.sort_by_key(|record| record.key);

    let done = u32::try_from(sorted.len()).unwrap_or(u32::MAX);
    let promised = workers
        .iter()
        .flatten()
        .fold(0, |sum: u32, worker| sum.saturating_add(worker.total));
    let total = plan.expected().unwrap_or(promised);
    let is_final = total != 0 && done == total && is_complete(plan, workers);
    if is_final {
        check_routes(plan, workers, &sorted)?;
    }
    let global = is_final.then(|| global(plan, &unsorted, &sorted)).transpose()?;
    let verdict = Verdict::of(plan, &sorted, &sensors, is_final);
    let text = text(plan.format, &sorted, [done, total], &sensors, global.as_ref(), &verdict)
        .map_err(|limit| Refusal::Output { limit })?;
    Ok(Merged {
        text,
        done,
        total,
        is_final,
        eligible: verdict.eligible,
        entry_status: verdict.entry_status.to_owned(),
        outcome: verdict.outcome,
        score: global.as_ref().map(|global| global.mean(Score::Composed).as_f64()),
        partial_score: partial_score(&sorted),
        pairs: pairs(plan, workers),
        warnings: workers
            .iter()
            .flatten()
            .flat_map(|worker| worker.warnings.iter().cloned())
            .collect(),
        view: View {
            sensors,
            routes: sorted.iter().map(|record| Line::of(record)).collect(),
            global,
        },
    })
}

impl Line {
    fn of(record: &Record) -> Self {
        Self {
            route_id: record.route_id.clone(),
            status: record.status.clone(),
            game: record.meta.game,
            system: record.meta.system,
        }
    }
}

fn sensors(workers: &[Option<&Checkpoint>]) -> Result<Vec<Text>, Refusal> {
    let mut with_sensors = workers
        .iter()
        .enumerate()
        .filter_map(|(pair, worker)| worker.map(|w| (pair, &w.sensors)))
        .filter(|w| !w.1.is_empty());
    let Some((first, sensors)) = with_sensors.next() else {
        return Ok(Vec::new());
    };
    match with_sensors.find(|(_, other)| *other != sensors) {
        Some((second, _)) => Err(Refusal::SensorsDiffer { first, second }),
        None => Ok(sensors.clone()),
    }
}

/// With a plan, every pair has to have exactly its share; without one the sums have to do.
fn is_complete(plan: &Plan, workers: &[Option<&Checkpoint>]) -> bool {
    !plan.decides()
        || workers
            .iter()
            .enumerate()
            .all(|(pair, worker)| worker.map(Checkpoint::done) == plan.expected_of(pair))
}

/// Every route once: by the plan where ids are positions, else as far as the original looks.
fn check_routes(plan: &Plan, workers: &[Option<&Checkpoint>], sorted: &[&Record]) -> Result<(), Refusal> {
    if plan.format == Format::V2
        && let Some([_, again]) = sorted.array_windows().find(|[a, b]| same_route(plan, a, b))
    {
        return Err(Refusal::Duplicate {
            record: again.name.clone(),
        });
    }
    if plan.decides() && plan.is_pod() {
        return check_slices(plan, workers);
    }
    if plan.format == Format::V2 {
        check_gaps(sorted)
    } else {
        Ok(())
    }
}

fn same_route(plan: &Plan, a: &Record, b: &Record) -> bool {
    if plan.decides() {
        a.key == b.key
    } else {
        a.route_id == b.route_id
    }
}

fn check_slices(plan: &Plan, workers: &[Option<&Checkpoint>]) -> Result<(), Refusal> {
    let outside = |slice: &Slice, record: &&Record| !slice.contains(record.key.0);
    for (pair, (slice, worker)) in plan.pairs.iter().zip(workers).enumerate() {
        if let Some(record) = worker
            .iter()
            .flat_map(|worker| &worker.records)
            .find(|record| outside(slice, record))
        {
            let problem = crate::RecordProblem::OutsideSlice {
                first: slice.first,
                last: slice.last,
            };
            return Err(Refusal::Record {
                pair,
                record: record.name.clone(),
                problem,
            });
        }
    }
    Ok(())
}

/// The original's search for a gap. It learns the number of repetitions on its way, so it gives false alarms and misses
/// gaps; without a plan there is nothing better to go by.
fn check_gaps(sorted: &[&Record]) -> Result<(), Refusal> {
    let (mut repetitions, mut last_repetition, mut last_place) = (1, 0, 0);
    let mut before: Option<RecordName> = None;
    for record in sorted {
        let (route, repetition) = record.key;
        if repetition < last_repetition {
            repetitions = last_repetition + 1;
        }
        let place = route * repetitions + repetition;
        if place - last_place > 1 {
            return Err(Refusal::Gap {
                before,
                after: record.name.clone(),
            });
        }
        (last_repetition, last_place) = (repetition, place);
        before = Some(record.name.clone());
    }
    Ok(())
}

fn global(plan: &Plan, unsorted: &[&Record], sorted: &[&Record]) -> Result<Global, Refusal> {
    let global = match plan.format {
        Format::V1 => statistics::v1(unsorted, sorted, plan.as_original)?,
        Format::V2 => statistics::v2(sorted)?,
    };
    if plan.is_pod() {
        let bad = names::metrics(plan.format)
            .iter()
            .find(|metric| !global.metric(metric).as_f64().is_finite());
        if let Some(metric) = bad {
            return Err(Refusal::Metric { metric: metric.name });
        }
    }
    Ok(global)
}

struct Verdict {
    entry_status: &'static str,
    eligible: bool,
    outcome: Outcome,
}

impl Verdict {
    fn of(plan: &Plan, sorted: &[&Record], sensors: &[Text], is_final: bool) -> Self {
        if !is_final {
            return Self {
                entry_status: STARTED,
                eligible: false,
                outcome: Outcome::Running,
            };
        }
        match plan.format {
            Format::V1 => Self::v1(sorted, plan.as_original),
            Format::V2 => Self::v2(sorted, sensors),
        }
    }

    /// The original lets results count although a simulator crashed.
    fn v1(sorted: &[&Record], as_original: bool) -> Self {
        let any = |part| sorted.iter().any(|record| record.status.contains(part));
        let entry_status = if any("Agent") {
            "Finished with agent errors"
        } else {
            "Finished"
        };
        let crashed = any(SIMULATION_CRASHED) && !as_original;
        let outcome = if crashed { Outcome::Crashed } else { Outcome::Finished };
        Self {
            entry_status,
            eligible: !crashed,
            outcome,
        }
    }

    /// The last route that tells of a crash or of wrong sensors decides, as in the original.
    fn v2(sorted: &[&Record], sensors: &[Text]) -> Self {
        let telling = sorted.iter().rev().find_map(|record| {
            if record.status.contains(SIMULATION_CRASHED) {
                Some(Outcome::Crashed)
            } else {
                record.status.contains(SENSORS_INVALID).then_some(Outcome::Rejected)
            }
        });
        let is_invalid = sensors.is_empty() || sorted.iter().any(|record| record.status == STARTED);
        let outcome = if is_invalid {
            Outcome::Invalid
        } else {
            telling.unwrap_or(Outcome::Finished)
        };
        let entry_status = match outcome {
            Outcome::Invalid => "Invalid",
            Outcome::Crashed => "Crashed",
            Outcome::Rejected => "Rejected",
            Outcome::Running | Outcome::Finished => "Finished",
        };
        Self {
            entry_status,
            eligible: outcome == Outcome::Finished,
            outcome,
        }
    }
}

fn partial_score(records: &[&Record]) -> Option<f64> {
    let sum = records
        .iter()
        .fold(0.0, |sum, record| sum + record.scores.composed.as_f64());
    let mean = sum / count(records.len());
    mean.is_finite().then_some(mean)
}

fn pairs(plan: &Plan, workers: &[Option<&Checkpoint>]) -> Vec<PairProgress> {
    let progress = |(pair, worker): (usize, Option<&Checkpoint>)| PairProgress {
        done: worker.map_or(0, Checkpoint::done),
        total: plan.expected_of(pair).or(worker.map(Checkpoint::total)).unwrap_or(0),
        ended: worker.is_some_and(Checkpoint::ended),
    };
    workers.iter().copied().enumerate().map(progress).collect()
}

fn text(
    format: Format,
    records: &[&Record],
    [done, total]: [u32; 2],
    sensors: &[Text],
    global: Option<&Global>,
    verdict: &Verdict,
) -> Result<String, crate::Limit> {
    let values = global.map(Global::values).unwrap_or_default();
    let labels: Vec<&str> = match global {
        Some(_) => names::metrics(format).iter().map(|metric| metric.label).collect(),
        None => Vec::new(),
    };
    let records = (0..)
        .zip(records)
        .map(|(index, record)| record_node(format, index, &record.object))
        .collect();
    let checkpoint = Node::object([
        ("global_record", global.map_or(Node::Object(Vec::new()), Global::node)),
        ("progress", Node::List(vec![Node::int(done), Node::int(total)])),
        ("records", Node::List(records)),
    ]);
    let file = Node::object([
        ("_checkpoint", checkpoint),
        ("entry_status", Node::Str(verdict.entry_status)),
        ("eligible", Node::Bool(verdict.eligible)),
        ("sensors", Node::List(sensors.iter().map(Node::Text).collect())),
        ("values", Node::texts(&values)),
        ("labels", Node::texts(&labels)),
    ]);
    let order = if format == Format::V1 {
        KeyOrder::Sorted
    } else {
        KeyOrder::AsGiven
    };
    write(&file, order)
}

/// The record as it was read, with its index in the merged file. V2 also fills in what is missing and puts the known keys
/// first.
fn record_node(format: Format, index: u32, object: &Object) -> Node<'_> {
    let index = ("index".as_bytes(), Node::int(index));
    let mut entries = match format {
        Format::V1 => vec![index],
        Format::V2 => {
            let known = v2_defaults()
                .into_iter()
                .map(|(key, default)| (key.as_bytes(), object.get(key).map_or(default, Node::Value)));
            std::iter::once(index).chain(known).collect()
        }
    };
    let known = entries.len();
    for (key, value) in object.iter() {
        if entries.iter().take(known).all(|(k, _)| *k != key.as_bytes()) {
            entries.push((key.as_bytes(), Node::Value(value)));
        }
    }
    Node::Object(entries)
}

fn v2_defaults() -> [(&'static str, Node<'static>); 6] {
    let zero = || Node::Number(Number::ZERO);
    let empty = names::infractions(Format::V2)
        .iter()
        .map(|key| (key.as_bytes(), Node::List(Vec::new())))
        .collect();
    [
        ("route_id", Node::Value(&crate::json::Value::Null)),
        ("status", Node::Str(STARTED)),
        ("num_infractions", zero()),
        ("infractions", Node::Object(empty)),
        (
            "scores",
            Node::object([
                ("score_route", zero()),
                ("score_penalty", zero()),
                ("score_composed", zero()),
            ]),
        ),
        (
            "meta",
            Node::object([
                ("route_length", zero()),
                ("duration_game", zero()),
                ("duration_system", zero()),
            ]),
        ),
    ]
}
