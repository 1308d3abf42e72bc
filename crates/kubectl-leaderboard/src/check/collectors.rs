//! What else stores the lines of a run: where FluentD or a program like it runs on the node of the Pods, and the Leaderboard has a log
//! group too, CloudWatch may have each line twice.
//!
//! Asked with the person's own right to list `DaemonSets`; without it, the command that shows them is the step to do.

use leaderboard_api::Leaderboard;
use leaderboard_api::log_collectors::{self, LogCollector};

use super::finding::{Finding, Mark, Part, finding_of};
use crate::cluster::Cluster;
use crate::error::Error;
use crate::text::clean;
use kube::ResourceExt;

/// What is known of those who collect logs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Collectors {
    /// It was not found out, and why.
    Unknown(String),
    Known {
        found: Vec<Collector>,
        /// The node of the check's Pod, if it had one.
        node: Option<String>,
    },
}

/// One of them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Collector {
    pub of: LogCollector,
    /// Whether it runs on the node of the check's Pod, if that is known.
    pub is_on_node: Option<bool>,
}

/// Asks, as far as this person may.
pub async fn ask(cluster: &Cluster, node: Option<&str>) -> Collectors {
    let sets = match cluster.daemon_sets().await {
        Ok(sets) => sets,
        Err(Error::Forbidden(right)) => return Collectors::Unknown(clean(&format!("missing right: {right}"))),
        Err(error) => return Collectors::Unknown(clean(&error.to_string())),
    };
    let mut found = Vec::new();
    for of in log_collectors::find(&sets) {
        let is_on_node = match node {
            // Who may not list its Pods knows that it may be there.
            Some(node) => cluster.owners_on_node(&of.namespace, node).await.ok(),
            None => None,
        };
        let is_on_node = is_on_node.map(|owners| owners.contains(&of.uid));
        found.push(Collector { of, is_on_node });
    }
    let node = node.map(str::to_owned);
    Collectors::Known { found, node }
}

impl Collectors {
    /// The line of the table about them; none without a log group. A host may want both, so this is never a failure.
    pub(super) fn finding(&self, leaderboard: &Leaderboard) -> Option<Finding> {
        let group = leaderboard.spec.log_group.as_ref()?;
        let part = Part::Collectors;
        let (found, node) = match self {
            Self::Unknown(why) => {
                return Some(Finding {
                    step: Some("Look for FluentD, Fluent Bit or the CloudWatch agent:".to_owned()),
                    commands: vec!["kubectl get daemonsets --all-namespaces --output wide".to_owned()],
                    ..finding_of(part, Mark::Open, format!("not known: {why}"))
                });
            }
            Self::Known { found, node } => (found, node.as_deref()),
        };
        let (far, near): (Vec<_>, Vec<_>) = found.iter().partition(|one| one.is_on_node == Some(false));
        if near.is_empty() {
            let text = match (&far[..], node) {
                ([], _) | (_, None) => "no DaemonSet collects the lines of containers".to_owned(),
                (far, Some(node)) => format!("none on {node}; elsewhere {}", names(far)),
            };
            return Some(finding_of(part, Mark::Works, text));
        }
        let runs = match node {
            Some(node) if near.iter().all(|one| one.is_on_node == Some(true)) => format!("on {node}"),
            _ => "and may run on the nodes of the Pods".to_owned(),
        };
        let twice = if near.iter().any(|one| one.of.names_group(&group.name)) {
            format!("has the log group {}, too: each line is stored twice", group.name)
        } else {
            "reads what containers print, too: each line may be stored twice".to_owned()
        };
        Some(Finding {
            step: Some(
                "Leave the namespace out of what it reads and restart it, or remove logGroup from the Leaderboard (docs/migrate.md, \
                 Logs twice):"
                    .to_owned(),
            ),
            commands: commands(&near, leaderboard),
            ..finding_of(part, Mark::Note, format!("{}, {runs}, {twice}", names(&near)))
        })
    }
}

fn names(of: &[&Collector]) -> String {
    let names: Vec<String> = of.iter().map(|one| one.of.to_string()).collect();
    names.join(", ")
}

/// The one way for each, and the other way for all.
fn commands(near: &[&Collector], leaderboard: &Leaderboard) -> Vec<String> {
    let (name, namespace) = (leaderboard.name_any(), leaderboard.namespace().unwrap_or_default());
    let mut commands = Vec::new();
    for LogCollector {
        product,
        namespace: of,
        name,
        config,
        ..
    } in near.iter().map(|one| &one.of)
    {
        let line = product.exclusion(&namespace).map(|line| format!(" # {line}"));
        let what = config
            .as_ref()
            .map_or_else(|| format!("daemonset {name}"), |map| format!("configmap {map}"));
        commands.push(format!("kubectl -n {of} edit {what}{}", line.unwrap_or_default()));
        commands.push(format!("kubectl -n {of} rollout restart daemonset {name}"));
    }
    commands.push(format!(
        "kubectl -n {namespace} patch leaderboard {name} --type merge --patch '{{\"spec\":{{\"logGroup\":null}}}}'"
    ));
    commands
}
