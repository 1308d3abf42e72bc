//! Keeps a Job off the nodes that have failed earlier ones of its attempt. Pure, and on the finished template: an overlay's lists would
//! take the place of these.

use leaderboard_api::FailedNode;
use serde_json::{Value, json};

/// Taken as the node's name, which autoscalers understand in an affinity; of a node itself they know no name yet.
pub(super) const HOSTNAME: &str = "kubernetes.io/hostname";
pub(super) const REQUIRED: &str = "requiredDuringSchedulingIgnoredDuringExecution";
const PREFERRED: &str = "preferredDuringSchedulingIgnoredDuringExecution";
/// Jobs of an attempt after which it is not by chance.
const REFUSED_AFTER: i32 = 2;
/// The most that Kubernetes takes.
const WEIGHT: i32 = 100;

/// Prefers other nodes to each of these, and takes none that has failed twice.
pub(super) fn avoid(pod: &mut Value, nodes: &[FailedNode]) {
    let names = |is_wanted: fn(&FailedNode) -> bool| -> Vec<&str> {
        let wanted = nodes.iter().filter(|node| is_wanted(node));
        wanted.map(|node| node.node_name.as_str()).collect()
    };
    let suspects = names(|node| node.jobs < REFUSED_AFTER);
    if !suspects.is_empty() {
        let term = json!({"weight": WEIGHT, "preference": {"matchExpressions": [elsewhere(&suspects)]}});
        let terms = &mut pod["affinity"]["nodeAffinity"][PREFERRED];
        match terms.as_array_mut() {
            Some(terms) => terms.push(term),
            None => *terms = json!([term]),
        }
    }
    let refused = names(|node| node.jobs >= REFUSED_AFTER);
    if !refused.is_empty() {
        require(pod, &elsewhere(&refused));
    }
}

fn elsewhere(nodes: &[&str]) -> Value {
    json!({"key": HOSTNAME, "operator": "NotIn", "values": nodes})
}

fn require(pod: &mut Value, elsewhere: &Value) {
    let terms = &mut pod["affinity"]["nodeAffinity"][REQUIRED]["nodeSelectorTerms"];
    // One of them has to hold, so each needs it.
    match terms.as_array_mut().filter(|terms| !terms.is_empty()) {
        Some(terms) => {
            for term in terms {
                match term["matchExpressions"].as_array_mut() {
                    Some(expressions) => expressions.push(elsewhere.clone()),
                    None => term["matchExpressions"] = json!([elsewhere]),
                }
            }
        }
        None => *terms = json!([{"matchExpressions": [elsewhere]}]),
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::Case;
    use super::*;

    fn node(name: &str, jobs: i32) -> FailedNode {
        FailedNode {
            node_name: name.into(),
            jobs,
        }
    }

    fn affinity(more: Value, nodes: &[FailedNode]) -> Value {
        let mut case = Case::new("V2", more);
        case.failed_nodes = nodes.to_vec();
        case.json()["spec"]["template"]["spec"]["affinity"]["nodeAffinity"].clone()
    }

    #[test]
    fn a_node_that_has_failed_once_is_not_preferred_and_one_that_has_failed_twice_is_avoided() {
        let nodes = [node("a", 1), node("b", 2), node("c", 3)];
        assert_eq!(affinity(json!({}), &[]), Value::Null);
        let other = json!({"weight": 100, "preference": {"matchExpressions": [elsewhere(&["a"])]}});
        assert_eq!(affinity(json!({}), &nodes[..1]), json!({PREFERRED: [other]}));
        let found = affinity(json!({}), &nodes);
        let elsewhere = elsewhere(&["b", "c"]);
        assert_eq!(found[PREFERRED], json!([other]));
        assert_eq!(
            found[REQUIRED]["nodeSelectorTerms"],
            json!([{"matchExpressions": [elsewhere]}])
        );
    }

    #[test]
    fn the_hosts_own_terms_stay_and_each_of_them_avoids_the_node() {
        let nodes = [node("a", 1), node("b", 2)];
        let own = json!({"key": "zone", "operator": "In", "values": ["z"]});
        let hosts = json!([{"matchExpressions": [own]}, {"matchFields": [own]}]);
        let preferred = json!({"weight": 1, "preference": {"matchExpressions": [own]}});
        let overlay = json!({"spec": {"affinity": {"nodeAffinity": {
            REQUIRED: {"nodeSelectorTerms": hosts}, PREFERRED: [preferred],
        }}}});
        let found = affinity(json!({"podOverrides": overlay}), &nodes);
        let elsewhere = elsewhere(&["b"]);
        let expected = json!([
            {"matchExpressions": [own, elsewhere]},
            {"matchFields": [own], "matchExpressions": [elsewhere]},
        ]);
        assert_eq!(found[REQUIRED]["nodeSelectorTerms"], expected);
        assert_eq!(found[PREFERRED][0], preferred);
        assert_eq!(found[PREFERRED][1]["weight"], 100);
    }
}
