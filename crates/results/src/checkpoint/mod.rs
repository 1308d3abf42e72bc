//! A worker's checkpoint file: bytes to a typed checkpoint, or a reason why not. Called once per worker and round; the
//! merge takes what comes out. Knows one file at a time: what concerns several workers is the merge's.

mod plausible;
mod record;
mod verify;

pub(crate) use record::{Meta, Record, Scores};

use crate::json::{self, Limit, ReadError, Text, Value};
use crate::names::{CRASHED, FINISHED, INVALID};
use crate::plan::Verify;
use crate::{Plan, RecordName, RecordProblem, Refusal};

const MAX_RECORDS: usize = 10_000;
const MAX_SENSORS: usize = 1_000;
/// A file can't promise more route runs than this.
const MAX_TOTAL: i128 = 1_000_000;

/// File of one worker, checked as far as one file can be.
#[derive(Clone, Debug)]
pub struct Checkpoint {
    pub(crate) records: Vec<Record>,
    pub(crate) total: u32,
    done: u32,
    /// How many the evaluator itself counts, after which it resumes. V1 writes a route's record first and the count after it.
    counted: u32,
    pub(crate) sensors: Vec<Text>,
    end: End,
    /// Sensors are in this file, or were in one that it continues. The first file that is read may have had one before it, if a route
    /// in it was begun.
    has_named_sensors: bool,
    warnings: Vec<String>,
}

/// How the evaluator itself ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum End {
    /// It did not: the file has no global record.
    Open,
    /// It calls its results finished and eligible.
    Good,
    /// It calls them something else.
    Bad,
    /// It calls the file invalid, and starts at the first route if it is started again.
    Invalid,
}

impl Checkpoint {
    /// How many routes the worker has finished.
    ///
    /// In a pod, a route that the evaluator repeats is not finished, although its record is still there: one in which the
    /// simulation crashed, and one that the evaluator's own count has not reached.
    pub fn done(&self) -> u32 {
        self.done
    }

    /// How many the file promises.
    pub fn total(&self) -> u32 {
        self.total
    }

    /// True if the evaluator came to its regular end: the file has a global record of its own. After a crashed simulation it
    /// has none, even when no route is missing.
    pub fn ended(&self) -> bool {
        self.end != End::Open
    }

    /// True where the evaluator came to its end and calls its results good, and sensors have been named: in this file, or in one that
    /// it continues. An evaluator of V2 that is started on a complete file writes it again without them.
    pub(crate) fn counts_without_sensors(&self) -> bool {
        self.end == End::Good && self.has_named_sensors
    }

    /// This checkpoint as the one after `earlier` of the same worker; `None` if it has less: routes, the global record or the sensors.
    /// Then the earlier one counts, as a whole: parts of two files are not the results of one drive.
    #[must_use]
    pub fn after(mut self, earlier: &Self) -> Option<Self> {
        let reached = |checkpoint: &Self| {
            let Self { done, counted, .. } = *checkpoint;
            (done, counted, checkpoint.ended(), !checkpoint.sensors.is_empty())
        };
        // After an invalid end an evaluator begins anew.
        if earlier.end != End::Invalid && reached(&self) < reached(earlier) {
            return None;
        }
        self.has_named_sensors = !self.sensors.is_empty() || (earlier.has_named_sensors && self.continues(earlier));
        Some(self)
    }

    /// True if it has the same records of the routes that were done.
    fn continues(&self, earlier: &Self) -> bool {
        let done = earlier.records.iter().take(count(earlier.done));
        let same = |(own, old): (&Record, &Record)| own.object == old.object;
        self.records.len() >= done.len() && self.records.iter().zip(done).all(same)
    }

    /// The records of the routes that are done.
    pub(crate) fn done_records(&self) -> impl Iterator<Item = &Record> {
        self.records.iter().take(count(self.done))
    }

    /// True if a record says that the simulation crashed. It is the agent's own word.
    pub fn names_crash(&self) -> bool {
        self.records.iter().any(Record::names_crash)
    }

    /// Records whose scores do not follow from their infractions, one sentence each.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }
}

fn count(records: u32) -> usize {
    usize::try_from(records).unwrap_or(usize::MAX)
}

/// Reads the file of the worker at position `pair` (from 0) of the plan.
///
/// `Ok(None)`: there is nothing yet; the file is empty, half-written or not JSON, and another round will find it whole.
pub fn read_worker(plan: &Plan, pair: usize, bytes: &[u8]) -> Result<Option<Checkpoint>, Refusal> {
    let value = match json::read(bytes, plan.limits_of(pair)) {
        Ok(value) => value,
        Err(ReadError::NotJson) => return Ok(None),
        Err(ReadError::NotUtf8) => return Err(Refusal::NotUtf8 { pair }),
        Err(ReadError::Limit(limit)) => return Err(Refusal::Limit { pair, limit }),
    };
    if value.is_falsy() {
        return Ok(None);
    }
    let file = File::of(pair, value)?;
    if plan.is_pod() && file.progress.is_empty() && file.records.is_empty() {
        return Ok(None);
    }
    let sensors = sensors(plan, pair, &file.sensors)?;
    let total = total(plan, pair, &file.progress)?;
    let counted = match file.progress.first() {
        Some(Value::Int(counted)) => u32::try_from(*counted).unwrap_or(0),
        _ => 0,
    };
    let records = records(plan, pair, file.records)?;
    if plan.is_pod() {
        plausible::check_file(plan, pair, total, &records)?;
    }
    let warnings = verified(plan, pair, &records)?;
    Ok(Some(Checkpoint {
        done: done(plan, file.end, file.has_crashed, counted, &records),
        has_named_sensors: !sensors.is_empty() || records.iter().any(Record::was_begun),
        records,
        total,
        counted,
        sensors,
        end: file.end,
        warnings,
    }))
}

/// How many routes are done. The evaluator goes by the same count and the same text when it resumes.
fn done(plan: &Plan, end: End, has_crashed: bool, counted: u32, records: &[Record]) -> u32 {
    let found = u32::try_from(records.len()).unwrap_or(u32::MAX);
    if end != End::Open || !plan.is_pod() || plan.as_original {
        return found;
    }
    found.saturating_sub(u32::from(has_crashed)).min(counted)
}

/// The parts of the JSON that are used, taken out of it.
struct File {
    records: Vec<Value>,
    progress: Vec<Value>,
    sensors: Value,
    end: End,
    has_crashed: bool,
}

impl File {
    fn of(pair: usize, value: Value) -> Result<Self, Refusal> {
        let shape = |place, wanted| shape(pair, place, wanted);
        let Value::Object(mut outer) = value else {
            return Err(shape("the whole file", "an object"));
        };
        let Some(Value::Object(mut inner)) = outer.take("_checkpoint") else {
            return Err(shape("_checkpoint", "an object"));
        };
        let entry_status = outer.get("entry_status").and_then(Value::as_str);
        let has_crashed = entry_status == Some(CRASHED);
        let is_eligible = matches!(outer.get("eligible"), Some(Value::Bool(true)));
        let end = match entry_status {
            _ if inner.get("global_record").is_none_or(Value::is_falsy) => End::Open,
            Some(FINISHED) if is_eligible => End::Good,
            Some(INVALID) => End::Invalid,
            _ => End::Bad,
        };
        let mut list = |key: &str, place| match inner.take(key) {
            Some(Value::List(list)) => Ok(list),
            _ => Err(shape(place, "a list")),
        };
        Ok(Self {
            records: list("records", "_checkpoint.records")?,
            progress: list("progress", "_checkpoint.progress")?,
            sensors: outer.take("sensors").ok_or_else(|| shape("sensors", "a list"))?,
            end,
            has_crashed,
        })
    }
}

fn shape(pair: usize, place: &'static str, wanted: &'static str) -> Refusal {
    Refusal::Shape { pair, place, wanted }
}

fn sensors(plan: &Plan, pair: usize, value: &Value) -> Result<Vec<Text>, Refusal> {
    if value.is_falsy() {
        return Ok(Vec::new());
    }
    let list = value.as_list().ok_or(shape(pair, "sensors", "a list"))?;
    if list.len() > MAX_SENSORS {
        let limit = Limit::Sensors;
        return Err(Refusal::Limit { pair, limit });
    }
    let mut sensors = Vec::with_capacity(list.len());
    for (sensor, item) in (1..).zip(list) {
        let Value::Text(text) = item else {
            return Err(shape(pair, "sensors", "a list of names"));
        };
        if plan.is_pod() && text.as_str().and_then(crate::names::sensor_name).is_none() {
            let pair = Some(pair);
            return Err(Refusal::Sensor { pair, sensor });
        }
        sensors.push(text.clone());
    }
    Ok(sensors)
}

fn total(plan: &Plan, pair: usize, progress: &[Value]) -> Result<u32, Refusal> {
    let shape = shape(pair, "_checkpoint.progress", "a pair of whole numbers");
    let [done, Value::Int(total @ 0..=MAX_TOTAL), ..] = progress else {
        return Err(shape);
    };
    let is_pair = matches!(done, Value::Int(0..=MAX_TOTAL)) && progress.len() == 2;
    if plan.is_pod() && !is_pair {
        return Err(shape);
    }
    u32::try_from(*total).map_err(|_| shape)
}

fn records(plan: &Plan, pair: usize, values: Vec<Value>) -> Result<Vec<Record>, Refusal> {
    if values.len() > MAX_RECORDS {
        let limit = Limit::Records;
        return Err(Refusal::Limit { pair, limit });
    }
    let mut records = Vec::with_capacity(values.len());
    for (place, value) in (1..).zip(values) {
        let record = Record::of(plan.format, place, value);
        records.push(record.map_err(|(record, problem)| refused(pair, record, problem))?);
    }
    Ok(records)
}

fn refused(pair: usize, record: RecordName, problem: RecordProblem) -> Refusal {
    Refusal::Record { pair, record, problem }
}

fn verified(plan: &Plan, pair: usize, records: &[Record]) -> Result<Vec<String>, Refusal> {
    let mut warnings = Vec::new();
    if plan.verify == Verify::Disabled {
        return Ok(warnings);
    }
    for record in records {
        if let Err(problem) = verify::check(plan.format, record) {
            let refusal = refused(pair, record.name.clone(), problem);
            if plan.verify == Verify::Refuse {
                return Err(refusal);
            }
            warnings.push(refusal.to_string());
        }
    }
    Ok(warnings)
}
