//! The control plane under `/_stand-in/`: what a test or a demo does that EvalAI has no endpoint for. No signing in, no
//! throttle, not in the log. Called by `server`.

use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value, json};

use crate::app::{App, now};
use crate::handlers::publish;
use crate::model::FileState;
use crate::reply::{Answer, Reply};
use crate::seed::Seed;
use crate::state::State;
use crate::submissions::{self, Bulk, NewSubmission, Upload};

/// A push without the checks of the API.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Submit {
    team: Name,
    phase: u64,
    /// The image that the uploaded file names.
    image: Option<String>,
    /// The uploaded file itself, in place of one that names an image.
    content: Option<String>,
    #[serde(default)]
    file: Upload,
    #[serde(default)]
    method_name: String,
}

/// A primary key or a name.
#[derive(Debug, Deserialize)]
#[serde(untagged)]
enum Name {
    Key(u64),
    Name(String),
}

#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Reset {
    seed: Option<Seed>,
    first_submission: Option<u64>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct SetFile {
    submission: u64,
    state: FileState,
}

/// Answers a request below `/_stand-in/`.
pub(crate) async fn answer(app: &App, method: &str, path: &str, query: &[(String, String)], body: &[u8]) -> Reply {
    let answer = match (method, path) {
        ("GET", "health") => Ok(done()),
        ("GET", "state") => Ok(Reply::ok(&whole(&app.state()))),
        ("GET", "requests") => Ok(Reply::ok(&requests(app, query))),
        ("DELETE", "requests") => {
            app.log().clear();
            Ok(done())
        }
        ("GET", "knobs") => Ok(Reply::ok(&json!(*app.knobs()))),
        ("POST", "knobs") => set_knobs(app, body),
        ("POST", "submit") => submit(app, body).await,
        ("POST", "bulk") => bulk(app, body),
        ("POST", "file") => set_file(app, body),
        ("POST", "expire") => {
            app.state().expire_addresses();
            Ok(done())
        }
        ("POST", "reset") => reset(app, body),
        _ => Err(wrong(
            &format!("{method} /_stand-in/{path} is not known; local/evalai/README.md lists what is"),
            404,
        )),
    };
    answer.unwrap_or_else(|error| error)
}

fn done() -> Reply {
    Reply::ok(&json!({"ok": true}))
}

fn wrong(text: &str, status: u16) -> Reply {
    Reply::json(status, &json!({ "error": text }))
}

/// A body; an empty one is `{}`.
fn read<T: DeserializeOwned>(body: &[u8]) -> Result<T, Reply> {
    let body = if body.is_empty() { b"{}" } else { body };
    serde_json::from_slice(body).map_err(|error| wrong(&error.to_string(), 400))
}

/// Everything, with the files' sizes in place of the files.
fn whole(state: &State) -> Value {
    let files: Map<_, _> = state
        .files
        .iter()
        .map(|(path, content)| (path.clone(), content.len().into()))
        .collect();
    let mut whole = json!(state);
    whole["files"] = Value::Object(files);
    whole
}

/// The log; `method`, `path` (a part of it) and `after` (an id) select.
fn requests(app: &App, query: &[(String, String)]) -> Value {
    let asked = |name: &str| {
        query
            .iter()
            .find(|(key, _)| key == name)
            .map(|(_, value)| value.as_str())
    };
    let after = asked("after").and_then(|after| after.parse().ok()).unwrap_or(0);
    let log = app.log();
    let entries = log.entries().filter(|entry| {
        entry.id > after
            && asked("method").is_none_or(|method| entry.method.eq_ignore_ascii_case(method))
            && asked("path").is_none_or(|path| entry.path.contains(path))
    });
    json!(entries.collect::<Vec<_>>())
}

fn set_knobs(app: &App, body: &[u8]) -> Answer {
    let change: Map<String, Value> = read(body)?;
    let mut knobs = app.knobs();
    let changed = knobs.changed(&change).map_err(|error| wrong(&error, 400))?;
    if changed.throttle != knobs.throttle {
        app.forget_throttle();
    }
    *knobs = changed;
    Ok(Reply::ok(&json!(*knobs)))
}

async fn submit(app: &App, body: &[u8]) -> Answer {
    let asked: Submit = read(body)?;
    let (id, message) = {
        let mut state = app.state();
        let new = new_submission(&state, &asked)?;
        let file_state = if asked.file == Upload::NoFile {
            FileState::Missing
        } else {
            FileState::Stored
        };
        let id = submissions::create(&mut state, new, file_state, now());
        let row = state.submissions.get(&id).ok_or_else(Reply::server_error)?;
        let docker = state
            .challenge_of(row)
            .is_some_and(|challenge| challenge.is_docker_based);
        (
            id,
            submissions::first_message(&state, row, asked.file, asked.image.as_deref().filter(|_| docker)),
        )
    };
    publish(app, id, message.clone()).await?;
    Ok(Reply::json(201, &json!({"submission": id, "message": message})))
}

fn new_submission(state: &State, asked: &Submit) -> Result<NewSubmission, Reply> {
    let team = state.seed.teams.iter().find(|team| match &asked.team {
        Name::Key(id) => team.id == *id,
        Name::Name(name) => team.name == *name,
    });
    let known: Vec<_> = state.seed.teams.iter().map(|team| team.name.as_str()).collect();
    let team = team.ok_or_else(|| wrong(&format!("no such team; there are {}", known.join(", ")), 400))?;
    state
        .phase(asked.phase)
        .ok_or_else(|| wrong(&format!("no phase {}", asked.phase), 400))?;
    let input = match (&asked.content, &asked.image) {
        (Some(content), _) => content.clone(),
        (None, Some(image)) => json!({ "submitted_image_uri": image }).to_string(),
        (None, None) => return Err(wrong("neither image nor content", 400)),
    };
    Ok(NewSubmission {
        team: team.id,
        phase: asked.phase,
        user: team.members.first().copied().unwrap_or(0),
        input: input.into_bytes(),
        fields: Map::from_iter([("method_name".to_owned(), Value::from(asked.method_name.as_str()))]),
    })
}

fn bulk(app: &App, body: &[u8]) -> Answer {
    let asked: Bulk = read(body)?;
    let (first, last) = submissions::bulk(&mut app.state(), &asked, now()).map_err(|error| wrong(&error, 400))?;
    Ok(Reply::json(201, &json!({"first": first, "last": last})))
}

fn set_file(app: &App, body: &[u8]) -> Answer {
    let asked: SetFile = read(body)?;
    let mut state = app.state();
    let row = state.submissions.get_mut(&asked.submission);
    row.ok_or_else(|| wrong(&format!("no submission {}", asked.submission), 404))?
        .file_state = asked.state;
    Ok(done())
}

fn reset(app: &App, body: &[u8]) -> Answer {
    let asked: Reset = read(body)?;
    let mut state = app.state();
    let mut seed = asked.seed.unwrap_or_else(|| state.seed.clone());
    seed.first_submission = asked.first_submission.unwrap_or(seed.first_submission);
    *state = State::new(seed);
    drop(state);
    *app.knobs() = crate::faults::Knobs::default();
    app.log().clear();
    app.forget_throttle();
    Ok(done())
}
