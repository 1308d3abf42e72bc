//! `logs -f`: each container's log from its beginning to its end, in whichever Pod, until the submission has ended.

use std::collections::BTreeSet;
use std::pin::pin;
use std::process::ExitCode;

use futures::stream::{BoxStream, SelectAll};
use futures::{Stream, StreamExt};
use k8s_openapi::api::core::v1::{ContainerStatus, Pod};
use kube::ResourceExt;
use leaderboard_api::Submission;

use super::{Logs, Source, begins_again, begins_later, end, workers};
use crate::cluster::Cluster;
use crate::commands::{changes, next, uninterrupted};
use crate::error::Error;
use crate::facts;
use crate::output::note;

/// A life of a container: one that crashes begins another one, with a log of its own.
type Life = (String, String, i32);
type Lines = BoxStream<'static, (Source, Result<String, Error>)>;

/// The open logs, and the lives and lines that were shown.
struct Following<'a> {
    cluster: &'a Cluster,
    wanted: &'a Logs,
    submission: Submission,
    begun: BTreeSet<Life>,
    lines: SelectAll<Lines>,
}

/// Prints the lines as they come.
pub(super) async fn follow(cluster: &Cluster, wanted: &Logs, submission: Submission) -> Result<ExitCode, Error> {
    if facts::status(&submission).job_name.is_none() {
        note(&begins_later(&submission));
    }
    let mut changes = pin!(changes(cluster, &wanted.name));
    let mut pods = pin!(uninterrupted(cluster.pod_changes(&wanted.name)));
    let mut following = Following {
        cluster,
        wanted,
        submission,
        begun: BTreeSet::new(),
        lines: SelectAll::new(),
    };
    while !following.is_over() {
        following.step(&mut changes, &mut pods).await?;
    }
    note(&end(&following.submission));
    Ok(ExitCode::SUCCESS)
}

impl Following<'_> {
    /// True if the submission has ended and every open log is shown to its end.
    fn is_over(&self) -> bool {
        facts::has_ended(&self.submission) && self.lines.is_empty()
    }

    /// Takes whichever comes first: a line, a change of the submission, or one of a Pod.
    async fn step(
        &mut self,
        changes: &mut (impl Stream<Item = Result<Submission, Error>> + Unpin),
        pods: &mut (impl Stream<Item = Result<Pod, Error>> + Unpin),
    ) -> Result<(), Error> {
        tokio::select! {
            // A log that never pauses hides no change.
            biased;
            changed = next(changes) => self.submission = changed?,
            pod = next(pods) => self.begin(&pod?),
            line = self.lines.next(), if !self.lines.is_empty() => match line {
                // The last log has ended.
                None => {}
                Some((source, Ok(line))) => source.print(&line),
                Some((_, Err(error @ (Error::Forbidden(_) | Error::Credentials(_))))) => return Err(error),
                Some((source, Err(error))) => note(&format!("the log of {} was interrupted: {error}", source.container)),
            },
        }
        Ok(())
    }

    /// Begins the logs of containers that have one and were not begun.
    fn begin(&mut self, pod: &Pod) {
        let mut new = Vec::new();
        let (of, only) = (self.wanted.whose(&self.submission), self.wanted.worker);
        for source in of.sources(workers(&self.submission, of).max(only.unwrap_or(0)), only) {
            let Some(restarts) = life(pod, &source.container) else {
                continue;
            };
            let life = (pod.uid().unwrap_or_default(), source.container.clone(), restarts);
            if self.begun.contains(&life) {
                continue;
            }
            self.begun.insert(life);
            if restarts > 0 {
                note(&begins_again(&source.container, restarts));
            }
            let lines = self.cluster.followed_log(&pod.name_any(), &source.container);
            new.push(lines.map(move |line| (source.clone(), line)).boxed());
        }
        if of.is_in_turn() {
            self.lines.push(futures::stream::iter(new).flatten().boxed());
        } else {
            self.lines.extend(new);
        }
    }
}

/// The restarts of a container that runs or has run; none of one that has no log yet.
fn life(pod: &Pod, container: &str) -> Option<i32> {
    let status = pod.status.as_ref()?;
    let all = [&status.container_statuses, &status.init_container_statuses];
    let mut all = all.into_iter().flatten().flatten();
    let found: &ContainerStatus = all.find(|status| status.name == container)?;
    let state = found.state.as_ref()?;
    (state.running.is_some() || state.terminated.is_some()).then_some(found.restart_count)
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    #[test]
    fn each_life_of_a_container_has_a_log_once_it_has_begun() {
        let pod = |kind: &str, state: &Value, restarts: i32| -> Pod {
            let status = json!({"name": "agent-1", "image": "a", "imageID": "", "ready": false,
                                "restartCount": restarts, "state": state});
            serde_json::from_value(json!({"metadata": {"name": "p"}, "status": {kind: [status]}})).unwrap()
        };
        let (running, waiting) = (
            json!({"running": {}}),
            json!({"waiting": {"reason": "CrashLoopBackOff"}}),
        );
        let ended = json!({"terminated": {"exitCode": 1}});
        assert_eq!(life(&pod("containerStatuses", &running, 0), "agent-1"), Some(0));
        assert_eq!(life(&pod("initContainerStatuses", &ended, 2), "agent-1"), Some(2));
        assert_eq!(life(&pod("containerStatuses", &waiting, 1), "agent-1"), None);
        assert_eq!(life(&pod("containerStatuses", &running, 0), "agent-2"), None);
        assert_eq!(life(&Pod::default(), "agent-1"), None);
    }
}
