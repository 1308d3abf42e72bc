//! Acts of people: submit, re-run, resume; and the messages that follow. Called by the handlers and the control plane under the lock.
//! Pure.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};

use crate::errors::{self, ErrorText};
use crate::model::{Challenge, FileState, Phase, Status, Submission, User};
use crate::python;
use crate::reply::Reply;
use crate::state::State;

/// How an image comes in, and with it what the message lacks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Upload {
    /// As `evalai push`: string keys, the flag, the image.
    #[default]
    Normal,
    /// As `evalai push`, without the image; the input file has it.
    MissingImage,
    /// Fetched from a URL by EvalAI: integer keys, neither flag nor image; the input file has it.
    FileUrl,
    /// As `evalai push`, without the image, and the input file answers 404.
    NoFile,
}

/// The contents of a new submission.
#[derive(Debug, Clone)]
pub struct NewSubmission {
    /// The team's primary key.
    pub team: u64,
    /// The phase's primary key.
    pub phase: u64,
    /// The user who pushes it.
    pub user: u64,
    /// The uploaded file.
    pub input: Vec<u8>,
    /// Texts of the form (`method_name` and the like).
    pub fields: Map<String, Value>,
}

/// The checks of a submission by a user: the phase's and challenge's rows when they succeed.
pub fn check_new<'a>(
    state: &'a State,
    user: &User,
    challenge: u64,
    phase: u64,
) -> Result<(&'a Challenge, &'a Phase), Reply> {
    let challenge = state.challenge(challenge).ok_or(&errors::SUBMIT_NO_CHALLENGE)?;
    let phase = challenge
        .phases
        .iter()
        .find(|row| row.id == phase)
        .ok_or(&errors::SUBMIT_NO_PHASE)?;
    let refusal = if !challenge.is_active {
        Some(&errors::SUBMIT_INACTIVE)
    } else if !phase.is_active {
        Some(&errors::SUBMIT_PHASE_INACTIVE)
    } else if !phase.is_public && !challenge.hosts.contains(&user.id) {
        Some(&errors::SUBMIT_PHASE_PRIVATE)
    } else {
        None
    };
    refusal.map_or(Ok((challenge, phase)), |error| Err(error.into()))
}

/// Refuses a team that has too many submissions under way in the phase.
pub fn check_concurrent(state: &State, team: u64, phase: &Phase) -> Result<(), Reply> {
    let count = state.in_progress(team, phase.id);
    if count >= phase.max_concurrent_submissions_allowed {
        return Err(Reply::error(&errors::SUBMIT_CONCURRENT, &[&count.to_string()]));
    }
    Ok(())
}

/// Stores a submission and hands its key back. Nothing is checked.
pub fn create(state: &mut State, new: NewSubmission, file_state: FileState, now: Timestamp) -> u64 {
    let text = |name: &str| {
        new.fields
            .get(name)
            .and_then(Value::as_str)
            .unwrap_or_default()
            .to_owned()
    };
    let id = state.insert(Submission {
        id: 0,
        participant_team: new.team,
        challenge_phase: new.phase,
        created_by: new.user,
        status: Status::Submitted,
        input_file: None,
        submission_input_file: None,
        stdout_file: None,
        stderr_file: None,
        environment_log_file: None,
        submission_result_file: None,
        submission_metadata_file: None,
        started_at: None,
        completed_at: None,
        submitted_at: now,
        rerun_resumed_at: None,
        when_made_public: None,
        method_name: text("method_name"),
        method_description: text("method_description"),
        project_url: text("project_url"),
        publication_url: text("publication_url"),
        is_public: true,
        is_flagged: false,
        ignore_submission: false,
        is_baseline: false,
        is_verified_by_host: false,
        job_name: Vec::new(),
        submission_metadata: Value::Null,
        submission_number: 0,
        file_state,
    });
    let path = state.store(id, "json", new.input);
    if let Some(submission) = state.submissions.get_mut(&id) {
        submission.input_file = Some(path);
    }
    id
}

/// The image an input file names, or EvalAI's refusal.
pub fn image_of(input: &[u8]) -> Result<String, Reply> {
    let bad = |text: String| Reply::error(&errors::SUBMIT_BAD_FILE, &[&text]);
    let value: Value = python::loads(&String::from_utf8_lossy(input)).map_err(bad)?;
    match value.get("submitted_image_uri") {
        Some(image) => Ok(python::str(image)),
        None => Err(bad("'submitted_image_uri'".to_owned())),
    }
}

/// The message of a new submission. `image` is what the input file names.
pub fn first_message(state: &State, submission: &Submission, upload: Upload, image: Option<&str>) -> Value {
    let (challenge, phase) = keys(state, submission);
    if upload == Upload::FileUrl {
        return json!({"challenge_pk": challenge, "phase_pk": phase, "submission_pk": submission.id});
    }
    let mut message = json!({
        "challenge_pk": challenge.to_string(),
        "phase_pk": phase.to_string(),
        "is_static_dataset_code_upload_submission": is_static(state, challenge),
        "submission_pk": submission.id,
    });
    if let (Upload::Normal, Some(image)) = (upload, image) {
        message["submitted_image_uri"] = Value::from(image);
    }
    message
}

/// The message after a re-run or a resume. None: the input file's host does not answer, and nothing can be sent.
pub fn again_message(state: &State, id: u64) -> Option<Value> {
    let submission = state.submissions.get(&id)?;
    let (challenge, phase) = keys(state, submission);
    let mut message = json!({
        "challenge_pk": challenge,
        "phase_pk": phase,
        "submission_pk": id,
        "is_static_dataset_code_upload_submission": false,
    });
    if !state
        .challenge(challenge)
        .is_some_and(|challenge| challenge.is_docker_based)
    {
        return Some(message);
    }
    match submission.file_state {
        FileState::Unreachable | FileState::Silent => None,
        FileState::Missing | FileState::Gone => Some(message),
        FileState::Stored | FileState::Cut | FileState::Zeros(_) => {
            let content = submission.input_file.as_ref().and_then(|path| state.files.get(path))?;
            message["submitted_image_uri"] = Value::from(image_of(content).ok()?);
            message["is_static_dataset_code_upload_submission"] = Value::from(is_static(state, challenge));
            Some(message)
        }
    }
}

/// True if the images of a challenge leave files that are evaluated later.
fn is_static(state: &State, challenge: u64) -> bool {
    let row = state.challenge(challenge);
    row.is_some_and(|row| row.is_docker_based && row.is_static_dataset_code_upload)
}

fn keys(state: &State, submission: &Submission) -> (u64, u64) {
    (
        state.challenge_of(submission).map_or(0, |challenge| challenge.id),
        submission.challenge_phase,
    )
}

/// Re-runs a submission: the old row is cancelled, a new one copies it. Hands the new key back.
pub fn rerun(state: &mut State, user: &User, id: u64, now: Timestamp) -> Result<u64, Reply> {
    let (mut old, challenge) = again(state, id, &errors::RERUN_DELETED)?;
    let allowed = challenge.allow_participants_resubmissions || user.staff || challenge.hosts.contains(&user.id);
    if !allowed {
        return Err((&errors::RERUN_FORBIDDEN).into());
    }
    if !challenge.is_active {
        return Err(Reply::error(&errors::CHALLENGE_INACTIVE, &[&challenge.title]));
    }
    old.status = Status::Cancelled;
    state.save(old.clone());
    Ok(state.insert(Submission {
        submission_input_file: None,
        stdout_file: None,
        stderr_file: None,
        environment_log_file: None,
        submission_result_file: None,
        submission_metadata_file: None,
        rerun_resumed_at: Some(now),
        ..old
    }))
}

/// Marks a failed submission as resuming, under the same key.
pub fn resume(state: &mut State, user: &User, id: u64, now: Timestamp) -> Result<(), Reply> {
    let (mut submission, challenge) = again(state, id, &errors::RESUME_DELETED)?;
    if submission.status != Status::Failed {
        return Err((&errors::RESUME_NOT_FAILED).into());
    }
    if !challenge.allow_participants_resubmissions && !challenge.hosts.contains(&user.id) {
        return Err((&errors::RESUME_FORBIDDEN).into());
    }
    let refusal = if !challenge.is_active {
        Some(&errors::CHALLENGE_INACTIVE)
    } else if !challenge.remote_evaluation {
        Some(&errors::RESUME_NOT_REMOTE)
    } else if !challenge.allow_resuming_submissions {
        Some(&errors::RESUME_NOT_ALLOWED)
    } else {
        None
    };
    if let Some(error) = refusal {
        return Err(Reply::error(error, &[&challenge.title]));
    }
    submission.status = Status::Resuming;
    submission.rerun_resumed_at = Some(now);
    state.save(submission);
    Ok(())
}

fn again(state: &State, id: u64, deleted: &ErrorText) -> Result<(Submission, Challenge), Reply> {
    let unknown = || Reply::error(&errors::NO_SUCH_SUBMISSION, &[&id.to_string()]);
    let submission = state.submissions.get(&id).ok_or_else(unknown)?;
    if submission.ignore_submission {
        return Err(deleted.into());
    }
    let challenge = state.challenge_of(submission).ok_or_else(unknown)?;
    Ok((submission.clone(), challenge.clone()))
}

/// The submissions that [`bulk`] makes.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Bulk {
    /// How many.
    pub count: u64,
    /// Their phase.
    pub phase: u64,
    /// Their team.
    pub team: u64,
    /// Their status.
    #[serde(default = "cancelled")]
    pub status: Status,
    /// How long ago the newest was submitted, in seconds. The older ones are a second apart.
    #[serde(default = "a_day")]
    pub age_seconds: u32,
}

/// Stores many old submissions at once; no messages. Hands the first and the last key back.
pub fn bulk(state: &mut State, bulk: &Bulk, now: Timestamp) -> Result<(u64, u64), String> {
    state
        .phase(bulk.phase)
        .ok_or_else(|| format!("no phase {}; GET /_stand-in/state lists them", bulk.phase))?;
    let team = state
        .team(bulk.team)
        .ok_or_else(|| format!("no team {}; GET /_stand-in/state lists them", bulk.team))?;
    let user = team.members.first().copied().unwrap_or(0);
    let (mut first, mut last) = (0, 0);
    for index in 0..bulk.count {
        let age = u64::from(bulk.age_seconds) + bulk.count - index;
        let at = now - std::time::Duration::from_secs(age);
        let fields = Map::new();
        let new = NewSubmission {
            team: bulk.team,
            phase: bulk.phase,
            user,
            input: b"{}".to_vec(),
            fields,
        };
        last = create(state, new, FileState::Stored, at);
        if first == 0 {
            first = last;
        }
        if let Some(submission) = state.submissions.get_mut(&last) {
            submission.status = bulk.status;
        }
    }
    Ok((first, last))
}

fn cancelled() -> Status {
    Status::Cancelled
}

fn a_day() -> u32 {
    86_400
}
