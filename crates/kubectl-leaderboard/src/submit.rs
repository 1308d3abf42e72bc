//! `submit`: an image on a track of a Leaderboard, without EvalAI. Pure.

use clap::Args;
use leaderboard_api::names;
use serde_json::{Value, json};

use crate::board::Observed;

/// What is submitted.
#[derive(Args, Debug)]
pub struct Submit {
    /// Name of the Leaderboard.
    #[arg(long)]
    pub leaderboard: String,
    /// Name of the track.
    #[arg(long)]
    pub track: String,
    /// Image of the agent.
    #[arg(long)]
    pub image: String,
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

/// Whether the Leaderboard is there and has the track; the text has the next step. `elsewhere` are the namespaces that have one of its name.
pub fn fits(wanted: &Submit, leaderboard: Observed<'_>, namespace: &str, elsewhere: &[String]) -> Result<(), String> {
    let name = &wanted.leaderboard;
    let found = match leaderboard {
        Observed::Found(found) => found,
        Observed::Missing => {
            let next = match elsewhere.first() {
                Some(other) => format!("There is one in namespace {}: use -n {other}", elsewhere.join(", ")),
                None => format!("`kubectl get leaderboards -n {namespace}` lists all; use -n for another namespace"),
            };
            return Err(format!(
                "there is no Leaderboard {name} in namespace {namespace}. {next}"
            ));
        }
        // The operator will know.
        Observed::Forbidden => return Ok(()),
    };
    let tracks: Vec<&str> = found.spec.tracks.iter().map(|track| track.name.as_str()).collect();
    if tracks.contains(&wanted.track.as_str()) {
        return Ok(());
    }
    Err(format!(
        "Leaderboard {name} has no track {}. It has {}",
        wanted.track,
        tracks.join(", ")
    ))
}

/// Characters of the Leaderboard's name in the name of a submission: with the API server's five letters at most 52.
const LONGEST: usize = 46;

/// The object to create.
pub fn object(wanted: &Submit) -> Value {
    let short: String = wanted.leaderboard.chars().take(LONGEST).collect();
    let metadata = match &wanted.name {
        Some(name) => json!({"name": name}),
        None => json!({"generateName": format!("{}-", short.trim_end_matches('-'))}),
    };
    let mut spec = json!({
        "leaderboardName": wanted.leaderboard, "track": wanted.track, "image": wanted.image, "priority": wanted.priority,
    });
    if wanted.team_id.is_some() || wanted.team.is_some() {
        let mut team = json!({});
        for (key, value) in [("id", &wanted.team_id), ("name", &wanted.team)] {
            if let Some(value) = value {
                team[key] = json!(value);
            }
        }
        spec["team"] = team;
    }
    let mut object = json!({
        "apiVersion": format!("{}/{}", leaderboard_api::GROUP, leaderboard_api::VERSION),
        "kind": "Submission",
        "metadata": metadata,
        "spec": spec,
    });
    object["metadata"]["labels"] = json!({names::LABEL_LEADERBOARD: wanted.leaderboard});
    object
}
