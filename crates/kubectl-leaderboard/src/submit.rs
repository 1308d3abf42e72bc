//! `submit`: an image or a file on a track of a Leaderboard, without EvalAI. Pure: `upload` puts the file into the bucket.

use std::path::PathBuf;

use clap::Args;
use kube::ResourceExt;
use leaderboard_api::{Submission, names};
use serde_json::{Value, json};

use crate::board::{self, Observed};
use crate::facts::command;
use crate::text::Frame;

/// Arguments of `submit`.
#[derive(Args, Debug)]
pub struct Submit {
    /// Name of the Leaderboard.
    #[arg(long)]
    pub leaderboard: String,
    /// Name of the track.
    #[arg(long)]
    pub track: String,
    /// Image of the agent.
    #[arg(long, required_unless_present = "file", conflicts_with = "file")]
    pub image: Option<String>,
    /// File in place of an image, for a Leaderboard of the mode Predictions. Your own program aws puts it into the bucket.
    #[arg(long)]
    pub file: Option<PathBuf>,
    /// Endpoint of the bucket, if it is not AWS's, that may get your AWS credentials.
    #[arg(long, value_name = "URL", requires = "file", conflicts_with = "image")]
    pub endpoint: Option<String>,
    /// Name of the submission [default: the Leaderboard's, and five letters].
    #[arg(long)]
    pub name: Option<String>,
    /// Id of the team. Without one, no table gets a row.
    #[arg(long, value_name = "ID")]
    pub team_id: Option<String>,
    /// Name of the team.
    #[arg(long, value_name = "NAME")]
    pub team: Option<String>,
    /// Higher goes first within a team.
    #[arg(long, default_value_t = 0, allow_hyphen_values = true)]
    pub priority: i32,
    /// Wait for the end, and print each state until then.
    #[arg(long)]
    pub wait: bool,
}

/// Refuses a file or an image where the Leaderboard takes the other, and a track that it lacks, with the next step. An unreadable
/// Leaderboard passes: the operator checks it.
pub fn fits(name: &str, track: &str, is_file: bool, leaderboard: Observed<'_>) -> Result<(), String> {
    let Some(found) = leaderboard.leaderboard() else {
        return Ok(());
    };
    let takes_file = found.spec.evaluation.takes_files();
    if takes_file != is_file {
        let (takes, flag) = if takes_file {
            ("files and no images, as its mode is Predictions", "--file FILE")
        } else {
            (
                "images and no files, which are for the mode Predictions",
                "--image IMAGE",
            )
        };
        return Err(format!(
            "Leaderboard {name} takes {takes}. Use `kubectl leaderboard submit {flag}`"
        ));
    }
    let tracks: Vec<&str> = found.spec.tracks.iter().map(|track| track.name.as_str()).collect();
    if tracks.contains(&track) {
        return Ok(());
    }
    Err(format!(
        "Leaderboard {name} has no track {track}. It has {}",
        tracks.join(", ")
    ))
}

/// Lines about the new submission, the obstacles to its start, and the commands to follow it.
pub fn lines(created: &Submission, leaderboard: Observed<'_>, frame: Frame) -> Vec<String> {
    let (spec, mut page) = (&created.spec, frame.page());
    page.paragraph(&format!(
        "Submitted {} to track {} of Leaderboard {}.",
        created.name_any(),
        spec.track.as_deref().unwrap_or_default(),
        spec.leaderboard_name
    ));
    board::show_problems(&mut page, &spec.leaderboard_name, leaderboard);
    page.paragraph(&format!("To follow it: `{} -w`.", command("status", created)));
    page.into_lines()
}

/// The most characters of a name but for the API server's five letters.
const LONGEST: usize = 47;

/// The object to create.
pub fn object(wanted: &Submit) -> Value {
    let mut spec = json!({
        "leaderboardName": wanted.leaderboard, "track": wanted.track, "image": wanted.image, "priority": wanted.priority,
    });
    for (key, value) in [("id", &wanted.team_id), ("name", &wanted.team)] {
        if let Some(value) = value {
            spec["team"][key] = json!(value);
        }
    }
    let mut object = manifest("", &wanted.leaderboard, &spec);
    if let Some(name) = &wanted.name {
        (object["metadata"]["name"], object["metadata"]["generateName"]) = (json!(name), Value::Null);
    }
    object
}

/// A Submission whose name begins like this, and goes on with its Leaderboard's.
pub(super) fn manifest(prefix: &str, leaderboard: &str, spec: &Value) -> Value {
    let short: String = leaderboard.chars().take(LONGEST - 1 - prefix.len()).collect();
    json!({
        "apiVersion": format!("{}/{}", leaderboard_api::GROUP, leaderboard_api::VERSION),
        "kind": "Submission",
        "metadata": {
            "generateName": format!("{prefix}{}-", short.trim_end_matches('-')),
            "labels": {names::LABEL_LEADERBOARD: leaderboard},
        },
        "spec": spec,
    })
}
