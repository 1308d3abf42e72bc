//! `logs`: what the agents of a submission print, from its Pod, or from the bucket once the Pod is gone.

mod follow;

use std::process::ExitCode;

use clap::{Args, ValueEnum};
use futures::StreamExt;
use futures::stream::select_all;
use k8s_openapi::api::core::v1::Pod;
use kube::ResourceExt;
use leaderboard_api::{Submission, names};

use crate::bucket_log::{Unread, read};
use crate::cluster::Cluster;
use crate::error::Error;
use crate::output::{print, print_labelled};
use crate::text::clean;
use crate::{bucket, facts};

/// Which logs.
#[derive(Args, Debug)]
pub struct Logs {
    /// Name of the submission.
    name: String,
    /// Follow the log until the submission has ended: into Pods that come later, and through crashes of agents.
    #[arg(short, long)]
    follow: bool,
    /// Only this pair, from 1.
    #[arg(long, value_name = "NUMBER")]
    pair: Option<usize>,
    /// Whose log.
    #[arg(long, value_enum, default_value_t)]
    of: Whose,
}

/// Whose log is shown.
#[derive(ValueEnum, Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Whose {
    #[default]
    Agent,
    Simulator,
    /// What prepares the Pod: contents and workspace.
    Start,
    /// What stores results and logs.
    Logcopy,
}

impl Whose {
    /// The containers with their labels.
    fn containers(self, pairs: usize, only: Option<usize>) -> Vec<(String, String)> {
        let of_pairs = |name: fn(usize) -> String| {
            let pairs = (1..=pairs).filter(|pair| only.is_none_or(|only| only == *pair));
            pairs.map(|pair| (pair.to_string(), name(pair))).collect()
        };
        match self {
            Self::Agent => of_pairs(names::agent_container),
            Self::Simulator => of_pairs(names::simulator_container),
            Self::Start => [names::CONTAINER_CONTENTS, names::CONTAINER_WORKSPACE]
                .map(|name| (name.to_owned(), name.to_owned()))
                .to_vec(),
            Self::Logcopy => vec![("logcopy".to_owned(), names::CONTAINER_LOGCOPY.to_owned())],
        }
    }

    /// The keys of these logs below the run's prefix, with their labels.
    fn keys(self, pairs: usize, only: Option<usize>) -> Vec<(String, String)> {
        let pairs = (1..=pairs).filter(|pair| only.is_none_or(|only| only == *pair));
        let of_pairs = |key: fn(usize) -> String| pairs.map(|pair| (pair.to_string(), key(pair))).collect();
        match self {
            Self::Agent => of_pairs(|pair| format!("agent/agent{pair}/leaderboard.log")),
            Self::Simulator => of_pairs(|pair| format!("simulator/console-{pair}.log")),
            Self::Start => Vec::new(),
            Self::Logcopy => vec![("logcopy".to_owned(), "logcopy/logcopy.log".to_owned())],
        }
    }
}

/// A container whose log is shown, with its label and the number of its colour.
#[derive(Clone, Debug)]
struct Source {
    stream: usize,
    label: String,
    container: String,
}

/// Prints the logs.
pub async fn logs(cluster: &Cluster, wanted: &Logs) -> Result<ExitCode, Error> {
    let submission = cluster.submission(&wanted.name).await?;
    let pairs = pairs(&submission);
    if let Some(pair) = wanted.pair.filter(|pair| *pair == 0 || *pair > pairs.max(1)) {
        return Err(Error::Unfit(format!(
            "{} has no pair {pair}. It has {pairs}, counted from 1",
            wanted.name
        )));
    }
    if wanted.follow && !facts::has_ended(&submission) {
        return follow::follow(cluster, wanted, submission).await;
    }
    let Some(pod) = cluster.pod(&wanted.name).await? else {
        return from_bucket(&submission, wanted, pairs).await;
    };
    stream(cluster, &pod, &sources(wanted, pairs)).await?;
    Ok(ExitCode::SUCCESS)
}

fn sources(wanted: &Logs, pairs: usize) -> Vec<Source> {
    let containers = wanted.of.containers(pairs, wanted.pair).into_iter().enumerate();
    let source = |(stream, (label, container)): (usize, (String, String))| Source {
        // A pair has its colour also where it is shown alone.
        stream: label.parse().unwrap_or(stream),
        label,
        container,
    };
    containers.map(source).collect()
}

fn pairs(submission: &Submission) -> usize {
    let plan = submission.status.as_ref().and_then(|status| status.plan.as_ref());
    plan.map_or(0, |plan| plan.slices.len())
}

/// Prints the lines of several containers so far, each with its label.
async fn stream(cluster: &Cluster, pod: &Pod, sources: &[Source]) -> Result<(), Error> {
    let name = pod.name_any();
    let mut streams = Vec::new();
    for source in sources {
        let container = &source.container;
        match cluster.log(&name, container).await {
            Ok(lines) => streams.push(lines.map(move |line| (source, line)).boxed()),
            // One that has not started yet has no log, and the others may.
            Err(Error::Api(why)) => eprintln!("kubectl leaderboard: {container} has no log yet: {why}"),
            Err(error) => return Err(error),
        }
    }
    let mut all = select_all(streams);
    while let Some((source, line)) = all.next().await {
        match line {
            Ok(line) => print_labelled(source.stream, &source.label, &clean(&line)),
            Err(error) => return Err(Error::Api(format!("the log of {name} ended: {error}"))),
        }
    }
    Ok(())
}

/// Prints the logs that are stored, or the commands that do so where there is no program for it.
async fn from_bucket(submission: &Submission, wanted: &Logs, pairs: usize) -> Result<ExitCode, Error> {
    let keys = wanted.of.keys(pairs, wanted.pair);
    let commands = in_bucket(submission, &keys).map_err(Error::Unfit)?;
    let status = submission.status.as_ref();
    let results = status
        .and_then(|status| status.results_url.as_deref())
        .unwrap_or_default();
    let storage = status.and_then(|status| status.plan.as_ref()).map(|plan| &plan.storage);
    let mut is_unread = false;
    for (stream, (label, key)) in keys.iter().enumerate() {
        let stream = label.parse().unwrap_or(stream);
        let show = |line: &str| print_labelled(stream, label, &clean(line));
        match read(&format!("{results}/{key}"), storage, show).await {
            Ok(()) => {}
            Err(Unread::NoProgram) => {
                print(&commands);
                return Ok(ExitCode::SUCCESS);
            }
            Err(Unread::Failed(why)) => {
                let next = "Check that it was stored, and that your AWS credentials may read the bucket";
                eprintln!("kubectl leaderboard: cannot read {results}/{key}: {why}. {next}");
                is_unread = true;
            }
        }
    }
    Ok(if is_unread {
        ExitCode::FAILURE
    } else {
        ExitCode::SUCCESS
    })
}

/// The commands that read the logs once the Pod is gone.
fn in_bucket(submission: &Submission, keys: &[(String, String)]) -> Result<Vec<String>, String> {
    let name = submission.name_any();
    let status = submission.status.as_ref();
    let results = status.and_then(|status| status.results_url.as_deref());
    let (Some(results), false) = (results, keys.is_empty()) else {
        return Err(format!(
            "{name} has no Pod, and no such log is stored. See `kubectl leaderboard why {name}`"
        ));
    };
    let storage = status.and_then(|status| status.plan.as_ref()).map(|plan| &plan.storage);
    let mut lines =
        vec!["The Pod is gone. With the program aws on the PATH, this command shows its logs. Without it:".to_owned()];
    lines.extend(
        keys.iter()
            .map(|(_, key)| bucket::print(&format!("{results}/{key}"), storage)),
    );
    Ok(lines)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::{Value, json};

    fn submission(status: &Value) -> Submission {
        let spec = json!({"leaderboardName": "lb", "image": "i", "track": "sensors"});
        let mut submission = Submission::new("mine", serde_json::from_value(spec).unwrap());
        submission.status = serde_json::from_value(status.clone()).unwrap();
        submission
    }

    #[test]
    fn each_choice_has_its_containers_and_keys() {
        let names = |whose: Whose, only| {
            let found = whose.containers(2, only).into_iter().map(|(_, name)| name);
            let keys = whose.keys(2, only).into_iter().map(|(_, key)| key);
            (found.collect::<Vec<_>>(), keys.collect::<Vec<_>>())
        };
        let two = |a: &str, b: &str| vec![a.to_owned(), b.to_owned()];
        assert_eq!(
            names(Whose::Agent, None),
            (
                two("agent-1", "agent-2"),
                two("agent/agent1/leaderboard.log", "agent/agent2/leaderboard.log")
            )
        );
        let one = (
            vec!["simulator-2".to_owned()],
            vec!["simulator/console-2.log".to_owned()],
        );
        assert_eq!(names(Whose::Simulator, Some(2)), one);
        assert_eq!(names(Whose::Start, None), (two("contents", "workspace"), vec![]));
        assert_eq!(names(Whose::Logcopy, Some(2)).0, ["logcopy"]);
    }

    #[test]
    fn no_part_of_an_imported_address_is_a_command() {
        let hostile = submission(&json!({"resultsURL": "s3://b/$(reboot)';reboot;#"}));
        let lines = in_bucket(&hostile, &[("1".to_owned(), "a.log".to_owned())]).unwrap();
        assert_eq!(lines[1], r"aws s3 cp 's3://b/$(reboot)'\'';reboot;#/a.log' -");
    }

    #[test]
    fn without_a_pod_the_commands_for_the_bucket_are_shown() {
        let storage = json!({"bucket": "b", "region": "eu-west-1"});
        let plan = json!({"runId": "mine", "leaderboardVersion": "V2", "track": "sensors", "codename": "S",
                          "slices": [{"first": 0, "last": 0}], "routes": 1, "repetitions": 1, "storage": storage, "image": "a",
                          "contentsImage": "c", "simulatorImage": "s"});
        let stored = submission(&json!({"resultsURL": "s3://b/mine", "plan": plan}));
        assert_eq!(pairs(&stored), 1);
        let lines = in_bucket(&stored, &Whose::Agent.keys(1, None)).unwrap();
        assert_eq!(
            lines[1],
            "aws s3 cp s3://b/mine/agent/agent1/leaderboard.log - --region eu-west-1"
        );
        for (submission, keys) in [
            (submission(&Value::Null), Whose::Agent.keys(1, None)),
            (stored, Vec::new()),
        ] {
            let why = in_bucket(&submission, &keys).unwrap_err();
            assert!(why.starts_with("mine has no Pod, and no such log is stored."), "{why}");
        }
    }
}
