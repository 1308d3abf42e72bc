//! The one page for people, and the proxy's error pages. Pure: the state in, HTML out.

use std::fmt::Write as _;

use serde_json::Value;

use crate::leaderboards;
use crate::model::{Challenge, Phase, Split, Submission};
use crate::state::State;
use crate::views;

const HEAD: &str = "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
<meta http-equiv=\"refresh\" content=\"5\"><title>EvalAI stand-in</title><style>\
body{font:15px/1.4 system-ui,sans-serif;margin:2rem;max-width:80rem}\
table{border-collapse:collapse;margin:.5rem 0 1.5rem;display:block;overflow-x:auto}\
th,td{border:1px solid #ccc;padding:.2rem .5rem;text-align:left;white-space:nowrap}\
th{background:#eee}td.number{text-align:right}caption{text-align:left;font-weight:600}</style></head><body>\
<h1>EvalAI stand-in</h1><p>What a host and the participants would see in EvalAI. The page loads again every 5 s.</p>\n";

/// The page: submissions, newest first, and the leaderboards that have entries.
pub(crate) fn overview(state: &State) -> String {
    let mut page = HEAD.to_owned();
    for challenge in &state.seed.challenges {
        let phases = challenge.phases.iter();
        let boards: String = phases
            .flat_map(|phase| phase.splits.iter().map(move |split| (phase, split)))
            .map(|(phase, split)| leaderboard(state, phase, split))
            .collect();
        let submissions = submissions(state, challenge);
        if !boards.is_empty() || !submissions.is_empty() {
            let _ = write!(page, "<h2>{}</h2>\n{boards}{submissions}", escape(&challenge.title));
        }
    }
    if state.submissions.is_empty() {
        page.push_str("<p>Nobody has submitted yet.</p>");
    }
    page.push_str("</body></html>\n");
    page
}

fn leaderboard(state: &State, phase: &Phase, split: &Split) -> String {
    let Ok(entries) = leaderboards::entries(state, split.id, None) else {
        let phase = escape(&phase.name);
        return format!("<p>Leaderboard: {phase}: the API answers 500, for a metric is a bool.</p>\n");
    };
    if entries.is_empty() {
        return String::new();
    }
    let labels = cells("th", split.schema.labels.iter().map(|label| escape(label)));
    let mut table = format!(
        "<table><caption>Leaderboard: {}</caption><tr><th>Rank</th><th>Team</th><th>Submission</th>{labels}</tr>\n",
        escape(&phase.name)
    );
    for (rank, entry) in (1..).zip(&entries) {
        let text = |name: &str| {
            entry[name]
                .as_str()
                .map_or_else(|| entry[name].to_string(), str::to_owned)
        };
        let metrics = entry["result"].as_array().into_iter().flatten();
        let metrics = cells("td class=\"number\"", metrics.map(|value| escape(&number(value))));
        let team = escape(&text("submission__participant_team__team_name"));
        let _ = writeln!(
            table,
            "<tr><td>{rank}</td><td>{team}</td><td>{}</td>{metrics}</tr>",
            text("submission__id")
        );
    }
    table + "</table>\n"
}

/// One table cell for each text.
fn cells(tag: &str, texts: impl Iterator<Item = String>) -> String {
    texts.fold(String::new(), |cells, text| cells + "<" + tag + ">" + &text)
}

fn submissions(state: &State, challenge: &Challenge) -> String {
    let of_challenge = |row: &&Submission| state.challenge_of(row).is_some_and(|of| of.id == challenge.id);
    let rows: Vec<_> = state.submissions.values().rev().filter(of_challenge).collect();
    if rows.is_empty() {
        return String::new();
    }
    let mut table = "<table><caption>Submissions</caption><tr><th>Key</th><th>Team</th><th>Phase</th><th>Status</th>\
        <th>Submitted</th><th>Started</th><th>Completed</th><th>Files</th></tr>\n"
        .to_owned();
    for row in rows.into_iter().take(200) {
        let team = state.team(row.participant_team).map_or("", |team| team.name.as_str());
        let phase = state
            .phase(row.challenge_phase)
            .map_or("", |(_, phase)| phase.name.as_str());
        let time = |at: Option<jiff::Timestamp>| at.map_or_else(|| "–".to_owned(), views::time);
        let deleted = if row.ignore_submission { " (deleted)" } else { "" };
        let _ = writeln!(
            table,
            "<tr><td>{}</td><td>{}</td><td>{}</td><td>{}{deleted}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td></tr>",
            row.id,
            escape(team),
            escape(phase),
            row.status.as_str(),
            views::time(row.submitted_at),
            time(row.started_at),
            time(row.completed_at),
            files(row),
        );
    }
    table + "</table>\n"
}

fn files(row: &Submission) -> String {
    let all = [
        ("input", &row.input_file),
        ("stdout", &row.stdout_file),
        ("stderr", &row.stderr_file),
        ("environment log", &row.environment_log_file),
        ("result", &row.submission_result_file),
        ("metadata", &row.submission_metadata_file),
    ];
    let link = |(name, path): (&str, &Option<String>)| {
        path.as_ref()
            .map(|path| format!("<a href=\"/media/{}\">{name}</a>", escape(path)))
    };
    all.into_iter().filter_map(link).collect::<Vec<_>>().join(" ")
}

/// A metric for people: at most two digits after the point.
pub(crate) fn number(value: &Value) -> String {
    match value {
        Value::Number(number) if number.is_f64() => format!("{:.2}", number.as_f64().unwrap_or_default()),
        Value::String(text) => text.clone(),
        other => other.to_string(),
    }
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}

/// The page of the proxy in front of EvalAI when EvalAI does not answer it.
pub(crate) fn gateway_error(status: u16) -> String {
    let title = match status {
        502 => "502 Bad Gateway",
        503 => "503 Service Temporarily Unavailable",
        _ => "504 Gateway Time-out",
    };
    format!(
        "<html>\r\n<head><title>{title}</title></head>\r\n<body>\r\n<center><h1>{title}</h1></center>\r\n\
         <hr><center>nginx</center>\r\n</body>\r\n</html>\r\n"
    )
}
