//! `status`: one screen of a submission, or one line of each. Pure: the time is handed in.

use jiff::Timestamp;
use kube::ResourceExt;
use leaderboard_api::standings::track_of;
use leaderboard_api::text::sentence;
use leaderboard_api::{State, Submission, SubmissionStatus, Times, Waiting, WorkerState, WorkerStatus, conditions};
use serde_json::{Value, json};

use super::board::{self, Observed};
use super::facts;
use super::table::{bar, table};
use super::text::{Frame, Page, age, join, span};

/// Columns of the bar of a run, and of one worker's.
const BAR: usize = 20;

/// One screen of a submission.
pub fn screen(submission: &Submission, leaderboard: Observed<'_>, frame: Frame) -> Vec<String> {
    let status = facts::status(submission);
    let now = frame.now;
    let mut page = frame.page();
    page.paragraph(&facts::headline(submission, now));
    board::show_problems(&mut page, &submission.spec.leaderboard_name, leaderboard);
    page.gap();
    page.row("Track", &facts::track(submission));
    let message = sentence(status.message.as_deref().unwrap_or_default());
    page.row("Reason", &facts::reason(status, &message));
    page.row("In line", &in_line(status));
    if let Some(progress) = &status.progress {
        let bar = bar(progress.done, progress.total, BAR);
        page.row("Progress", &format!("{bar} {} {}", progress.text, progress.unit));
    }
    for each in &status.workers {
        let has_ended = facts::has_ended(submission);
        page.row(&format!("Worker {}", each.id), &worker(each, has_ended, now));
    }
    page.row("Scores", &scores(status));
    page.row("Times", &times(submission, &status.times, now));
    let node = status.node_name.as_ref();
    let node = node.map(|node| format!("on node {node}")).unwrap_or_default();
    page.row("Job", &join(&[status.job_name.as_deref().unwrap_or_default(), &node]));
    page.row("Systems", &systems(status));
    page.gap();
    links(&mut page, submission, status, leaderboard);
    page.into_lines()
}

fn in_line(status: &SubmissionStatus) -> String {
    let Some(waiting) = &status.waiting else {
        return String::new();
    };
    let eta = facts::eta(waiting).map(|eta| format!("; starts in about {eta}"));
    format!("position {}{}.", waiting.position, eta.unwrap_or_default())
}

/// The score and the metrics, so far until the run has finished.
fn scores(status: &SubmissionStatus) -> String {
    let Some(score) = &status.score else {
        return String::new();
    };
    let score_text = format!("{} {}", score.name, score.text);
    let others = status.metrics.iter();
    let others = others.map(|metric| format!("{} {}", metric.name, metric.value));
    let parts: Vec<String> = std::iter::once(score_text).chain(others).collect();
    let so_far = if score.is_final { "" } else { ", so far" };
    format!("{}{so_far}.", parts.join(", "))
}

/// Where its results are, its challenge, and what to call next.
fn links(page: &mut Page, submission: &Submission, status: &SubmissionStatus, leaderboard: Observed<'_>) {
    page.whole("Results", status.results_url.as_deref().unwrap_or_default());
    let server = leaderboard.leaderboard().and_then(|board| board.spec.evalai.as_ref());
    if let Some((server, evalai)) = server.zip(submission.spec.evalai) {
        let server = server.api_server.trim_end_matches('/');
        let link = format!(
            "{server}/web/challenges/challenge-page/{}/leaderboard",
            evalai.challenge
        );
        page.whole("EvalAI", &link);
    }
    page.whole("Logs", &facts::command("logs", submission));
    page.whole("Next", &facts::command("why", submission));
}

fn worker(worker: &WorkerStatus, has_ended: bool, now: Timestamp) -> String {
    let state = match worker.state {
        WorkerState::Waiting => "waiting",
        WorkerState::Running => "running",
        WorkerState::Done => "done",
        WorkerState::Crashed if has_ended => "given up",
        WorkerState::Crashed => "crashed, starts again",
        WorkerState::Unknown => "",
    };
    let crashes = match worker.crashes {
        0 => String::new(),
        1 => ", 1 crash".to_owned(),
        count => format!(", {count} crashes"),
    };
    let last = worker.last.as_ref().filter(|_| worker.crashes > 0).map(|last| {
        let ago = last.time.as_ref().map(|time| format!(" {} ago", age(time.0, now)));
        format!("; last end {}{}", last.reason, ago.unwrap_or_default())
    });
    let bar = bar(worker.done, worker.total, BAR);
    format!(
        "{bar} {}/{} {state}{crashes}{}",
        worker.done,
        worker.total,
        last.unwrap_or_default()
    )
}

/// The moments of a run, each with the time since the one before.
fn times(submission: &Submission, times: &Times, now: Timestamp) -> String {
    let created = submission.metadata.creation_timestamp.as_ref();
    let moments = [
        ("submitted", times.submitted.as_ref().or(created)),
        ("accepted", times.accepted.as_ref()),
        ("on a node", times.scheduled.as_ref()),
        ("started", times.started.as_ref()),
        ("stopping", times.stopping.as_ref()),
        ("ended", times.finished.as_ref()),
        ("published", times.published.as_ref()),
    ];
    let mut texts = Vec::new();
    let mut before: Option<Timestamp> = None;
    for (what, at) in moments.into_iter().filter_map(|(what, time)| Some((what, time?.0))) {
        texts.push(match before {
            None => format!("{what} {}", super::text::when(at, now)),
            Some(before) => format!("{what} after {}", span(at.duration_since(before).as_secs().max(0))),
        });
        before = Some(at);
    }
    sentence(&texts.join(", "))
}

fn systems(status: &SubmissionStatus) -> String {
    let texts = conditions::SYSTEMS.into_iter().filter_map(|(type_, system)| {
        let condition = conditions::get(&status.conditions, type_)?;
        Some(format!("{system} {}", condition.reason))
    });
    sentence(&texts.collect::<Vec<_>>().join(", "))
}

/// Columns of the list, and those of `-o wide`.
const HEAD: [&str; 7] = ["NAME", "STATE", "REASON", "PROGRESS", "SCORE", "SINCE", "QUEUE"];
const WIDE: [&str; 6] = ["LEADERBOARD", "TRACK", "TEAM", "ATTEMPT", "CRASHES", "NODE"];

/// One line of each submission.
pub fn lines(submissions: &[Submission], is_qualified: bool, is_wide: bool, frame: Frame) -> Vec<String> {
    let now = frame.now;
    let head = [&["NAMESPACE"][..], &HEAD, &WIDE].concat();
    // `-o wide` is printed whole: the person has the space, or accepts broken lines.
    let (left_out, width) = if is_wide {
        (0, usize::MAX)
    } else {
        (WIDE.len(), frame.width)
    };
    let shown = usize::from(!is_qualified)..head.len() - left_out;
    let rows: Vec<Vec<String>> = facts::ordered(submissions, now)
        .into_iter()
        .map(|one| row(one, now)[shown.clone()].to_vec())
        .collect();
    table(&head[shown], &rows, width)
}

fn row(submission: &Submission, now: Timestamp) -> Vec<String> {
    let status = facts::status(submission);
    let text = |text: Option<&str>| text.unwrap_or_default().to_owned();
    let since = facts::since(submission).or_else(|| submission.creation_timestamp().map(|made| made.0));
    let since = since.map(|at| age(at, now));
    let crashes: i32 = status.workers.iter().map(|worker| worker.crashes).sum();
    vec![
        submission.namespace().unwrap_or_default(),
        submission.name_any(),
        status.known_state().map_or("(new)", State::as_str).to_owned(),
        facts::reason(status, "").trim_end_matches(':').to_owned(),
        text(status.progress.as_ref().map(|progress| progress.text.as_str())),
        text(status.score.as_ref().map(|score| score.text.as_str())),
        since.unwrap_or_default(),
        status.waiting.as_deref().map(place).unwrap_or_default(),
        submission.spec.leaderboard_name.clone(),
        text(track_of(submission)),
        submission.team_name().unwrap_or_default(),
        status.attempt.map(|attempt| attempt.to_string()).unwrap_or_default(),
        crashes.to_string(),
        text(status.node_name.as_deref()),
    ]
}

/// `#3, 20m-35m`: the place in line, and how long it may take.
fn place(waiting: &Waiting) -> String {
    let eta = facts::eta(waiting).map(|eta| format!(", {eta}"));
    format!("#{}{}", waiting.position, eta.unwrap_or_default())
}

/// The status as JSON.
pub fn value(submission: &Submission) -> Value {
    json!({
        "name": submission.name_any(),
        "namespace": submission.namespace(),
        "leaderboard": submission.spec.leaderboard_name,
        "status": submission.status,
    })
}
