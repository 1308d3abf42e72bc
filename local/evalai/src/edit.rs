//! `update_submission_meta`: what hosts write into any row of their challenge, and participants into their own. The
//! server checks the type of a field and nothing else. Called by the handlers under the lock. Pure.

use jiff::Timestamp;
use serde_json::{Map, Value, json};

use crate::body::Form;
use crate::errors;
use crate::model::{Status, Submission};
use crate::python;
use crate::reply::Reply;
use crate::state::State;
use crate::update::key;
use crate::views;

const NULL: &str = "This field may not be null.";
const NO_TIME: &str = "Datetime has wrong format. Use one of these formats instead: \
    YYYY-MM-DDThh:mm[:ss[.uuuuuu]][+HH:MM|-HH:MM|Z].";
const NO_FILE: &str = "The submitted data was not a file. Check the encoding type on the form.";

/// Writes the named fields into a copy of a row, whatever they are, and publishes nothing. All wrong fields are named
/// in one answer.
pub fn edit(state: &mut State, submission: &mut Submission, form: &Form) -> Result<(), Reply> {
    let mut wrong = Map::new();
    for (name, value) in &form.fields {
        if let Err(text) = edit_field(state, submission, name, value) {
            wrong.insert(name.clone(), json!([text]));
        }
    }
    if !wrong.is_empty() {
        return Err(Reply::json(400, &Value::Object(wrong)));
    }
    let id = submission.id;
    for (name, content) in &form.files {
        if let Some(file) = file_of(submission, name) {
            let extension = if name.ends_with("log_file") || name.starts_with("std") {
                "txt"
            } else {
                "json"
            };
            *file = Some(state.store(id, extension, content.clone()));
        }
    }
    Ok(())
}

fn edit_field(state: &State, row: &mut Submission, name: &str, value: &Value) -> Result<(), String> {
    match name {
        "participant_team" => row.participant_team = related(value, |id| state.team(id).is_some())?,
        "challenge_phase" => row.challenge_phase = related(value, |id| state.phase(id).is_some())?,
        "created_by" => row.created_by = related(value, |id| state.user(id).is_some())?,
        "status" => row.status = status(value)?,
        "started_at" => row.started_at = time(value)?,
        "completed_at" => row.completed_at = time(value)?,
        "rerun_resumed_at" => row.rerun_resumed_at = time(value)?,
        "when_made_public" => row.when_made_public = time(value)?,
        "job_name" => row.job_name = texts(value)?,
        "method_name" => row.method_name = text(value)?,
        "method_description" => row.method_description = text(value)?,
        "project_url" => row.project_url = text(value)?,
        "publication_url" => row.publication_url = text(value)?,
        "is_public" => row.is_public = truth(value)?,
        "is_flagged" => row.is_flagged = truth(value)?,
        "ignore_submission" => row.ignore_submission = truth(value)?,
        "is_baseline" => row.is_baseline = truth(value)?,
        "is_verified_by_host" => row.is_verified_by_host = truth(value)?,
        "submission_metadata" => row.submission_metadata = value.clone(),
        "input_file" if value.is_null() => return Err(NULL.to_owned()),
        _ => match file_of(row, name) {
            Some(file) if value.is_null() => *file = None,
            Some(_) => return Err(NO_FILE.to_owned()),
            None => {}
        },
    }
    Ok(())
}

fn file_of<'a>(row: &'a mut Submission, name: &str) -> Option<&'a mut Option<String>> {
    Some(match name {
        "input_file" => &mut row.input_file,
        "submission_input_file" => &mut row.submission_input_file,
        "stdout_file" => &mut row.stdout_file,
        "stderr_file" => &mut row.stderr_file,
        "environment_log_file" => &mut row.environment_log_file,
        "submission_result_file" => &mut row.submission_result_file,
        _ => return None,
    })
}

/// The key of a row in another table.
fn related(value: &Value, known: impl Fn(u64) -> bool) -> Result<u64, String> {
    if value.is_null() || value == "" {
        return Err(NULL.to_owned());
    }
    let wrong_type = |_| {
        format!(
            "Incorrect type. Expected pk value, received {}.",
            python::type_name(value)
        )
    };
    let found = key(value).map_err(wrong_type)?.filter(|id| known(*id));
    found.ok_or_else(|| format!("Invalid pk \"{}\" - object does not exist.", python::str(value)))
}

fn status(value: &Value) -> Result<Status, String> {
    if value.is_null() {
        return Err(NULL.to_owned());
    }
    let status = value.as_str().and_then(Status::parse);
    status.ok_or_else(|| errors::INVALID_CHOICE.message(&[&python::str(value)]))
}

fn time(value: &Value) -> Result<Option<Timestamp>, String> {
    if value.is_null() {
        return Ok(None);
    }
    let at = value.as_str().and_then(|text| views::parse_time(text).ok());
    at.map(Some).ok_or_else(|| NO_TIME.to_owned())
}

fn texts(value: &Value) -> Result<Vec<String>, String> {
    match value {
        Value::Array(items) => items.iter().filter(|item| !item.is_null()).map(text).collect(),
        Value::Null => Ok(Vec::new()),
        other => {
            let name = python::type_name(other);
            Err(format!("Expected a list of items but got type \"{name}\"."))
        }
    }
}

fn text(value: &Value) -> Result<String, String> {
    match value {
        Value::String(text) => Ok(text.clone()),
        Value::Number(number) => Ok(number.to_string()),
        Value::Null => Err(NULL.to_owned()),
        _ => Err("Not a valid string.".to_owned()),
    }
}

fn truth(value: &Value) -> Result<bool, String> {
    match python::str(value).to_lowercase().as_str() {
        _ if value.is_null() => Err(NULL.to_owned()),
        "true" | "t" | "y" | "yes" | "on" | "1" => Ok(true),
        "false" | "f" | "n" | "no" | "off" | "0" => Ok(false),
        _ => Err("Must be a valid boolean.".to_owned()),
    }
}
