//! `logs`: what the containers of a submission print, from its Pod, or from the bucket once the Pod is gone.

mod follow;

use std::process::ExitCode;

use clap::{Args, ValueEnum};
use futures::StreamExt;
use k8s_openapi::api::core::v1::Pod;
use kube::ResourceExt;
use leaderboard_api::{Attempt, RunPlan, State, Submission, names};

use crate::aws::{Unread, read};
use crate::cluster::Cluster;
use crate::commands::frame;
use crate::error::{Error, of_bucket};
use crate::output::{ask, code, note, print, print_labelled};
use crate::text::{Frame, log_line, wrap};
use crate::{bucket, facts, foreign};

/// Which logs.
#[derive(Args, Debug)]
pub struct Logs {
    /// Name of the submission.
    name: String,
    /// Follow the log until the submission has ended: into Pods that come later, and through crashes.
    #[arg(short, long)]
    follow: bool,
    /// Only this worker, from 1.
    #[arg(long, value_name = "NUMBER")]
    worker: Option<usize>,
    /// Containers: the agents, the simulators or evaluators, those that prepare the run (start), or logcopy, which stores results
    /// [default: agent; evaluator where a file was submitted].
    #[arg(long, value_enum, value_name = "CONTAINERS")]
    of: Option<Whose>,
    /// Endpoint of the bucket, if it is not AWS's, that may get your AWS credentials once the Pod is gone.
    #[arg(long, value_name = "URL")]
    endpoint: Option<String>,
}

impl Logs {
    /// The containers that are asked for.
    fn whose(&self, submission: &Submission) -> Whose {
        let has_agent = facts::has_agent(facts::plan(submission));
        self.of
            .unwrap_or(if has_agent { Whose::Agent } else { Whose::Evaluator })
    }
}

/// The containers whose log is shown.
#[derive(ValueEnum, Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Whose {
    Agent,
    Simulator,
    Evaluator,
    // The containers that prepare the Pod, and the one that prepares what evaluators read.
    Start,
    Logcopy,
}

impl Whose {
    /// The containers; of workers all, or only this one.
    pub(super) fn sources(self, workers: usize, only: Option<usize>) -> Vec<Source> {
        let of_workers = |container: fn(usize) -> String, key: fn(usize) -> String| {
            let workers = (1..=workers).filter(|worker| only.is_none_or(|only| only == *worker));
            let source = |worker: usize| Source {
                // A worker has its colour also where it is shown alone.
                stream: worker,
                label: worker.to_string(),
                container: container(worker),
                key: Some(key(worker)),
            };
            workers.map(source).collect()
        };
        let named = |stream, name: &str, key: Option<&str>| Source {
            stream,
            label: name.to_owned(),
            container: name.to_owned(),
            key: key.map(str::to_owned),
        };
        match self {
            Self::Agent => of_workers(names::agent_container, |worker| {
                format!("agent/agent{worker}/leaderboard.log")
            }),
            Self::Simulator => of_workers(names::simulator_container, |worker| {
                format!("simulator/console-{worker}.log")
            }),
            Self::Evaluator => of_workers(names::evaluator_container, |worker| {
                format!("evaluators/{worker}/console.log")
            }),
            Self::Start => {
                let all = names::INIT_CONTAINERS.into_iter();
                let that_end = all.filter(|name| *name != names::CONTAINER_LOGCOPY);
                let all = that_end.chain([names::CONTAINER_COLLECT]).enumerate();
                all.map(|(stream, name)| named(stream, name, None)).collect()
            }
            Self::Logcopy => vec![named(0, names::CONTAINER_LOGCOPY, Some("logcopy/logcopy.log"))],
        }
    }

    /// The choice in place of this one, if the run has no such containers.
    fn in_place(self, plan: Option<&RunPlan>) -> Option<&'static str> {
        let has_evaluators = plan?.container().is_some();
        match self {
            Self::Agent if !facts::has_agent(plan) => Some("evaluator"),
            Self::Simulator if has_evaluators => Some("evaluator"),
            Self::Evaluator if !has_evaluators => Some("simulator"),
            _ => None,
        }
    }

    /// True if each container begins when the one before has ended.
    fn is_in_turn(self) -> bool {
        self == Self::Start
    }
}

/// A container whose log is shown.
#[derive(Clone, Debug)]
pub(super) struct Source {
    /// The number of its colour.
    stream: usize,
    label: String,
    container: String,
    /// The log below the run's prefix, if it is stored.
    key: Option<String>,
}

impl Source {
    fn print(&self, line: &str) {
        print_labelled(self.stream, &self.label, &log_line(line));
    }
}

/// Prints the logs.
pub async fn logs(cluster: &Cluster, wanted: &Logs) -> Result<ExitCode, Error> {
    let submission = cluster.submission(&wanted.name).await?;
    let of = wanted.whose(&submission);
    if let Some(other) = of.in_place(facts::plan(&submission)) {
        let name = &wanted.name;
        return Err(Error::Unfit(format!("{name} has no such container. Use --of {other}")));
    }
    let workers = workers(&submission, of);
    if let Some(worker) = wanted.worker.filter(|worker| *worker == 0 || *worker > workers.max(1)) {
        return Err(Error::Unfit(no_worker(&wanted.name, worker, workers)));
    }
    if wanted.follow && !facts::has_ended(&submission) {
        return follow::follow(cluster, wanted, submission).await;
    }
    let sources = of.sources(workers, wanted.worker);
    let code = match cluster.pod(&wanted.name).await? {
        Some(pod) => stream(cluster, &pod, &sources).await?,
        None => from_bucket(&submission, wanted, of, &sources).await?,
    };
    if wanted.follow {
        note(&end(&submission));
    }
    Ok(code)
}

fn no_worker(name: &str, worker: usize, workers: usize) -> String {
    match workers {
        0 | 1 => format!("{name} has no such log of worker {worker}. There is one for all: leave out --worker"),
        workers => format!("{name} has no worker {worker}. It has {workers}, counted from 1"),
    }
}

/// One sentence for a submission that has no log to follow yet.
pub(super) fn begins_later(submission: &Submission) -> String {
    let shown = facts::shown(submission);
    format!(
        "{} is {shown}. Its log follows once its Pod runs.",
        submission.name_any()
    )
}

/// One sentence between the lives of a container; the lines of the life before are above.
pub(super) fn begins_again(container: &str, restarts: i32) -> String {
    format!("{container} was started again (restart {restarts}). Its log follows.")
}

/// One sentence about the end of a submission whose log was followed, with the next step.
pub(super) fn end(submission: &Submission) -> String {
    let next = if facts::shown(submission) == State::Finished.as_str() {
        String::new()
    } else {
        format!(" `{}` has the next step.", facts::command("why", submission))
    };
    format!("{}.{next}", facts::named(submission))
}

/// How many workers have such a container.
fn workers(submission: &Submission, of: Whose) -> usize {
    let plan = facts::plan(submission);
    plan.map_or(0, |plan| match of {
        Whose::Agent => plan.agent_count(),
        _ => plan.workers(),
    })
}

/// Whether a Pod has this container: not each kind of evaluation has all.
fn has(pod: &Pod, container: &str) -> bool {
    pod.spec.as_ref().is_none_or(|spec| {
        let mut all = spec.containers.iter().chain(spec.init_containers.iter().flatten());
        all.any(|known| known.name == container)
    })
}

/// Prints the lines of several containers so far, one after the other, each with its label.
async fn stream(cluster: &Cluster, pod: &Pod, sources: &[Source]) -> Result<ExitCode, Error> {
    let name = pod.name_any();
    for source in sources.iter().filter(|source| has(pod, &source.container)) {
        let container = &source.container;
        let mut lines = match cluster.log(&name, container).await {
            Ok(lines) => lines,
            // One that has not started yet has no log, and the others may.
            Err(Error::Api(why)) => {
                note(&format!("{container} of Pod {name} has no log yet: {why}"));
                continue;
            }
            Err(error) => return Err(error),
        };
        while let Some(line) = lines.next().await {
            match line {
                Ok(line) => source.print(&line),
                Err(error) => {
                    return Err(Error::Api(format!(
                        "the log of {container} of Pod {name} ended: {error}"
                    )));
                }
            }
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// Prints the logs that are stored, or the commands that do so where there is no program for it.
async fn from_bucket(submission: &Submission, wanted: &Logs, of: Whose, sources: &[Source]) -> Result<ExitCode, Error> {
    let commands = in_bucket(submission, of, sources, frame()).map_err(Error::Unfit)?;
    let results = facts::status(submission).results_url.as_deref().unwrap_or_default();
    let storage = facts::storage(submission);
    foreign::confirm(&submission.name_any(), storage, wanted.endpoint.as_deref(), ask)?;
    let mut is_read = true;
    for (source, key) in stored(sources) {
        let address = format!("{results}/{key}");
        match read(&address, storage, |line| source.print(line)).await {
            Ok(()) => {}
            Err(Unread::NoProgram) => {
                print(&commands);
                return Ok(ExitCode::SUCCESS);
            }
            Err(Unread::Failed(why)) => {
                note(&of_bucket(&address, &why).to_string());
                is_read = false;
            }
        }
    }
    Ok(code(is_read))
}

/// The containers whose log is stored, with its key.
fn stored(sources: &[Source]) -> impl Iterator<Item = (&Source, &str)> {
    sources
        .iter()
        .filter_map(|source| Some((source, source.key.as_deref()?)))
}

/// The commands that read the logs once the Pod is gone, or why there is none, with the next step.
pub(super) fn in_bucket(
    submission: &Submission,
    of: Whose,
    sources: &[Source],
    frame: Frame,
) -> Result<Vec<String>, String> {
    let name = submission.name_any();
    let status = facts::status(submission);
    let has_started = status.times.started.is_some() || status.attempt > Some(Attempt::FIRST) || status.retry > 0;
    if !facts::has_ended(submission) && !has_started {
        return Err(format!(
            "{name} is {} and has no Pod yet, so it has no log. `{} -f` waits for it",
            facts::shown(submission),
            facts::command("logs", submission)
        ));
    }
    let (Some(results), Some(_)) = (&status.results_url, stored(sources).next()) else {
        let what = if of.is_in_turn() {
            "what prepared it is not stored"
        } else {
            "no such log is stored"
        };
        return Err(format!(
            "the Pod of {name} is gone, and {what}. `{}` names the log that explains a failure",
            facts::command("why", submission)
        ));
    };
    let text = format!(
        "The Pod of {name} is gone. With the program aws on the PATH, this command shows its logs. Without it:"
    );
    let mut lines = wrap(&text, frame.width);
    let storage = facts::storage(submission);
    lines.extend(stored(sources).map(|(_, key)| bucket::print(&format!("{results}/{key}"), storage)));
    Ok(lines)
}

#[cfg(test)]
mod tests {
    use super::*;
    use leaderboard_api::{MergeMethod, PlannedEvaluation};
    use serde_json::{Value, json};

    fn frame() -> Frame {
        Frame {
            now: jiff::Timestamp::UNIX_EPOCH,
            width: 100,
        }
    }

    fn ended() -> Value {
        json!([{"type": "Finished", "status": "True", "reason": "Finished", "message": "",
                "lastTransitionTime": "2026-11-01T10:00:00Z"}])
    }

    fn submission(status: &Value) -> Submission {
        let spec = json!({"leaderboardName": "lb", "image": "i", "track": "sensors"});
        let mut submission = Submission::new("mine", serde_json::from_value(spec).unwrap());
        submission.status = serde_json::from_value(status.clone()).unwrap();
        submission
    }

    #[test]
    fn each_choice_has_its_containers_and_keys() {
        let names = |whose: Whose, only| {
            let (found, all) = (whose.sources(2, only), whose.sources(2, only));
            let keys = all.into_iter().filter_map(|source| source.key);
            let found = found.into_iter().map(|source| source.container);
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
        let evaluators = (
            two("evaluator-1", "evaluator-2"),
            two("evaluators/1/console.log", "evaluators/2/console.log"),
        );
        assert_eq!(names(Whose::Evaluator, None), evaluators);
        let start = ["workspace", "contents", "dataset", "labels", "collect"].map(str::to_owned);
        assert_eq!(names(Whose::Start, None), (start.to_vec(), vec![]));
        assert_eq!(names(Whose::Logcopy, Some(2)).0, ["logcopy"]);
    }

    #[test]
    fn each_kind_of_evaluation_has_containers_of_its_own() {
        let plan = |kind: &str, of: Value| -> RunPlan {
            let plan =
                json!({"runId": "mine", kind: of, "track": "t", "storage": {"s3": {"bucket": "b"}}, "image": "a"});
            serde_json::from_value(plan).unwrap()
        };
        let by_evaluator = |mode: &str| {
            let of = json!({"mode": mode, "workers": 2, "merge": "Mean", "score": {"metric": "m"}, "image": "e"});
            plan("container", of)
        };
        let driven = json!({"version": "V2", "codename": "S", "slices": [], "routes": 1, "repetitions": 1, "contentsImage": "c",
            "simulatorImage": "s"});
        let [evaluated, batch, of_file] = ["Interactive", "Batch", "Predictions"].map(by_evaluator);
        let driven = plan("carla", driven);
        for (plan, of, other) in [
            (Some(&evaluated), Whose::Simulator, Some("evaluator")),
            (Some(&driven), Whose::Evaluator, Some("simulator")),
            (Some(&evaluated), Whose::Evaluator, None),
            (Some(&driven), Whose::Simulator, None),
            (Some(&evaluated), Whose::Agent, None),
            (Some(&batch), Whose::Agent, None),
            (Some(&of_file), Whose::Agent, Some("evaluator")),
            (Some(&of_file), Whose::Evaluator, None),
            // Which kind it is, is not known yet.
            (None, Whose::Simulator, None),
        ] {
            assert_eq!(of.in_place(plan), other, "{of:?}");
        }
        let wanted = |of: Option<Whose>, plan: &RunPlan| {
            let one = submission(&json!({"plan": plan}));
            let wanted = Logs {
                name: "mine".to_owned(),
                follow: false,
                worker: None,
                of,
                endpoint: None,
            };
            let of = wanted.whose(&one);
            (of, workers(&one, of))
        };
        // An agent that runs first is one, however many evaluators share the work.
        for (plan, expected) in [
            (&driven, (Whose::Agent, 0)),
            (&evaluated, (Whose::Agent, 2)),
            (&batch, (Whose::Agent, 1)),
            (&of_file, (Whose::Evaluator, 2)),
        ] {
            assert_eq!(wanted(None, plan), expected);
        }
        // A command that merges their results is one more, without an agent.
        let mut merged = evaluated.clone();
        if let PlannedEvaluation::Container(container) = &mut merged.evaluation {
            container.merge = MergeMethod::Command;
        }
        let found = [Whose::Agent, Whose::Evaluator].map(|of| wanted(Some(of), &merged).1);
        assert_eq!(found, [2, 3]);
        assert_eq!(wanted(Some(Whose::Evaluator), &batch), (Whose::Evaluator, 2));
        let containers = json!({"containers": [{"name": "evaluator-1"}], "initContainers": [{"name": "workspace"}]});
        let pod: Pod = serde_json::from_value(json!({"metadata": {}, "spec": containers})).unwrap();
        let has: Vec<bool> = ["workspace", "contents", "evaluator-1"]
            .iter()
            .map(|name| has(&pod, name))
            .collect();
        assert_eq!(has, [true, false, true]);
    }

    #[test]
    fn no_part_of_an_imported_address_is_a_command() {
        let hostile = submission(&json!({"resultsURL": "s3://b/$(reboot)';reboot;#", "conditions": ended()}));
        let lines = in_bucket(&hostile, Whose::Agent, &Whose::Agent.sources(1, None), frame()).unwrap();
        let object = r"'s3://b/$(reboot)'\'';reboot;#/agent/agent1/leaderboard.log'";
        assert_eq!(lines[1], format!("aws s3 cp {object} -"));
    }

    #[test]
    fn without_a_pod_the_commands_for_the_bucket_are_shown() {
        let storage = json!({"bucket": "b", "region": "eu-west-1"});
        let plan = json!({"runId": "mine",
            "carla": {"version": "V2", "codename": "S", "slices": [{"first": 0, "last": 0}],
                "routes": 1, "repetitions": 1, "contentsImage": "c", "simulatorImage": "s"},
            "track": "sensors", "storage": {"s3": storage}, "image": "a"});
        let stored = submission(&json!({"resultsURL": "s3://b/mine", "plan": plan, "conditions": ended()}));
        assert_eq!(workers(&stored, Whose::Agent), 1);
        let in_bucket = |submission, of: Whose| in_bucket(submission, of, &of.sources(1, None), frame());
        let lines = in_bucket(&stored, Whose::Agent).unwrap();
        assert_eq!(
            lines[1],
            "aws s3 cp s3://b/mine/agent/agent1/leaderboard.log - --region eu-west-1"
        );
        let unstored = submission(&json!({"conditions": ended()}));
        for (submission, of, expected) in [
            (
                &submission(&Value::Null),
                Whose::Agent,
                "mine is new and has no Pod yet",
            ),
            (
                &unstored,
                Whose::Agent,
                "the Pod of mine is gone, and no such log is stored.",
            ),
            (
                &stored,
                Whose::Start,
                "the Pod of mine is gone, and what prepared it is not stored.",
            ),
        ] {
            let why = in_bucket(submission, of).unwrap_err();
            assert!(why.starts_with(expected), "{why}");
        }
    }

    #[test]
    fn a_worker_that_does_not_exist_is_named_with_how_many_there_are() {
        for (workers, next) in [
            (0, "leave out --worker"),
            (1, "leave out --worker"),
            (4, "It has 4, counted from 1"),
        ] {
            let why = no_worker("mine", 7, workers);
            assert!(
                why.starts_with("mine has no ") && why.contains("worker 7. ") && why.ends_with(next),
                "{why}"
            );
        }
    }
}
