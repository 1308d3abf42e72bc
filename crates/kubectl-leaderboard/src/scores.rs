//! `scores`: who leads each track. All Submissions rank, and the rows that the Leaderboard has kept of those that are gone.
//!
//! `scores` asks the cluster; all else is pure.

use std::process::ExitCode;

use clap::Args;
use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use kube::ResourceExt;
use leaderboard_api::standings::standings;
use leaderboard_api::{Leaderboard, Ranking, Standing, Submission, TrackStatus};
use serde::Serialize;
use serde_json::json;

use crate::cluster::{Cluster, Filter, Scope};
use crate::commands::frame;
use crate::csv;
use crate::error::{Error, no_leaderboards};
use crate::output::{self, Format, print};
use crate::table::{table, whole_width};
use crate::text::{Frame, columns};

/// Columns to which the name of a team may be cut before a metric is left out.
const TEAM: usize = 16;

/// Arguments of `scores`: the standings to print, and their format.
#[derive(Args, Debug)]
pub struct Scores {
    /// Name of the Leaderboard [default: all of the namespace].
    name: Option<String>,
    /// Name of a track [default: all].
    #[arg(long)]
    track: Option<String>,
    /// All namespaces.
    #[arg(short = 'A', long)]
    all_namespaces: bool,
    /// Output format.
    #[arg(short = 'o', long = "output", value_enum, default_value_t, value_name = "FORMAT")]
    format: Format,
}

/// The standings of one track.
#[derive(Serialize, Debug, PartialEq)]
pub(super) struct Board {
    pub(super) namespace: String,
    pub(super) leaderboard: String,
    pub(super) track: String,
    pub(super) ranking: Option<Ranking>,
    #[serde(rename = "standings")]
    pub(super) rows: Vec<Standing>,
}

/// Prints the standings.
pub async fn scores(cluster: &Cluster, wanted: &Scores) -> Result<ExitCode, Error> {
    let filter = Filter {
        leaderboard: wanted.name.clone(),
        ..Filter::default()
    };
    let scope = Scope {
        all_namespaces: wanted.all_namespaces,
        filter,
        ..Scope::default()
    };
    let leaderboards = match &wanted.name {
        Some(name) if !wanted.all_namespaces => vec![cluster.known_leaderboard(name).await?],
        _ => cluster.leaderboards(&scope).await?.ok_or_else(no_leaderboards)?,
    };
    let submissions = cluster.submissions(&scope).await?;
    let track = wanted.track.as_deref();
    let boards = boards(&leaderboards, &submissions, track);
    if boards.is_empty() {
        return Err(Error::Unfit(nothing(&leaderboards, track, &cluster.namespace)));
    }
    print(&printed(&boards, wanted.format, frame()));
    Ok(ExitCode::SUCCESS)
}

/// Why no track was found, with the next step.
pub(super) fn nothing(leaderboards: &[Leaderboard], track: Option<&str>, namespace: &str) -> String {
    let mut tracks: Vec<&str> = leaderboards
        .iter()
        .flat_map(|board| &board.spec.tracks)
        .map(|track| track.name.as_str())
        .collect();
    tracks.sort_unstable();
    tracks.dedup();
    match track {
        Some(track) if !tracks.is_empty() => format!("there is no track {track}. The tracks are {}", tracks.join(", ")),
        _ => format!("there is no such Leaderboard in namespace {namespace}. Use -n NAMESPACE, or -A"),
    }
}

/// The standings of all tracks of these Leaderboards, or of those with this name.
pub(super) fn boards(leaderboards: &[Leaderboard], submissions: &[Submission], track: Option<&str>) -> Vec<Board> {
    let mut boards = Vec::new();
    for leaderboard in leaderboards {
        let (namespace, name) = (leaderboard.namespace().unwrap_or_default(), leaderboard.name_any());
        let its: Vec<&Submission> = submissions
            .iter()
            .filter(|one| one.spec.leaderboard_name == name && one.namespace().unwrap_or_default() == namespace)
            .collect();
        let tracks = leaderboard.spec.tracks.iter().map(|track| track.name.as_str());
        for track in tracks.filter(|name| track.is_none_or(|track| track == *name)) {
            let shown = leaderboard.status.iter().flat_map(|status| &status.tracks);
            let stored = shown.into_iter().find(|stored| stored.name == track);
            let ranking = stored.and_then(|stored| stored.ranking.clone());
            let kept = stored.map_or(&[][..], |TrackStatus { standings, .. }| standings);
            let rows = ranking
                .as_ref()
                .map(|ranking| standings(track, ranking, its.iter().copied(), kept));
            boards.push(Board {
                namespace: namespace.clone(),
                leaderboard: name.clone(),
                track: track.to_owned(),
                ranking,
                rows: rows.unwrap_or_default(),
            });
        }
    }
    boards
}

fn printed(boards: &[Board], format: Format, frame: Frame) -> Vec<String> {
    match format {
        // All metrics, in columns as wide as they are.
        Format::Wide => {
            let width = usize::MAX;
            text(boards, Frame { width, ..frame })
        }
        Format::Csv => comma_separated(boards),
        format => output::document(format, &json!(boards)).unwrap_or_else(|| text(boards, frame)),
    }
}

/// For people: a table for each track.
pub(super) fn text(boards: &[Board], frame: Frame) -> Vec<String> {
    let is_qualified = boards.iter().any(|board| board.namespace != boards[0].namespace);
    let mut lines = Vec::new();
    for board in boards {
        if !lines.is_empty() {
            lines.push(String::new());
        }
        let by = board.ranking.as_ref().map(|ranking| format!(": {ranking}"));
        let title = format!("{}, track {}{}", board.leaderboard, board.track, by.unwrap_or_default());
        lines.push(if is_qualified {
            format!("{}/{title}", board.namespace)
        } else {
            title
        });
        if board.rows.is_empty() {
            lines.push("No result ranks yet.".to_owned());
        } else {
            lines.extend(of_board(board, frame));
        }
    }
    lines
}

/// The table of a track. Metrics that a narrow page has no room for are left out, the last ones first.
fn of_board(board: &Board, frame: Frame) -> Vec<String> {
    let metric = board.ranking.as_ref().map_or("", |ranking| ranking.metric.as_str());
    let mut metrics = metric_names(&board.rows);
    loop {
        let (head, rows) = cells(&board.rows, metric, &metrics);
        if metrics.is_empty() || fits(&head, &rows, frame.width) {
            let head: Vec<&str> = head.iter().map(String::as_str).collect();
            return table(&head, &rows, frame.width);
        }
        metrics.pop();
    }
}

fn cells(rows: &[Standing], metric: &str, metrics: &[&str]) -> (Vec<String>, Vec<Vec<String>>) {
    let head = ["RANK", "TEAM", metric].into_iter().chain(metrics.iter().copied());
    let head = head.chain(["SUBMISSION", "WHEN"]).map(str::to_uppercase);
    let row = |row: &Standing| {
        let team = if row.team.is_empty() { "(none)" } else { &row.team };
        let mut cells = vec![row.rank.to_string(), team.to_owned(), row.score.text.clone()];
        cells.extend(
            metrics
                .iter()
                .map(|name| row.metric(name).unwrap_or_default().to_owned()),
        );
        cells.push(row.submission.clone());
        cells.push(row.finished_at.as_ref().map(minute).unwrap_or_default());
        cells
    };
    (head.collect(), rows.iter().map(row).collect())
}

/// True if a table fits with only the names of teams cut, to `TEAM` columns.
fn fits(head: &[String], rows: &[Vec<String>], width: usize) -> bool {
    let teams = rows.iter().filter_map(|row| row.get(1));
    let widest = teams.map(|team| columns(team)).max().unwrap_or(0);
    whole_width(head, rows) <= width.saturating_add(widest.saturating_sub(TEAM))
}

fn minute(time: &Time) -> String {
    time.0.strftime("%Y-%m-%d %H:%MZ").to_string()
}

/// Names of the metrics of all rows, beside the one that ranks, as they come.
fn metric_names<'a>(rows: impl IntoIterator<Item = &'a Standing>) -> Vec<&'a str> {
    let mut names: Vec<&str> = Vec::new();
    for metric in rows.into_iter().flat_map(|row| &row.metrics) {
        if !names.contains(&metric.name.as_str()) {
            names.push(&metric.name);
        }
    }
    names
}

/// The standings for a spreadsheet: one line for each row of all tracks.
pub(super) fn comma_separated(boards: &[Board]) -> Vec<String> {
    let metrics = metric_names(boards.iter().flat_map(|board| &board.rows));
    let mut head = vec!["namespace", "leaderboard", "track", "rank", "team", "metric", "score"];
    head.extend(&metrics);
    head.extend(["submission", "attempt", "submitted", "finished"]);
    let mut lines = vec![csv::line(head)];
    let exact = |time: Option<&Time>| time.map(|time| exact(time.0)).unwrap_or_default();
    for board in boards {
        for row in &board.rows {
            let rank = row.rank.to_string();
            let attempt = row.attempt.map(|attempt| attempt.to_string()).unwrap_or_default();
            let (submitted, finished) = (exact(row.submitted_at.as_ref()), exact(row.finished_at.as_ref()));
            let mut cells = vec![
                board.namespace.as_str(),
                &board.leaderboard,
                &board.track,
                &rank,
                &row.team,
            ];
            cells.extend([row.score.name.as_str(), &row.score.value]);
            cells.extend(metrics.iter().map(|name| row.metric(name).unwrap_or_default()));
            cells.extend([row.submission.as_str(), &attempt, &submitted, &finished]);
            lines.push(csv::line(cells));
        }
    }
    lines
}

fn exact(time: Timestamp) -> String {
    time.strftime("%Y-%m-%dT%H:%M:%SZ").to_string()
}
