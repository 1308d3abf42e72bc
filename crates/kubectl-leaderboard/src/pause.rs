//! `pause` and `unpause`: whether a Leaderboard starts new runs. `lines` is pure.

use std::process::ExitCode;

use clap::Args;
use kube::ResourceExt;
use leaderboard_api::Leaderboard;
use serde_json::json;

use crate::board::{self, Observed};
use crate::cluster::Cluster;
use crate::commands::frame;
use crate::error::Error;
use crate::output::print;
use crate::text::Frame;

/// Which Leaderboard.
#[derive(Args, Debug)]
pub struct Pause {
    /// Name of the Leaderboard.
    #[arg(value_name = "LEADERBOARD")]
    name: String,
}

/// Sets `spec.paused`.
pub async fn pause(cluster: &Cluster, wanted: &Pause, paused: bool) -> Result<ExitCode, Error> {
    let name = &wanted.name;
    let before = cluster.known_leaderboard(name).await?;
    let was = before.spec.paused;
    let after = if was == paused {
        before
    } else {
        cluster.patch(name, &json!({"spec": {"paused": paused}})).await??
    };
    print(&lines(&after, was == paused, frame()));
    Ok(ExitCode::SUCCESS)
}

/// Lines about the Leaderboard and its submissions that run, that wait, and that come.
pub(super) fn lines(board: &Leaderboard, is_same: bool, frame: Frame) -> Vec<String> {
    let (name, namespace) = (board.name_any(), board.namespace().unwrap_or_default());
    let counts = board.status.as_ref().and_then(|status| status.counts.as_ref());
    let (waiting, running) = counts.map_or((0, 0), |counts| (counts.pending, counts.running));
    let mut page = frame.page();
    let (waiting, running) = (waiting.to_string(), format!("{running}, on to the end."));
    if !board.spec.paused {
        let how = if is_same { "was not paused" } else { "goes on" };
        page.paragraph(&format!(
            "Leaderboard {name} {how}: what waits starts as slots come free."
        ));
        page.row("Waiting", &waiting);
        board::show_problems(&mut page, &name, Observed::Found(board));
        return page.into_lines();
    }
    let how = if is_same { "was paused already" } else { "is paused" };
    page.paragraph(&format!("Leaderboard {name} {how}: nothing new starts."));
    page.row("Running", &running);
    page.row("Waiting", &format!("{waiting}, in the same order."));
    page.row("New ones", "accepted, and wait.");
    page.gap();
    let restart = format!("kubectl leaderboard resume --all --restart --leaderboard {name} -n {namespace}");
    page.whole("Stop runs", &restart);
    page.whole("Go on", &format!("kubectl leaderboard unpause {name} -n {namespace}"));
    page.into_lines()
}
