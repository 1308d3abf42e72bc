//! A Pod reduced to what decisions depend on. Pure; reads the runner's verdicts as hostile text.

use crate::kubernetes::objects::{Condition, ContainerStatus, Ended, Pod, PodStatus};
use leaderboard_api::names;
use leaderboard_api::text::{LONGEST_MESSAGE, one_line};
use leaderboard_contract::run::Stop;
use leaderboard_contract::verdict::{NotAVerdict, WorkspaceReason, WorkspaceVerdict};
use leaderboard_policy::view::{ContainerView, EndView, PodView};
use leaderboard_protocol::files::{Host, Member, Side};
use leaderboard_protocol::verdict::Verdict;

/// Reduces a Pod.
pub fn view(pod: &Pod) -> PodView {
    let (meta, status) = (&pod.metadata, &pod.status);
    let containers: Vec<ContainerView> = status.all_containers().map(container).collect();
    let running = |name: &str| containers.iter().any(|c| c.name == name && c.running);
    PodView {
        name: meta.name.to_string(),
        uid: meta.uid.to_string(),
        node: pod.spec.node_name.as_deref().map(str::to_owned),
        created: meta.creation_timestamp.as_ref().map(|time| time.0),
        scheduled: scheduled(status),
        unschedulable: unschedulable(status),
        scale_up: None,
        delete_by: meta.deletion_timestamp.as_ref().map(|t| t.0),
        deleted: deleted(pod),
        agent_started: agent_started(status),
        logcopy_running: running(names::CONTAINER_LOGCOPY),
        run_ended: run_ended(pod),
        ended_by_node: ended_by_node(status),
        disruption: status.conditions.disruption.as_deref().map(short),
        stop: meta.annotations.stop.as_deref().and_then(Stop::parse),
        containers,
    }
}

/// When its deletion was asked for: the API server adds the grace to what it shows.
fn deleted(pod: &Pod) -> Option<jiff::Timestamp> {
    let by = pod.metadata.deletion_timestamp.as_ref()?.0;
    let grace = pod.metadata.deletion_grace_period_seconds.unwrap_or(0);
    by.checked_sub(jiff::SignedDuration::from_secs(grace)).ok()
}

/// The scheduler's condition, if it has this truth: `True` if the Pod has a node.
fn scheduling<'a>(status: &'a PodStatus, truth: &str) -> Option<&'a Condition> {
    status.conditions.scheduled.as_deref().filter(|c| &*c.status == truth)
}

fn scheduled(status: &PodStatus) -> Option<jiff::Timestamp> {
    scheduling(status, "True")?.last_transition_time.as_ref().map(|t| t.0)
}

fn unschedulable(status: &PodStatus) -> Option<String> {
    let found = scheduling(status, "False")?;
    Some(short(found.message.as_deref().unwrap_or("no node takes the Pod")))
}

/// When the first agent started, which may be an init container; of a Pod without agents, the first evaluator.
fn agent_started(status: &PodStatus) -> Option<jiff::Timestamp> {
    let has_agents = status.all_containers().any(|c| side(c) == Some(Side::Agent));
    let first = if has_agents {
        Side::Agent
    } else {
        Side::Host(Host::Evaluator)
    };
    let its = status.all_containers().filter(|c| side(c) == Some(first));
    its.flat_map(started_times).min()
}

fn side(status: &ContainerStatus) -> Option<Side> {
    Member::parse(&status.name).map(|member| member.side)
}

/// The hosts' containers leave once the final report is stored; logcopy's farewell and the kubelet's last word come seconds later.
fn run_ended(pod: &Pod) -> Option<jiff::Timestamp> {
    let containers = pod.spec.containers.iter();
    let of_workers = containers.filter(|c| Member::parse(&c.name).is_some());
    let ends: Option<Vec<jiff::Timestamp>> = of_workers
        .map(|wanted| {
            let mut statuses = pod.status.container_statuses.iter();
            let end = statuses.find(|s| s.name == wanted.name)?.state.ended()?;
            end.finished_at.as_ref().filter(|_| end.exit_code == 0).map(|at| at.0)
        })
        .collect();
    ends?.into_iter().max()
}

fn started_times(status: &ContainerStatus) -> impl Iterator<Item = jiff::Timestamp> {
    let running = status.state.running().and_then(|running| running.started_at.as_ref());
    let ends = [status.state.ended(), status.last_ended.as_deref()]
        .into_iter()
        .flatten();
    // A container that could not be started has no start of its own.
    let ended = ends.filter(|end| end.reason.as_deref() != Some("StartError"));
    running
        .into_iter()
        .chain(ended.filter_map(|end| end.started_at.as_ref()))
        .map(|time| time.0)
}

fn ended_by_node(status: &PodStatus) -> Option<(String, String)> {
    let reason = status.reason.as_deref()?.to_owned();
    Some((reason, short(status.message.as_deref().unwrap_or_default())))
}

fn container(status: &ContainerStatus) -> ContainerView {
    let state = &status.state;
    ContainerView {
        name: status.name.clone(),
        image_id: Some(status.image_id.clone()).filter(|_| state.running().is_some() || status.ended().is_some()),
        restarts: status.restart_count,
        running: state.running().is_some(),
        begins_anew: status.begins_anew,
        began: state
            .running()
            .and_then(|running| running.started_at.as_ref())
            .map(|t| t.0),
        waiting: state.waiting().map(|w| {
            (
                w.reason.as_deref().unwrap_or_default().to_owned(),
                short(w.message.as_deref().unwrap_or_default()),
            )
        }),
        last: status.ended().map(|ended| end(&status.name, ended)),
    }
}

/// True if people may read a container's own words. A participant's program can write anything, such as a private route, where the
/// runner leaves its verdict. Only a verdict's closed words and numbers are used of that.
fn may_speak(container: &str, ended: &Ended) -> bool {
    let is_hosts = names::INIT_CONTAINERS.contains(&container) || container == names::CONTAINER_COLLECT;
    // Without a start there was no program yet; the words are the kubelet's.
    is_hosts || matches!(ended.reason.as_deref(), Some("StartError" | "ContainerCannotRun"))
}

fn end(container: &str, terminated: &Ended) -> EndView {
    let message = terminated.message.as_deref().unwrap_or_default();
    let is_behind_runner = Member::parse(container).is_some();
    let verdict = Verdict::parse(message).ok().filter(|_| is_behind_runner);
    let verdict = verdict.map(|verdict| Verdict {
        why: short(&verdict.why),
        ..verdict
    });
    let words = may_speak(container, terminated).then(|| words(container, message));
    let (own_reason, why) = words.unwrap_or_default();
    let out_of_memory = verdict.as_ref().is_some_and(|v| v.out_of_memory);
    let reason = terminated.reason.as_deref().unwrap_or_default().to_owned();
    EndView {
        reason: if out_of_memory { "OOMKilled".into() } else { reason },
        exit_code: terminated.exit_code,
        began: terminated.started_at.as_ref().map(|t| t.0),
        at: terminated.finished_at.as_ref().map(|t| t.0),
        verdict,
        own_reason,
        why,
    }
}

/// The reason that `workspace` or `collect` reported, and the sentence of any container that may speak.
fn words(container: &str, message: &str) -> (Option<WorkspaceReason>, Option<String>) {
    match WorkspaceVerdict::parse(message) {
        Ok(verdict) => {
            let is_own = [names::CONTAINER_WORKSPACE, names::CONTAINER_COLLECT].contains(&container);
            (is_own.then_some(verdict.reason), Some(short(&verdict.message)))
        }
        Err(error @ NotAVerdict::Schema(_)) => (None, Some(error.to_string())),
        Err(_) => match serde_json::from_str::<serde_json::Value>(message) {
            Ok(json) => (None, json["message"].as_str().map(short)),
            Err(_) => (None, (!message.trim().is_empty()).then(|| short(message))),
        },
    }
}

fn short(text: &str) -> String {
    one_line(text, LONGEST_MESSAGE)
}

#[cfg(test)]
mod tests {
    use leaderboard_protocol::verdict::What;
    use serde_json::json;

    use super::*;

    fn seen(container: &str, reason: &str, message: &str) -> EndView {
        let pod = serde_json::from_value(json!({"metadata": {"name": "p"}, "status": {"containerStatuses": [{
            "name": container, "image": "i", "imageID": "", "ready": false, "restartCount": 1,
            "state": {"terminated": {"exitCode": 1, "reason": reason, "message": message}},
        }]}}));
        view(&pod.unwrap()).containers[0].last.clone().unwrap()
    }

    #[test]
    fn a_strangers_program_puts_no_words_into_anybodys_mouth() {
        let forged = r#"{"reason": "route 7 begins at x=13", "message": "and ends at y=4"}"#;
        for container in ["agent-1", "simulator-1", "sidecar"] {
            for message in [forged, "route 7 begins at x=13"] {
                let end = seen(container, "Error", message);
                assert_eq!((end.own_reason, end.why), (None, None), "{container}: {message}");
                assert_eq!(end.verdict, None);
            }
        }
        let told = seen("workspace", "Error", forged);
        assert_eq!((told.own_reason, told.why.as_deref()), (None, Some("and ends at y=4")));
        assert_eq!(seen("contents", "Error", "disk full").why.as_deref(), Some("disk full"));
        let kubelets = seen("agent-1", "StartError", "exec: no such file");
        assert_eq!(kubelets.why.as_deref(), Some("exec: no such file"));
    }

    #[test]
    fn a_life_that_is_counted_and_does_not_run_yet_is_no_end() {
        let seen = |newest: &str, last: &str| {
            let ended = json!({"terminated": {"exitCode": 255, "reason": "Error", "containerID": last}});
            let pod = serde_json::from_value(json!({"metadata": {"name": "p"}, "status": {"containerStatuses": [{
                "name": "agent-1", "image": "i", "imageID": "", "ready": false, "restartCount": 1, "containerID": newest,
                "state": {"waiting": {"reason": "CrashLoopBackOff"}}, "lastState": ended,
            }]}}));
            let found = view(&pod.unwrap()).containers[0].clone();
            assert_eq!((found.restarts, found.last.is_some()), (1, true));
            found.begins_anew
        };
        assert!(seen("containerd://b", "containerd://a"));
        for (newest, last) in [
            ("containerd://a", "containerd://a"),
            ("", "containerd://a"),
            ("containerd://b", ""),
        ] {
            assert!(!seen(newest, last), "{newest} {last}");
        }
    }

    #[test]
    fn what_a_container_or_the_kubelet_reports_is_one_harmless_line() {
        let harmless = "disk\u{fffd}[2J full";
        for (container, reason) in [("contents", "Error"), ("agent-1", "StartError")] {
            let end = seen(container, reason, "disk\u{1b}[2J\r\n full\n");
            assert_eq!(end.why.as_deref(), Some(harmless), "{container}");
        }
        let verdict = r#"{"what":"exited","schema":1,"exitCode":1,"signal":null,"why":"disk\u001b[2J\nfull"}"#;
        assert_eq!(seen("agent-1", "Error", verdict).verdict.unwrap().why, harmless);
        let long = seen("contents", "Error", &"x".repeat(5000)).why.unwrap();
        assert_eq!(long.chars().count(), LONGEST_MESSAGE);
    }

    #[test]
    fn a_verdict_is_parsed_even_if_its_end_is_cut_off() {
        let whole = r#"{"what":"exited","round":3,"schema":1,"exitCode":0,"why":"it exited"}"#;
        let verdict = seen("agent-1", "Error", whole).verdict.unwrap();
        assert_eq!(
            (verdict.what, verdict.round, verdict.exit_code),
            (What::Exited, Some(3), Some(0))
        );
        let cut = seen("simulator-1", "Error", &whole[..40]).verdict.unwrap();
        assert_eq!((cut.what, cut.round), (What::Exited, Some(3)));
        assert_eq!(seen("workspace", "Error", whole).verdict, None, "no runner is there");
    }

    #[test]
    fn a_run_has_ended_once_every_agent_and_simulator_has_ended_well() {
        let ended = |name: &str, code: i32, at: &str| {
            json!({"name": name, "image": "i", "imageID": "", "ready": false, "restartCount": 0,
                   "state": {"terminated": {"exitCode": code, "finishedAt": at}}})
        };
        let seen = |statuses: Vec<serde_json::Value>| {
            let pod = json!({"metadata": {"name": "p"},
                "spec": {"containers": [{"name": "simulator-1"}, {"name": "agent-1"}, {"name": "extra"}]},
                "status": {"containerStatuses": statuses}});
            view(&serde_json::from_value(pod).unwrap())
                .run_ended
                .map(|at| at.to_string())
        };
        let agent = ended("agent-1", 0, "2026-01-01T00:00:07Z");
        let simulator = ended("simulator-1", 0, "2026-01-01T00:00:09Z");
        assert_eq!(
            seen(vec![agent.clone(), simulator]),
            Some("2026-01-01T00:00:09Z".into())
        );
        assert_eq!(
            seen(vec![agent.clone(), ended("simulator-1", 1, "2026-01-01T00:00:09Z")]),
            None
        );
        let running = json!({"name": "simulator-1", "image": "i", "imageID": "", "ready": true, "restartCount": 1,
            "state": {"running": {}}, "lastState": {"terminated": {"exitCode": 0}}});
        assert_eq!(seen(vec![agent.clone(), running]), None);
        assert_eq!((seen(vec![agent]), seen(vec![])), (None, None), "not all are known yet");
    }

    #[test]
    fn work_begins_with_the_first_agent_wherever_it_is_and_without_agents_with_the_first_evaluator() {
        let (early, late) = ("2026-01-01T00:00:07Z", "2026-01-01T05:00:00Z");
        let ran = |name: &str, from: &str| {
            json!({"name": name, "image": "i", "imageID": "", "ready": false, "restartCount": 0,
                   "state": {"terminated": {"exitCode": 0, "startedAt": from, "finishedAt": "2026-01-01T09:00:00Z"}}})
        };
        let waits = |name: &str| {
            json!({"name": name, "image": "i", "imageID": "", "ready": false, "restartCount": 0,
                   "state": {"waiting": {"reason": "PodInitializing"}}})
        };
        for (init, main, expected) in [
            (
                vec![ran("workspace", early), waits("agent-1")],
                vec![waits("evaluator-1")],
                None,
            ),
            (
                vec![ran("workspace", early), ran("agent-1", late)],
                vec![waits("evaluator-1")],
                Some(late),
            ),
            (
                vec![ran("workspace", early)],
                vec![waits("evaluator-1"), ran("evaluator-2", late)],
                Some(late),
            ),
            (
                vec![ran("workspace", early)],
                vec![ran("evaluator-1", early), waits("agent-1")],
                None,
            ),
            (
                vec![ran("workspace", early)],
                vec![ran("evaluator-1", early), ran("agent-1", late)],
                Some(late),
            ),
        ] {
            let status = json!({"initContainerStatuses": init, "containerStatuses": main});
            let pod = json!({"metadata": {"name": "p"}, "status": status});
            let found = view(&serde_json::from_value(pod).unwrap()).agent_started;
            assert_eq!(found.map(|at| at.to_string()).as_deref(), expected, "{status}");
        }
    }

    #[test]
    fn collect_gives_a_verdict_as_workspace_does_and_no_other_container() {
        let refused = WorkspaceVerdict::new(WorkspaceReason::InputRefused, "a.csv is a link.".to_owned()).to_json();
        let end = seen("collect", "Error", &refused);
        let found = (end.own_reason, end.why.as_deref());
        assert_eq!(found, (Some(WorkspaceReason::InputRefused), Some("a.csv is a link.")));
        for other in ["agent-1", "evaluator-1", "dataset", "labels"] {
            assert_eq!(seen(other, "Error", &refused).own_reason, None, "{other}");
        }
    }

    #[test]
    fn who_takes_a_pod_away_is_read_while_it_does() {
        let seen = |status: &str| {
            let pod = json!({"metadata": {"name": "p"}, "status": {"conditions": [
                {"type": "PodScheduled", "status": "True", "lastTransitionTime": "2026-01-01T00:00:00Z"},
                {"type": "DisruptionTarget", "status": status, "reason": "EvictionByEvictionAPI"},
            ]}});
            let seen = view(&serde_json::from_value(pod).unwrap());
            assert!(seen.scheduled.is_some());
            seen.disruption
        };
        assert_eq!(seen("True").as_deref(), Some("EvictionByEvictionAPI"));
        assert_eq!(seen("False"), None);
    }

    #[test]
    fn a_deletion_has_a_beginning_and_a_grace() {
        let pod = serde_json::from_value(json!({"metadata": {
            "name": "p", "deletionTimestamp": "2026-01-01T00:10:00Z", "deletionGracePeriodSeconds": 600,
        }}));
        let seen = view(&pod.unwrap());
        assert_eq!(seen.deleted.unwrap().to_string(), "2026-01-01T00:00:00Z");
        assert_eq!(seen.delete_by.unwrap().to_string(), "2026-01-01T00:10:00Z");
    }

    #[test]
    fn a_verdict_of_a_newer_workspace_is_not_guessed_at() {
        let newer = json!({"schema": 2, "reason": "OfTomorrow", "message": "Something."}).to_string();
        let end = seen("workspace", "Error", &newer);
        let why = "the verdict of `workspace` has schema 2, and this operator reads 1";
        assert_eq!((end.own_reason, end.why.as_deref()), (None, Some(why)));
    }
}
