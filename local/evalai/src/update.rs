//! Writes of a host's worker: progress, results and partial results. Called by the handlers under the lock.
//!
//! Pure, and in two halves as in the server: `prepare_*` reads rows and checks the request, [`commit`] saves the copies
//! whole. Whatever happens between the two is overwritten, or doubled where both halves of two requests interleave.

use jiff::Timestamp;
use serde::Deserialize;
use serde_json::{Map, Value};

use crate::body::Form;
use crate::errors;
use crate::model::{LeaderboardRow, Split, Status, Submission};
use crate::python;
use crate::reply::Reply;
use crate::state::State;

/// Which of the two endpoints for updates was called.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Door {
    /// `jobs/challenge/{c}/update_submission/`
    Update,
    /// `jobs/challenges/{c}/update_partially_evaluated_submission/`
    Partial,
}

/// The texts of an evaluation; none leaves the present file as it is.
#[derive(Debug, Clone, Default, PartialEq)]
struct Texts {
    stdout: String,
    stderr: String,
    environment_log: Option<String>,
    result: String,
    metadata: Option<String>,
}

/// Copies of rows, ready to be saved.
#[derive(Debug, Clone, PartialEq)]
pub struct Write {
    /// Answered with the submission instead of the sentence.
    pub progress: bool,
    submission: Submission,
    rows: Vec<LeaderboardRow>,
    texts: Option<Texts>,
}

impl Write {
    /// True if the write ends the submission.
    pub fn is_end(&self) -> bool {
        matches!(
            self.submission.status,
            Status::Finished | Status::Failed | Status::Cancelled
        )
    }
}

/// Checks a PUT and reads what it will overwrite.
pub fn prepare_put(state: &State, door: Door, form: &Form) -> Result<Write, Reply> {
    let status = form.text("submission_status")?.to_lowercase();
    let mut texts = Texts {
        stdout: form.text("stdout")?,
        stderr: form.text("stderr")?,
        ..Texts::default()
    };
    if door == Door::Update {
        texts.environment_log = Some(form.text("environment_log")?);
    }
    texts.metadata = Some(form.fields.get("metadata").map(python::str).unwrap_or_default());
    let mut submission = named(state, form)?;
    submission.status = match (Status::parse(&status), door) {
        (Some(status @ (Status::Finished | Status::Failed | Status::Cancelled)), _)
        | (Some(status @ Status::PartiallyEvaluated), Door::Partial) => status,
        _ => return Err((&errors::INVALID_STATUS).into()),
    };
    let (mut rows, mut shown) = (Vec::new(), Vec::new());
    if matches!(submission.status, Status::Finished | Status::PartiallyEvaluated) {
        let mode = if door == Door::Update {
            Mode::Put
        } else {
            Mode::PutPartial
        };
        (rows, shown) = check_results(state, &submission, form, mode)?;
    }
    texts.result = format!("[{}]", shown.join(", "));
    Ok(Write {
        progress: false,
        submission,
        rows,
        texts: Some(texts),
    })
}

/// Checks a PATCH and reads what it will overwrite. `now` becomes `started_at` of a submission under way.
pub fn prepare_patch(state: &State, door: Door, form: &Form, now: Timestamp) -> Result<Write, Reply> {
    let read = || {
        Ok::<_, Reply>((
            form.text("submission_status")?.to_lowercase(),
            form.text("job_name")?.to_lowercase(),
        ))
    };
    // The two endpoints find the submission and read the body in different orders.
    let (mut submission, (status, job_name)) = match door {
        Door::Update => (named(state, form)?, read()?),
        Door::Partial => {
            let texts = read()?;
            (named(state, form)?, texts)
        }
    };
    if !job_name.is_empty() {
        submission.job_name.push(job_name);
    }
    let status = Status::parse(&status);
    match (status, door) {
        (Some(status @ Status::Running), _) | (Some(status @ Status::Queued), Door::Update) => {
            submission.status = status;
            submission.started_at = Some(now);
            Ok(Write {
                progress: true,
                submission,
                rows: Vec::new(),
                texts: None,
            })
        }
        (Some(status @ (Status::PartiallyEvaluated | Status::Finished)), Door::Partial) => {
            let (rows, shown) = check_results(state, &submission, form, Mode::Merge)?;
            submission.status = status;
            let texts = Texts {
                stdout: form.text("stdout")?,
                stderr: form.text("stderr")?,
                result: format!("[{}]", shown.join(", ")),
                ..Texts::default()
            };
            Ok(Write {
                progress: false,
                submission,
                rows,
                texts: Some(texts),
            })
        }
        _ => Err((&errors::INVALID_STATUS).into()),
    }
}

/// Saves the copies: leaderboard rows, new files, then the whole submission as it was read and changed. Hands the
/// submission back.
pub fn commit(state: &mut State, write: Write, now: Timestamp) -> Submission {
    for row in write.rows {
        state.save_row(row);
    }
    let mut submission = write.submission;
    if let Some(texts) = write.texts {
        submission.completed_at = Some(now);
        let id = submission.id;
        let mut store = |extension, text: String| Some(state.store(id, extension, text.into_bytes()));
        submission.stdout_file = store("txt", texts.stdout);
        submission.stderr_file = store("txt", texts.stderr);
        submission.submission_result_file = store("json", texts.result);
        if let Some(text) = texts.environment_log {
            submission.environment_log_file = store("txt", text);
        }
        if let Some(text) = texts.metadata {
            submission.submission_metadata_file = store("json", text);
        }
    }
    state.save(submission.clone());
    submission
}

fn named(state: &State, form: &Form) -> Result<Submission, Reply> {
    let value = form.value("submission");
    let submission = key(value)?.and_then(|id| state.submissions.get(&id)).cloned();
    submission.ok_or_else(|| Reply::error(&errors::SUBMISSION_NOT_FOUND, &[&python::str(value)]))
}

/// A primary key sent as a number, cut as Python's `int` cuts it, or as its decimal text. None: no row has it. A value that is no number
/// raises in the server.
pub(crate) fn key(value: &Value) -> Result<Option<u64>, Reply> {
    let text = match value {
        Value::Null => return Ok(None),
        Value::Number(number) => match number.as_f64() {
            Some(float) if number.is_f64() => format!("{:.0}", float.trunc()),
            _ => number.to_string(),
        },
        Value::String(text) => text.trim().to_owned(),
        _ => String::new(),
    };
    let digits = text.strip_prefix(['-', '+']).unwrap_or(&text);
    if digits.is_empty() || !digits.bytes().all(|byte| byte.is_ascii_digit()) {
        return Err(Reply::server_error());
    }
    Ok(text.parse().ok())
}

/// The three ways a result is checked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Mode {
    Put,
    PutPartial,
    Merge,
}

fn check_results(
    state: &State,
    submission: &Submission,
    form: &Form,
    mode: Mode,
) -> Result<(Vec<LeaderboardRow>, Vec<String>), Reply> {
    let mut rows = Vec::new();
    let mut shown = Vec::new();
    let mut orders = orders(form).into_iter();
    for item in results(form)? {
        let order = orders.next().unwrap_or_default();
        let Value::Object(item) = item else {
            return Err(Reply::server_error());
        };
        let split = split_of(state, form, &item)?;
        let accuracies = item.get("accuracies").and_then(Value::as_object);
        let row = match (mode, accuracies) {
            (Mode::Merge, _) => {
                let row = state.row(submission.id, split.id)?.ok_or_else(|| no_row(form))?.clone();
                let accuracies = accuracies.ok_or_else(Reply::server_error)?;
                check_metrics(state, form, split, accuracies, mode)?;
                let merged = row.result.into_iter().chain(accuracies.clone()).collect();
                LeaderboardRow { result: merged, ..row }
            }
            (_, None) => return Err(Reply::server_error()),
            (_, Some(accuracies)) => {
                check_metrics(state, form, split, accuracies, mode)?;
                let id = state.row(submission.id, split.id)?.map_or(0, |row| row.id);
                LeaderboardRow {
                    id,
                    submission: submission.id,
                    split: split.id,
                    result: accuracies.clone(),
                }
            }
        };
        if row.result.values().any(python::is_not_finite) {
            return Err((&errors::RESULT_NOT_FINITE).into());
        }
        rows.push(row);
        if item.get("show_to_participant").is_some_and(python::truthy) {
            let sent = |name: &'_ String| accuracies.and_then(|all| all.get_key_value(name));
            let sent = order.iter().filter_map(sent);
            shown.push(python::repr_dict(sent.map(|(name, value)| (name.as_str(), value))));
        }
    }
    Ok((rows, shown))
}

/// The items of `result`: a list inside a string. Any other value that Python can walk over without an error is empty.
fn results(form: &Form) -> Result<Vec<Value>, Reply> {
    let invalid = |error: String| Reply::error(&errors::RESULT_INVALID, &[&error]);
    let parsed: Value = match form.fields.get("result") {
        None => python::loads("").map_err(invalid)?,
        Some(Value::String(text)) => python::loads(text).map_err(invalid)?,
        Some(other) => return Err(invalid(python::loads_type_error(other))),
    };
    match parsed {
        Value::Array(items) => Ok(items),
        Value::Object(fields) if fields.is_empty() => Ok(Vec::new()),
        Value::String(text) if text.is_empty() => Ok(Vec::new()),
        _ => Err(Reply::server_error()),
    }
}

/// The metrics of each item in the order they were sent.
fn orders(form: &Form) -> Vec<Vec<String>> {
    #[derive(Deserialize)]
    struct Item {
        accuracies: python::Keys,
    }
    let text = form.value("result").as_str().unwrap_or_default();
    let items: Vec<Item> = python::loads(text).unwrap_or_default();
    items.into_iter().map(|item| item.accuracies.0).collect()
}

fn split_of<'a>(state: &'a State, form: &Form, item: &Map<String, Value>) -> Result<&'a Split, Reply> {
    let phase = form.value("challenge_phase");
    let codename = item.get("split").unwrap_or(&Value::Null);
    let found = key(phase)?.and_then(|id| state.phase(id)).and_then(|(_, phase)| {
        phase
            .splits
            .iter()
            .find(|split| Some(split.dataset_split.codename.as_str()) == codename.as_str())
    });
    found.ok_or_else(|| Reply::error(&errors::SPLIT_NOT_FOUND, &[&python::str(phase), &python::str(codename)]))
}

fn no_row(form: &Form) -> Reply {
    let values = [
        python::str(form.value("challenge_phase")),
        python::str(form.value("submission")),
    ];
    Reply::error(&errors::NO_LEADERBOARD_DATA, &[&values[0], &values[1]])
}

fn check_metrics(
    state: &State,
    form: &Form,
    split: &Split,
    accuracies: &Map<String, Value>,
    mode: Mode,
) -> Result<(), Reply> {
    let unknown: Vec<_> = accuracies
        .keys()
        .map(String::as_str)
        .filter(|name| !split.has(name))
        .collect();
    let lenient = mode != Mode::Put
        && state
            .split(split.id)
            .is_some_and(|(_, phase, _)| phase.is_partial_submission_evaluation_enabled);
    if !unknown.is_empty() && !lenient {
        let names = python::repr_list(&unknown);
        if mode == Mode::Put {
            return Err(Reply::error(&errors::METRICS_UNKNOWN, &[&names]));
        }
        let phase = python::str(form.value("challenge_phase"));
        return Err(Reply::error(&errors::METRICS_UNKNOWN_PARTIAL, &[&names, &phase]));
    }
    malformed(accuracies)
}

/// Refuses values that are not numbers; Python takes a bool for one.
fn malformed(accuracies: &Map<String, Value>) -> Result<(), Reply> {
    let number = |value: &Value| value.is_number() || value.is_boolean() || python::is_not_finite(value);
    let wrong: Vec<_> = accuracies
        .iter()
        .filter(|(_, v)| !number(v))
        .map(|(name, v)| (name.as_str(), v))
        .collect();
    if wrong.is_empty() {
        return Ok(());
    }
    Err(Reply::error(&errors::METRICS_MALFORMED, &[&python::repr_types(&wrong)]))
}

/// A host's correction of a leaderboard row: the labels must match exactly. Hands the new row back.
pub fn correct_row(row: &LeaderboardRow, split: &Split, form: &Form) -> Result<LeaderboardRow, Reply> {
    let invalid = |error: String| Reply::error(&errors::ROW_INVALID, &[&error]);
    let data: Value = match form.value("leaderboard_data") {
        Value::Null => return Err((&errors::ROW_BLANK).into()),
        Value::String(text) => python::loads(text).map_err(invalid)?,
        other => return Err(invalid(python::loads_type_error(other))),
    };
    let Value::Object(result) = data else {
        return Err(Reply::server_error());
    };
    let missing: Vec<_> = split
        .schema
        .labels
        .iter()
        .map(String::as_str)
        .filter(|name| !result.contains_key(*name))
        .collect();
    let extra: Vec<_> = result
        .keys()
        .map(String::as_str)
        .filter(|name| !split.has(name))
        .collect();
    let (missing_names, extra_names) = (python::repr_list(&missing), python::repr_list(&extra));
    match (missing.is_empty(), extra.is_empty()) {
        (false, false) => Err(Reply::error(
            &errors::ROW_MISSING_AND_EXTRA,
            &[&missing_names, &extra_names],
        )),
        (false, true) => Err(Reply::error(&errors::ROW_MISSING, &[&missing_names])),
        (true, false) => Err(Reply::error(&errors::ROW_EXTRA, &[&extra_names])),
        (true, true) => {
            malformed(&result)?;
            if result.values().any(python::is_not_finite) {
                return Err((&errors::RESULT_NOT_FINITE).into());
            }
            Ok(LeaderboardRow { result, ..row.clone() })
        }
    }
}

impl Split {
    fn has(&self, metric: &str) -> bool {
        self.schema.labels.iter().any(|label| label == metric)
    }
}
