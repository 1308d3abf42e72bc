//! Makes manifests with comments from the original's entries. Pure.
//!
//! Every text of an entry stands in quotation marks, as JSON writes it, so it adds no field and no object.

use std::collections::BTreeSet;
use std::str::FromStr;

use leaderboard_api::DOCUMENTS;
use serde_json::{Value, json};

use super::Import;
use super::entries::{Board, EVALAI, Pipeline, Track};
use crate::text::wrap;

/// Columns of a line of the first comment.
const WIDTH: usize = 116;

/// The URL of an SQS queue.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Queue(String);

impl FromStr for Queue {
    type Err = String;

    fn from_str(url: &str) -> Result<Self, Self::Err> {
        let rest = url.strip_prefix("https://").or_else(|| url.strip_prefix("http://"));
        let is_url =
            rest.is_some_and(|rest| rest.split('/').count() == 3 && rest.bytes().all(|b| b.is_ascii_graphic()));
        let example = "https://sqs.us-west-2.amazonaws.com/123456789012/leaderboard";
        is_url
            .then(|| Self(url.to_owned()))
            .ok_or_else(|| format!("a queue's URL is such as {example}"))
    }
}

impl Queue {
    /// The region that a URL of AWS names.
    fn region(&self) -> Option<&str> {
        self.0
            .split_once("://sqs.")?
            .1
            .split_once('.')
            .map(|(region, _)| region)
    }
}

/// All that is printed for a namespace.
pub(super) fn yaml(pipeline: &Pipeline, wanted: &Import, namespace: &str) -> String {
    let namespace = quoted(namespace);
    let boards = pipeline.boards.iter();
    let boards = boards.map(|board| leaderboard(pipeline, board, wanted, &namespace));
    let start = format!(include_str!("namespace.yaml.in"), namespace = namespace);
    let heading = heading(pipeline, wanted, &namespace);
    format!("{heading}{start}{}", boards.collect::<String>())
}

/// The first comment.
fn heading(pipeline: &Pipeline, wanted: &Import, namespace: &str) -> String {
    let mut dropped = String::new();
    for line in &pipeline.dropped {
        let marks = std::iter::once("# - ").chain(std::iter::repeat("#   "));
        let lines = wrap(line, WIDTH).into_iter().zip(marks);
        dropped.extend(lines.flat_map(|(line, mark)| [mark.to_owned(), line, "\n".to_owned()]));
    }
    if !dropped.is_empty() {
        dropped.insert_str(0, "#\n# Not taken over:\n");
    }
    format!(
        "# Made by `kubectl leaderboard import` from the original pipeline's entries in Secrets Manager.\n\
         # Go through each comment that begins with \"To decide\".\n\
         {dropped}#\n\
         {}",
        values(pipeline, wanted, namespace)
    )
}

/// Leaderboards may name only what the chart's values allow.
fn values(pipeline: &Pipeline, wanted: &Import, namespace: &str) -> String {
    let names = |name: fn(&Board) -> Option<&String>| {
        let names: BTreeSet<&String> = pipeline.boards.iter().filter_map(name).collect();
        json!(names)
    };
    format!(
        "# Values of the operator's chart for these objects:\n\
         #   leaderboards:\n\
         #   - namespace: {namespace}\n\
         #     secretsManager: [{EVALAI}]\n\
         #     queues: [{}]\n\
         #     buckets: {}\n\
         #     tables: {}\n\
         #     logGroups: {}\n",
        quoted(&wanted.queue.0),
        names(|board| Some(&board.bucket)),
        names(|board| Some(&board.table)),
        names(|board| board.log_group.as_ref()),
    )
}

fn leaderboard(pipeline: &Pipeline, board: &Board, wanted: &Import, namespace: &str) -> String {
    let tracks: Vec<String> = board.tracks.iter().map(|of| track(board, of)).collect();
    let region = &board.place.region;
    format!(
        include_str!("leaderboard.yaml.in"),
        entry = board.original.entry,
        namespace = namespace,
        api_server = quoted(&pipeline.api_server),
        challenge = wanted.challenge,
        token_region = quoted(&pipeline.token_region),
        queue = quoted(&wanted.queue.0),
        queue_region = quoted(wanted.queue.region().unwrap_or(region)),
        version = board.original.version,
        repetitions = board.original.repetitions,
        tracks = tracks.join("\n"),
        contents_image = quoted(&board.contents_image),
        simulator_image = quoted(&board.simulator_image),
        display = board.original.display,
        bucket = quoted(&board.bucket),
        region = quoted(region),
        table = quoted(&board.table),
        log_group = log_group(board),
        role = quoted(&board.place.role),
        nodes = board.original.nodes,
    )
}

fn track(board: &Board, track: &Track) -> String {
    let scenarios = board.original.scenarios_file;
    let scenarios = scenarios.map(|file| format!("\n      scenariosFile: {file}"));
    format!(
        "  - name: {}\n    carla:\n      codename: {}\n      routesFile: /workspace/leaderboard/data/routes_testing.xml{}\n    phase: {}\n    \
         nodeSelector:\n      node.kubernetes.io/instance-type: g5.12xlarge\n    \
         tolerations:\n    - key: nvidia.com/gpu\n      operator: Exists\n      effect: NoSchedule",
        quoted(&board.track_name(track)),
        quoted(&track.codename),
        scenarios.unwrap_or_default(),
        track.phase,
    )
}

fn log_group(board: &Board) -> String {
    match &board.log_group {
        Some(name) => format!(
            "  # To decide: does a program on these nodes collect what containers print (FluentD, Fluent Bit, the CloudWatch agent)?\n  \
             # Then each line is stored twice: {DOCUMENTS}import.md#logs-twice\n  \
             logs:\n    cloudWatch:\n      name: {}\n      region: {}",
            quoted(name),
            quoted(&board.place.region)
        ),
        None => "  # To decide: logs.cloudWatch, a group of CloudWatch Logs; the entry has no cloudwatch_log_group."
            .to_owned(),
    }
}

/// A text as YAML and JSON write it.
fn quoted(text: &str) -> String {
    Value::from(text).to_string()
}

#[cfg(test)]
mod tests;
