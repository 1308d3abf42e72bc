//! What the controller will have to do in the cluster: asked for at the start, so that /readyz names what is not allowed.
//!
//! The same rights as the chart's `controller-rbac.yaml` grants, which the test below holds against it. Two are not asked
//! for: the question itself, and each Leaderboard's Secret, whose absence its condition `Ready` shows (`TokenMissing`).

use crate::controller::runtime::leader;
use crate::kubernetes::Namespaces;
use crate::kubernetes::preflight::Need;
use leaderboard_api::GROUP;

/// Group, resource, verbs.
type Right = (&'static str, &'static str, &'static [&'static str]);

/// In the namespaces of the Leaderboards.
const OF_RUNS: [Right; 14] = [
    (GROUP, "leaderboards", &["list", "watch", "patch"]),
    (
        GROUP,
        "submissions",
        &["get", "list", "watch", "create", "patch", "delete"],
    ),
    (GROUP, "leaderboards/status", &["patch"]),
    (GROUP, "submissions/status", &["patch"]),
    (GROUP, "leaderboards/finalizers", &["update"]),
    (GROUP, "submissions/finalizers", &["update"]),
    ("batch", "jobs", &["list", "watch", "create", "delete"]),
    ("", "pods", &["list", "watch", "patch", "delete"]),
    ("", "pods/log", &["get"]),
    ("", "events", &["list", "watch"]),
    ("events.k8s.io", "events", &["create", "patch"]),
    (
        "networking.k8s.io",
        "networkpolicies",
        &["list", "watch", "create", "patch"],
    ),
    (
        "resource.k8s.io",
        "resourceclaimtemplates",
        &["get", "list", "create", "patch", "delete"],
    ),
    (LEASES.0, LEASES.1, &["get"]),
];
/// In the whole cluster: a lost node, and whether another installation still holds its Lease, wherever it is installed.
const OF_THE_CLUSTER: [Right; 3] = [
    ("", "nodes", &["get", "list", "watch"]),
    ("scheduling.k8s.io", "priorityclasses", &["get"]),
    (LEASES.0, LEASES.1, &["get"]),
];
const LEASES: (&str, &str) = ("coordination.k8s.io", "leases");

/// Everything, for the namespaces that are served, with the rights of the whole cluster or without.
pub(super) fn needs<'a>(
    namespaces: &'a Namespaces,
    has_cluster_rights: bool,
    lease: &'a leader::Settings,
) -> Vec<Need<'a>> {
    let of_runs = namespaces
        .each()
        .into_iter()
        .flat_map(|namespace| all(&OF_RUNS, namespace));
    let of_cluster = has_cluster_rights
        .then(|| all(&OF_THE_CLUSTER, None))
        .into_iter()
        .flatten();
    // Of a request that creates, the name is not known when it is allowed.
    let of_lease = [("create", false), ("get", false), ("update", true)].map(|(verb, is_named)| Need {
        group: LEASES.0,
        resource: LEASES.1,
        verb,
        namespace: Some(&lease.namespace),
        name: is_named.then_some(lease.name.as_str()),
    });
    of_runs.chain(of_cluster).chain(of_lease).collect()
}

fn all<'a>(rights: &'static [Right], namespace: Option<&'a str>) -> impl Iterator<Item = Need<'a>> {
    rights.iter().flat_map(move |(group, resource, verbs)| {
        verbs.iter().map(move |verb| Need {
            group,
            resource,
            verb,
            namespace,
            name: None,
        })
    })
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    const CHART: &str = include_str!("../../../charts/leaderboard-operator/templates/controller-rbac.yaml");
    /// Group, resource, verb, and whether it is of one object.
    type Row = (String, String, String, bool);

    fn list(line: &str) -> Vec<String> {
        let (_, values) = line.split_once('[').unwrap();
        values
            .trim_end_matches(']')
            .split(',')
            .map(|value| value.trim().trim_matches('"').to_owned())
            .collect()
    }

    /// The rules that the template defines under this name, or those that stand outside of all definitions.
    fn block(name: Option<&str>) -> impl Iterator<Item = &'static str> {
        let is_wanted = move |inside: Option<&str>| inside == name;
        let mut inside = None;
        CHART.lines().map(str::trim).filter(move |line| {
            if let Some(rest) = line.strip_prefix("{{- define \"") {
                inside = rest.split('"').next();
            } else if *line == "{{- end }}" {
                inside = None;
            }
            is_wanted(inside)
        })
    }

    /// What the chart grants the controller by one block of its template, which has no condition in it.
    fn granted(name: Option<&str>) -> BTreeSet<Row> {
        let mut rows = BTreeSet::new();
        let (mut groups, mut resources, mut is_named) = (Vec::new(), Vec::new(), false);
        for line in block(name) {
            assert!(
                name.is_none() || !line.starts_with("{{- if "),
                "a condition that this test does not know"
            );
            if line.starts_with("- apiGroups:") {
                (groups, is_named) = (list(line), false);
            } else if line.starts_with("resources:") {
                resources = list(line);
            } else if line.starts_with("resourceNames:") {
                is_named = true;
            } else if line.starts_with("verbs:") {
                for (group, resource) in groups.iter().flat_map(|g| resources.iter().map(move |r| (g, r))) {
                    rows.extend(
                        list(line)
                            .into_iter()
                            .map(|verb| (group.clone(), resource.clone(), verb, is_named)),
                    );
                }
            }
        }
        rows.retain(|(_, resource, _, _)| resource != "selfsubjectaccessreviews");
        rows
    }

    fn asked(namespaces: &Namespaces, has_cluster_rights: bool, of: Option<&str>) -> BTreeSet<Row> {
        let lease = leader::Settings::new("system", "name", leader::Identity::random("test"));
        let needs = needs(namespaces, has_cluster_rights, &lease);
        let of = needs.iter().filter(|need| need.namespace == of);
        of.map(|need| {
            let [group, resource, verb] = [need.group, need.resource, need.verb].map(str::to_owned);
            (group, resource, verb, need.name.is_some())
        })
        .collect()
    }

    #[test]
    fn what_is_asked_for_is_what_the_chart_grants() {
        let of_runs = granted(Some("operator.controller.rules"));
        let of_cluster = granted(Some("operator.controller.clusterRules"));
        assert!(!of_runs.is_empty() && !of_cluster.is_empty());
        let two = Namespaces::of(["one", "two"].map(str::to_owned));
        for has_cluster_rights in [true, false] {
            assert_eq!(asked(&two, has_cluster_rights, Some("one")), of_runs);
            assert_eq!(asked(&two, has_cluster_rights, Some("two")), of_runs);
            assert_eq!(asked(&two, has_cluster_rights, Some("system")), granted(None));
        }
        assert_eq!(asked(&two, true, None), of_cluster);
        assert_eq!(asked(&two, false, None), BTreeSet::new());
        assert_eq!(asked(&Namespaces::All, false, None), of_runs);
        let all = of_runs.union(&of_cluster).cloned().collect();
        assert_eq!(asked(&Namespaces::All, true, None), all);
    }

    #[test]
    fn each_is_asked_where_it_is_used() {
        let lease = leader::Settings::new("system", "operator", leader::Identity::random("test"));
        let asked: Vec<String> = needs(&Namespaces::of(["one".to_owned()]), true, &lease)
            .iter()
            .map(ToString::to_string)
            .collect();
        for expected in [
            "watch networkpolicies of networking.k8s.io in namespace one",
            "get pods/log in namespace one",
            "update leases of coordination.k8s.io operator in namespace system",
            "watch nodes in all namespaces",
        ] {
            assert!(asked.iter().any(|need| need == expected), "{expected}: {asked:#?}");
        }
    }
}
