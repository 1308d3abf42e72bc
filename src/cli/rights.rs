//! Rights by the rules of a role, as `helm test` hands them to `preflight`: the chart's own, so that no second list can differ. Pure.

use std::str::FromStr;

use k8s_openapi::api::authorization::v1::ResourceAttributes;
use k8s_openapi::api::rbac::v1::PolicyRule;
use serde::Deserialize;

use crate::kubernetes::Namespaces;

/// Rules, and where they apply.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Rights {
    /// In each namespace that is served.
    served: Vec<PolicyRule>,
    /// In the whole cluster.
    cluster: Vec<PolicyRule>,
    /// In the operator's own namespace.
    own: Vec<PolicyRule>,
}

impl FromStr for Rights {
    type Err = serde_json::Error;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        serde_json::from_str(text)
    }
}

impl Rights {
    /// Each right by itself.
    pub fn needs(&self, served: &Namespaces, own: &str) -> Vec<ResourceAttributes> {
        let served = served.each().into_iter();
        let served = served.flat_map(|namespace| all(&self.served, namespace));
        served
            .chain(all(&self.cluster, None))
            .chain(all(&self.own, Some(own)))
            .collect()
    }
}

fn all(rules: &[PolicyRule], namespace: Option<&str>) -> impl Iterator<Item = ResourceAttributes> {
    rules.iter().flat_map(move |rule| of_rule(rule, namespace))
}

fn of_rule(rule: &PolicyRule, namespace: Option<&str>) -> Vec<ResourceAttributes> {
    let names: Vec<Option<&String>> = match rule.resource_names.as_deref() {
        None | Some([]) => vec![None],
        Some(names) => names.iter().map(Some).collect(),
    };
    let mut needs = Vec::new();
    for group in rule.api_groups.iter().flatten() {
        for path in rule.resources.iter().flatten() {
            let (resource, subresource) = path.split_once('/').unzip();
            for name in &names {
                needs.extend(rule.verbs.iter().map(|verb| ResourceAttributes {
                    group: Some(group.clone()),
                    resource: Some(resource.unwrap_or(path).to_owned()),
                    subresource: subresource.map(str::to_owned),
                    verb: Some(verb.clone()),
                    namespace: namespace.map(str::to_owned),
                    name: name.cloned(),
                    ..ResourceAttributes::default()
                }));
            }
        }
    }
    needs
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kubernetes::preflight::described;

    #[test]
    fn each_right_of_a_rule_is_asked_for_where_the_rule_applies() {
        let rights: Rights = r#"{
            "served": [{"apiGroups": [""], "resources": ["pods", "pods/log"], "verbs": ["get", "list"]}],
            "cluster": [{"apiGroups": [""], "resources": ["nodes"], "verbs": ["watch"]}],
            "own": [{"apiGroups": ["coordination.k8s.io"], "resources": ["leases"], "resourceNames": ["operator"], "verbs": ["update"]}]
        }"#
        .parse()
        .unwrap();
        let served = Namespaces::of(["one", "two"].map(str::to_owned));
        let asked: Vec<String> = rights.needs(&served, "system").iter().map(described).collect();
        assert_eq!(
            asked,
            [
                "get pods in namespace one",
                "list pods in namespace one",
                "get pods/log in namespace one",
                "list pods/log in namespace one",
                "get pods in namespace two",
                "list pods in namespace two",
                "get pods/log in namespace two",
                "list pods/log in namespace two",
                "watch nodes in all namespaces",
                "update leases of coordination.k8s.io operator in namespace system",
            ]
        );
    }

    #[test]
    fn a_list_that_has_no_place_is_refused() {
        assert!(Rights::from_str(r#"{"clusters": []}"#).is_err());
        assert!(
            Rights::from_str("{}")
                .unwrap()
                .needs(&Namespaces::All, "system")
                .is_empty()
        );
    }
}
