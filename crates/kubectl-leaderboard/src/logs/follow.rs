//! `logs -f`: each container's log from its beginning to its end, in whichever Pod, until the submission has ended.

use std::collections::BTreeSet;
use std::pin::pin;
use std::process::ExitCode;

use futures::StreamExt;
use futures::stream::{BoxStream, SelectAll};
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

/// Prints the lines as they come.
pub(super) async fn follow(cluster: &Cluster, wanted: &Logs, mut submission: Submission) -> Result<ExitCode, Error> {
    if facts::status(&submission).job_name.is_none() {
        note(&begins_later(&submission));
    }
    let mut changes = pin!(changes(cluster, &wanted.name));
    let mut pods = pin!(uninterrupted(cluster.pod_changes(&wanted.name)));
    let mut begun: BTreeSet<Life> = BTreeSet::new();
    let mut lines: SelectAll<Lines> = SelectAll::new();
    // Every open log is shown to its end.
    while !facts::has_ended(&submission) || !lines.is_empty() {
        tokio::select! {
            // A log that never pauses hides no change.
            biased;
            changed = next(&mut changes) => submission = changed?,
            pod = next(&mut pods) => lines.extend(begin(cluster, wanted, &submission, &pod?, &mut begun)),
            line = lines.next(), if !lines.is_empty() => match line {
                // The last log has ended.
                None => {}
                Some((source, Ok(line))) => source.print(&line),
                Some((_, Err(error @ (Error::Forbidden(_) | Error::Credentials(_))))) => return Err(error),
                Some((source, Err(error))) => note(&format!("the log of {} was interrupted: {error}", source.container)),
            },
        }
    }
    note(&end(&submission));
    Ok(ExitCode::SUCCESS)
}

/// The logs of a Pod's containers that have one and were not begun.
fn begin(
    cluster: &Cluster,
    wanted: &Logs,
    submission: &Submission,
    pod: &Pod,
    begun: &mut BTreeSet<Life>,
) -> Vec<Lines> {
    let mut new: Vec<Lines> = Vec::new();
    let (of, only) = (wanted.whose(submission), wanted.worker);
    for source in of.sources(workers(submission, of).max(only.unwrap_or(0)), only) {
        let Some(restarts) = life(pod, &source.container) else {
            continue;
        };
        let life = (pod.uid().unwrap_or_default(), source.container.clone(), restarts);
        if !begun.insert(life) {
            continue;
        }
        if restarts > 0 {
            note(&begins_again(&source.container, restarts));
        }
        let lines = cluster.followed_log(&pod.name_any(), &source.container);
        new.push(lines.map(move |line| (source.clone(), line)).boxed());
    }
    if of.is_in_turn() {
        vec![futures::stream::iter(new).flatten().boxed()]
    } else {
        new
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
