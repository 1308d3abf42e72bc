//! Full disks: from the kubelet's words of an eviction to a failure, and its class. Pure.
//!
//! Called by `live` and `end`. Only what was measured of agents alone is evidence against them, by the kubelet or, on the volume of the logs,
//! by `logcopy`. The Pod's own account, and a volume that others write to as well, hold what the host's programs save and their core dumps; such an end
//! is counted by team.

use serde_json::Value;

use super::failure::{charged, infrastructure};
use super::status::PlanBuilder;
use crate::controller::submissions::pod_layout::{LOGS_VOLUME, SHM_VOLUME};
use leaderboard_api::text::sentence;
use leaderboard_api::{Failure, LeaderboardSpec, names, reasons};

/// The failure of a Pod that was evicted because of its own disk. Another one on the same node would run into it again.
pub(super) fn full(draft: &PlanBuilder<'_>) -> Option<Failure> {
    let pod = draft.view.pod.as_ref()?;
    let (_, words) = pod.ended_by_node.as_ref().filter(|(reason, _)| reason == "Evicted")?;
    let account = Account::of(words)?;
    let what = format!("The Pod was evicted because its disk was full: {}", sentence(words));
    let is_agents = match account {
        Account::Container(name) => is_agent(name),
        Account::Volume(LOGS_VOLUME) => {
            let report = draft.view.report.ours().filter(|report| report.pod_uid == pod.uid);
            report.is_some_and(|report| report.agents_fill_disk)
        }
        Account::Volume(name) => name.starts_with(SHM_VOLUME) || is_of_agents_alone(name, draft.leaderboard()),
        Account::Pod => false,
    };
    Some(if is_agents {
        charged(reasons::DISK_FULL, &what)
    } else {
        infrastructure(reasons::DISK_FULL, &what)
    })
}

/// On whose account the kubelet has measured.
enum Account<'a> {
    Container(&'a str),
    Volume(&'a str),
    Pod,
}

impl<'a> Account<'a> {
    /// None: another limit, or the node's own shortage, which names containers too.
    fn of(words: &'a str) -> Option<Self> {
        if let Some((name, _)) = words
            .strip_prefix("Container ")
            .and_then(|rest| rest.split_once(" exceeded its local ephemeral storage limit"))
        {
            return Some(Self::Container(name));
        }
        if let Some((name, _)) = words
            .strip_prefix("Usage of EmptyDir volume \"")
            .and_then(|rest| rest.split_once('"'))
        {
            return Some(Self::Volume(name));
        }
        words
            .starts_with("Pod ephemeral local storage usage exceeds")
            .then_some(Self::Pod)
    }
}

/// A container of an agent, or the name that stands for those of all agents in an overlay.
fn is_agent(name: &str) -> bool {
    name == "agent" || names::is_agent_container(name)
}

/// True if agents write to a volume of the hosts' own, and no other container does.
fn is_of_agents_alone(volume: &str, leaderboard: Option<&LeaderboardSpec>) -> bool {
    let Some(pod) = leaderboard.and_then(|spec| spec.pod_overrides.as_ref()?.get("spec")) else {
        return false;
    };
    let writes = |container: &&Value| {
        let mounts = container["volumeMounts"].as_array();
        let mut mounts = mounts.into_iter().flatten();
        mounts.any(|mount| mount["name"] == volume && mount["readOnly"] != true)
    };
    let lists = ["initContainers", "containers"].map(|list| pod[list].as_array());
    let mut writers = lists.into_iter().flatten().flatten().filter(writes).peekable();
    writers.peek().is_some() && writers.all(|container| container["name"].as_str().is_some_and(is_agent))
}
