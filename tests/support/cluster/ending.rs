//! The end of a scene: what a failed one looked like, and its removal.

use std::fmt::Write as _;
use std::fs;

use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::core::v1::{Namespace, Pod};
use kube::ResourceExt;
use kube::api::{Api, DeleteParams, ListParams, Patch, PatchParams};
use leaderboard_api::{Leaderboard, Submission};
use serde_json::json;

use super::{Scene, containers};

/// Lines of each of the operator's logs that a failed test shows.
const LOG_LINES: usize = 40;

impl Scene {
    /// Everything that helps to understand a failure.
    pub(super) async fn describe(&self) -> String {
        let mut text = format!("\n===== {}\n", self.namespace);
        for submission in self.all::<Submission>().await {
            let status = serde_json::to_string_pretty(&submission.status).unwrap_or_default();
            let name = submission.name_any();
            let deleted = submission.metadata.deletion_timestamp.is_some();
            _ = writeln!(
                text,
                "--- submission {name} (deleted: {deleted}) {}\n{status}",
                json!(submission.spec)
            );
            for event in self.events(&name).await {
                _ = writeln!(
                    text,
                    "event {:?}: {:?}",
                    event.reason.unwrap_or_default(),
                    event.note.unwrap_or_default()
                );
            }
        }
        for board in self.all::<Leaderboard>().await {
            _ = writeln!(text, "--- leaderboard {} {}", board.name_any(), json!(board.status));
        }
        for job in self.all::<Job>().await {
            _ = writeln!(text, "--- job {} {}", job.name_any(), json!(job.status));
        }
        for pod in self.all::<Pod>().await {
            _ = writeln!(
                text,
                "--- pod {}, {:?}",
                pod.name_any(),
                pod.status.as_ref().and_then(|s| s.phase.clone())
            );
            for container in containers(&pod) {
                let (state, last) = (json!(container.state), json!(container.last_state));
                _ = writeln!(
                    text,
                    "{} (restarts {}): {state} before: {last}",
                    container.name, container.restart_count
                );
            }
        }
        let mut logs: Vec<_> = fs::read_dir(&self.logs)
            .into_iter()
            .flatten()
            .flatten()
            .map(|e| e.path())
            .collect();
        logs.sort();
        for path in logs {
            let log = fs::read_to_string(&path).unwrap_or_default();
            let lines: Vec<_> = log.lines().collect();
            let tail = lines[lines.len().saturating_sub(LOG_LINES)..].join("\n");
            _ = writeln!(text, "--- the end of {}\n{tail}", path.display());
        }
        text
    }

    /// Lets go of everything; the cluster removes the rest by itself.
    pub(super) async fn clear_away(&self) {
        if std::env::var_os("LEADERBOARD_TEST_KEEP").is_some() {
            return;
        }
        let release = Patch::Merge(json!({"metadata": {"finalizers": null}}));
        let (at_once, all) = (DeleteParams::background().grace_period(1), ListParams::default());
        _ = self.api::<Submission>().delete_collection(&at_once, &all).await;
        for submission in self.all::<Submission>().await {
            _ = self
                .api::<Submission>()
                .patch(&submission.name_any(), &PatchParams::default(), &release)
                .await;
        }
        _ = self.api::<Leaderboard>().delete_collection(&at_once, &all).await;
        for board in self.all::<Leaderboard>().await {
            _ = self
                .api::<Leaderboard>()
                .patch(&board.name_any(), &PatchParams::default(), &release)
                .await;
        }
        _ = self.api::<Job>().delete_collection(&at_once, &all).await;
        _ = self.api::<Pod>().delete_collection(&at_once, &all).await;
        _ = Api::<Namespace>::all(self.client.clone())
            .delete(&self.namespace, &at_once)
            .await;
        self.cloud.remove().await;
    }
}
