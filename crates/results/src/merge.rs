//! The merge: several workers' checkpoints to one file, one verdict. Called once a round with whatever the workers have
//! so far; it keeps no state, so a run that was interrupted merges like one that was not.

use crate::checkpoint::{Checkpoint, Record};
use crate::json::{Node, Object, Text, write};
use crate::names::{self, STARTED, Score};
use crate::number::{Number, count};
use crate::statistics::{self, Global};
use crate::verdict::Ending;
use crate::{Format, Outcome, Plan, RecordName, Refusal};

/// How far one pair is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PairProgress {
    /// Routes finished, each repetition counted.
    pub done: u32,
    /// Routes the pair has to drive, each repetition counted.
    pub total: u32,
    /// True if the evaluator came to its regular end; see [`Checkpoint::ended`].
    pub ended: bool,
}

/// Sum of the workers' files.
#[derive(Clone, Debug)]
pub struct Merged {
    /// The merged file, as the original writes it.
    pub text: String,
    /// Routes finished, each repetition counted.
    pub done: u32,
    /// Routes to drive: the plan's when it is known, else the sum of what the files have.
    pub total: u32,
    /// True if nothing is missing, so that there is a global record.
    pub is_final: bool,
    /// True if the results count. In V2 the merged file may deny it, as the original does where no worker's file names sensors any more.
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

impl Merged {
    /// Mean route completion in percent, over all routes once the run is final, before over those that are done.
    pub fn route_completion(&self) -> Option<f64> {
        self.mean(Score::Route)
    }

    /// Mean infraction penalty, a factor, over the same routes.
    pub fn infraction_penalty(&self) -> Option<f64> {
        self.mean(Score::Penalty)
    }

    fn mean(&self, score: Score) -> Option<f64> {
        let global = self.view.global.as_ref().or(self.view.so_far.as_ref())?;
        Some(global.means.get(score).as_f64()).filter(|mean| mean.is_finite())
    }
}

/// Parts of the merged file that the renderers need.
#[derive(Clone, Debug)]
pub(crate) struct View {
    pub(crate) sensors: Vec<Text>,
    pub(crate) routes: Vec<Line>,
    pub(crate) global: Option<Global>,
    /// Global record over the routes done so far; only before the run is final. It is no part of the merged file.
    pub(crate) so_far: Option<Global>,
}

/// One line of the route glossary; durations in seconds.
#[derive(Clone, Debug)]
pub(crate) struct Line {
    pub(crate) route_id: String,
    pub(crate) status: String,
    pub(crate) game: Number,
    pub(crate) system: Number,
}

impl Merged {
    /// The `entry_status`, or how the run ended where the merged file has another: V1 has none for `Crashed` and `Rejected`, and V2 calls
    /// files without sensors invalid.
    pub fn ended_as(&self) -> &str {
        match self.outcome {
            Outcome::Crashed => names::CRASHED,
            Outcome::Rejected => names::REJECTED,
            Outcome::Finished if self.entry_status == names::INVALID => names::FINISHED,
            Outcome::Running | Outcome::Finished | Outcome::Invalid => &self.entry_status,
        }
    }
}

/// Merges what the workers have so far; `workers` in the order of the plan's pairs, `None` for one without a readable file.
pub fn merge(plan: &Plan, workers: &[Option<&Checkpoint>]) -> Result<Merged, Refusal> {
    check_plan(plan, workers)?;
    let sensors = sensors(workers)?;
    let unsorted: Vec<&Record> = workers.iter().flatten().flat_map(|worker| &worker.records).collect();
    let sorted = by_route(&unsorted);

    let done = sum(workers, Checkpoint::done);
    let total = plan.expected().unwrap_or_else(|| sum(workers, Checkpoint::total));
    let is_final = total != 0 && done == total && is_complete(plan, workers);
    if is_final {
        check_routes(plan, &sorted)?;
    }
    let done_unsorted = done_records(workers);
    let done_sorted = by_route(&done_unsorted);
    let so_far = if is_final {
        None
    } else {
        global_so_far(plan, &done_unsorted, &done_sorted)
    };
    let global = is_final.then(|| global(plan, &unsorted, &sorted)).transpose()?;
    let ending = Ending::of(plan, workers, (&sorted, &sensors), is_final);
    let text = text(plan.format, &sorted, [done, total], &sensors, global.as_ref(), &ending)
        .map_err(|limit| Refusal::Output { limit })?;
    Ok(Merged {
        text,
        done,
        total,
        is_final,
        eligible: ending.outcome == Outcome::Finished,
        entry_status: ending.entry_status.to_owned(),
        outcome: ending.outcome,
        score: global.as_ref().map(|global| global.means.composed.as_f64()),
        partial_score: partial_score(&done_sorted),
        pairs: pairs(plan, workers),
        warnings: warnings(workers),
        view: View {
            sensors,
            routes: sorted.iter().map(|record| Line::of(record)).collect(),
            global,
            so_far,
        },
    })
}

fn check_plan(plan: &Plan, workers: &[Option<&Checkpoint>]) -> Result<(), Refusal> {
    plan.check()?;
    let (pairs, files) = (plan.pairs.len(), workers.len());
    if plan.decides() && pairs != files {
        let problem = format!("it has {pairs} pairs, but there are {files} workers");
        return Err(Refusal::Plan { problem });
    }
    Ok(())
}

fn sum(workers: &[Option<&Checkpoint>], of: fn(&Checkpoint) -> u32) -> u32 {
    workers
        .iter()
        .flatten()
        .map(|worker| of(worker))
        .fold(0, u32::saturating_add)
}

fn warnings(workers: &[Option<&Checkpoint>]) -> Vec<String> {
    let all = workers.iter().flatten().flat_map(|worker| worker.warnings());
    all.cloned().collect()
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
fn check_routes(plan: &Plan, sorted: &[&Record]) -> Result<(), Refusal> {
    if plan.format == Format::V1 {
        return Ok(());
    }
    if let Some([_, again]) = sorted.array_windows().find(|[a, b]| same_route(plan, a, b)) {
        let record = again.name.clone();
        return Err(Refusal::Duplicate { record });
    }
    // A Pod has read no record outside its pair's slice, so as many as there are routes leave no gap.
    if plan.decides() && plan.is_pod() {
        return Ok(());
    }
    check_gaps(sorted)
}

fn same_route(plan: &Plan, a: &Record, b: &Record) -> bool {
    if plan.decides() {
        a.key == b.key
    } else {
        a.route_id == b.route_id
    }
}

/// The original's search for a gap. It learns the number of repetitions on its way, so it gives false alarms and misses
/// gaps; without a plan there is nothing better to go by.
fn check_gaps(sorted: &[&Record]) -> Result<(), Refusal> {
    let (mut repetitions, mut last_repetition, mut last_place) = (1, 0, 0);
    let mut before: Option<RecordName> = None;
    for record in sorted {
        let (route, repetition) = record.key;
        if repetition < last_repetition {
            repetitions = i64::saturating_add(last_repetition, 1);
        }
        let place = route.saturating_mul(repetitions).saturating_add(repetition);
        if place.saturating_sub(last_place) > 1 {
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

fn by_route<'a>(records: &[&'a Record]) -> Vec<&'a Record> {
    let mut sorted = records.to_vec();
    sorted.sort_by_key(|record| record.key);
    sorted
}

/// The records of the routes that are done, in the order of the files: a route that its evaluator is going to repeat is not.
fn done_records<'a>(workers: &[Option<&'a Checkpoint>]) -> Vec<&'a Record> {
    let workers = workers.iter().flatten();
    let done = workers.flat_map(|worker| worker.done_records());
    done.collect()
}

/// The global record over a part of the routes. None before the first, and where a metric has no finite value: a run is refused
/// for that only at its end.
fn global_so_far(plan: &Plan, unsorted: &[&Record], sorted: &[&Record]) -> Option<Global> {
    if unsorted.is_empty() {
        return None;
    }
    let global = global(plan, unsorted, sorted).ok()?;
    let is_finite = |metric: &names::Metric| global.metric(metric).as_f64().is_finite();
    names::metrics(plan.format).iter().all(is_finite).then_some(global)
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
    ending: &Ending,
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
        ("entry_status", Node::Str(ending.entry_status)),
        ("eligible", Node::Bool(ending.eligible)),
        ("sensors", Node::List(sensors.iter().map(Node::Text).collect())),
        ("values", Node::texts(&values)),
        ("labels", Node::texts(&labels)),
    ]);
    write(&file, format.key_order())
}

/// The keys of a V2 record, in their order.
const V2_KEYS: [&str; 6] = ["route_id", "status", "num_infractions", "infractions", "scores", "meta"];

/// The record as it was read, with its index in the merged file. V2 also fills in what is missing and puts the known keys
/// first.
fn record_node(format: Format, index: u32, object: &Object) -> Node<'_> {
    let mut entries = Vec::with_capacity(object.len().saturating_add(1));
    entries.push(("index".as_bytes(), Node::int(index)));
    if format == Format::V2 {
        let value = |key| object.get(key).map_or_else(|| v2_default(key), Node::Value);
        entries.extend(V2_KEYS.map(|key| (key.as_bytes(), value(key))));
    }
    let known = entries.len();
    for (key, value) in object.iter() {
        if entries.iter().take(known).all(|(k, _)| *k != key.as_bytes()) {
            entries.push((key.as_bytes(), Node::Value(value)));
        }
    }
    Node::Object(entries)
}

fn v2_default(key: &str) -> Node<'static> {
    let zeros = |keys: [&'static str; 3]| Node::object(keys.map(|key| (key, Node::int(0))));
    match key {
        "status" => Node::Str(STARTED),
        "num_infractions" => Node::int(0),
        "infractions" => {
            let names = names::infractions(Format::V2).iter();
            Node::Object(names.map(|key| (key.as_bytes(), Node::List(Vec::new()))).collect())
        }
        "scores" => zeros(["score_route", "score_penalty", "score_composed"]),
        "meta" => zeros(["route_length", "duration_game", "duration_system"]),
        _ => Node::Value(&crate::json::Value::Null),
    }
}
