//! What the controller will have to do in the cluster: asked for at the start, so that /readyz names what is not allowed.
//!
//! The same rights as the chart's `controller-rbac.yaml` grants, which the test below holds against it. Two are not asked
//! for: the question itself, and each Leaderboard's Secret, whose absence its condition `Ready` shows (`TokenMissing`).

use crate::controller::runtime::leader;
use crate::kubernetes::preflight::Need;
use leaderboard_api::GROUP;

/// Group, resource, verbs.
type Right = (&'static str, &'static str, &'static [&'static str]);

/// In the namespaces of the Leaderboards.
const OF_RUNS: [Right; 14] = [
    (GROUP, "leaderboards", &["get", "list", "watch", "patch"]),
    (
        GROUP,
        "submissions",
        &["get", "list", "watch", "create", "patch", "delete"],
    ),
    (GROUP, "leaderboards/status", &["get", "patch"]),
    (GROUP, "submissions/status", &["get", "patch"]),
    (GROUP, "leaderboards/finalizers", &["update"]),
    (GROUP, "submissions/finalizers", &["update"]),
    ("batch", "jobs", &["get", "list", "watch", "create", "delete"]),
    ("", "pods", &["get", "list", "watch", "patch", "delete"]),
    ("", "pods/log", &["get"]),
    ("", "events", &["get", "list"]),
    ("events.k8s.io", "events", &["create", "patch"]),
    (
        "networking.k8s.io",
        "networkpolicies",
        &["get", "list", "watch", "create", "patch"],
    ),
    (LEASES.0, LEASES.1, &["get"]),
    ("", "nodes", &["get", "list", "watch"]),
];
/// Kinds without a namespace: an operator of one namespace has no right to them and does without.
const OF_THE_CLUSTER: [&str; 1] = ["nodes"];
const LEASES: (&str, &str) = ("coordination.k8s.io", "leases");

/// Everything, for one namespace or for all.
pub(super) fn needs<'a>(namespace: Option<&'a str>, lease: &'a leader::Settings) -> Vec<Need<'a>> {
    let of_runs = OF_RUNS.iter().filter(|(_, resource, _)| {
        let is_of_the_cluster = OF_THE_CLUSTER.contains(resource);
        namespace.is_none() || !is_of_the_cluster
    });
    let of_runs = of_runs.flat_map(|(group, resource, verbs)| {
        verbs.iter().map(move |verb| Need {
            group,
            resource,
            verb,
            namespace,
            name: None,
        })
    });
    // Of a request that creates, the name is not known when it is allowed.
    let of_lease = [("create", false), ("get", false), ("update", true)].map(|(verb, is_named)| Need {
        group: LEASES.0,
        resource: LEASES.1,
        verb,
        namespace: Some(&lease.namespace),
        name: is_named.then_some(lease.name.as_str()),
    });
    of_runs.chain(of_lease).collect()
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

    /// What the chart grants the controller, in one namespace or in all. Of the template's language it knows the one `if`.
    fn granted(is_namespaced: bool) -> BTreeSet<Row> {
        let (mut rows, mut skipped, mut depth) = (BTreeSet::new(), false, 0);
        let (mut groups, mut resources, mut is_named) = (Vec::new(), Vec::new(), false);
        for line in CHART.lines().map(str::trim) {
            if line.starts_with("{{- if ") {
                assert_eq!(
                    line, "{{- if not .Values.watchNamespace }}",
                    "a condition that this test does not know"
                );
                (skipped, depth) = (is_namespaced, depth + 1);
            } else if line == "{{- end }}" && depth > 0 {
                (skipped, depth) = (false, depth - 1);
            } else if line.starts_with("- apiGroups:") {
                (groups, is_named) = (list(line), false);
            } else if line.starts_with("resources:") {
                resources = list(line);
            } else if line.starts_with("resourceNames:") {
                is_named = true;
            } else if line.starts_with("verbs:") && !skipped {
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

    #[test]
    fn what_is_asked_for_is_what_the_chart_grants() {
        let lease = leader::Settings::new("system", "name", leader::Identity::random("test"));
        for namespace in [None, Some("one")] {
            let asked: BTreeSet<Row> = needs(namespace, &lease)
                .iter()
                .map(|need| {
                    let [group, resource, verb] = [need.group, need.resource, need.verb].map(str::to_owned);
                    (group, resource, verb, need.name.is_some())
                })
                .collect();
            let granted = granted(namespace.is_some());
            let (idle, missing) = (granted.difference(&asked), asked.difference(&granted));
            let (idle, missing): (Vec<_>, Vec<_>) = (idle.collect(), missing.collect());
            assert!(
                idle.is_empty() && missing.is_empty(),
                "namespace {namespace:?}: granted and not asked for: {idle:?}; asked for and not granted: {missing:?}"
            );
        }
    }

    #[test]
    fn each_is_asked_where_it_is_used() {
        let lease = leader::Settings::new("system", "operator", leader::Identity::random("test"));
        let asked: Vec<String> = needs(Some("one"), &lease).iter().map(ToString::to_string).collect();
        for expected in [
            "watch networkpolicies of networking.k8s.io in namespace one",
            "get pods/log in namespace one",
            "update leases of coordination.k8s.io operator in namespace system",
        ] {
            assert!(asked.iter().any(|need| need == expected), "{expected}: {asked:#?}");
        }
    }
}
