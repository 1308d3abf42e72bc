//! `DaemonSets` that collect what containers print, as FluentD of an earlier pipeline does: with one of them and a log group of the
//! Leaderboard each line of a run is stored twice.
//!
//! Called by commands for people, which list with the person's own credentials. Pure.

use std::fmt;

use k8s_openapi::api::apps::v1::DaemonSet;

/// A program that collects logs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Product {
    FluentD,
    FluentBit,
    CloudWatchAgent,
}

impl Product {
    /// By its image, wherever that is mirrored.
    fn of_image(image: &str) -> Option<Self> {
        let repository = repository(image).to_ascii_lowercase();
        [
            ("fluent-bit", Self::FluentBit),
            ("fluentbit", Self::FluentBit),
            ("fluentd", Self::FluentD),
            ("cloudwatch-agent", Self::CloudWatchAgent),
        ]
        .into_iter()
        .find(|(part, _)| repository.contains(part))
        .map(|(_, product)| product)
    }

    /// What leaves a namespace out of the files that it reads, in its own syntax.
    pub fn exclusion(self, namespace: &str) -> Option<String> {
        let files = format!("/var/log/containers/*_{namespace}_*.log");
        match self {
            Self::FluentD => Some(format!("exclude_path [\"{files}\"]")),
            Self::FluentBit => Some(format!("Exclude_Path {files}")),
            Self::CloudWatchAgent => None,
        }
    }
}

impl fmt::Display for Product {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::FluentD => "FluentD",
            Self::FluentBit => "Fluent Bit",
            Self::CloudWatchAgent => "the CloudWatch agent",
        })
    }
}

/// An image without tag and digest.
fn repository(image: &str) -> &str {
    let image = image.split('@').next().unwrap_or_default();
    match image.rsplit_once(':') {
        Some((repository, tag)) if !tag.contains('/') => repository,
        _ => image,
    }
}

/// A `DaemonSet` that collects logs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LogCollector {
    pub product: Product,
    pub namespace: String,
    pub name: String,
    pub uid: String,
    /// Nodes on which it runs.
    pub nodes: i32,
    /// The first ConfigMap that it mounts.
    pub config: Option<String>,
    /// Values of its variables: the original's FluentD gets its log group by one.
    values: Vec<String>,
}

impl LogCollector {
    fn of(set: &DaemonSet) -> Option<Self> {
        let pod = set.spec.as_ref()?.template.spec.as_ref()?;
        let mut images = pod.containers.iter().filter_map(|container| container.image.as_deref());
        let product = images.find_map(Product::of_image)?;
        let volumes = pod.volumes.iter().flatten();
        let maps = volumes.filter_map(|volume| Some(volume.config_map.as_ref()?.name.clone()));
        let variables = pod
            .containers
            .iter()
            .flat_map(|container| container.env.iter().flatten());
        let meta = &set.metadata;
        Some(Self {
            product,
            namespace: meta.namespace.clone().unwrap_or_default(),
            name: meta.name.clone().unwrap_or_default(),
            uid: meta.uid.clone().unwrap_or_default(),
            nodes: set.status.as_ref().map_or(0, |status| status.current_number_scheduled),
            config: maps.into_iter().next(),
            values: variables.filter_map(|variable| variable.value.clone()).collect(),
        })
    }

    /// Whether its variables name a log group. One that is in its ConfigMap alone is not seen.
    pub fn names_group(&self, group: &str) -> bool {
        self.values.iter().any(|value| value == group)
    }
}

impl fmt::Display for LogCollector {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} (DaemonSet {}/{})", self.product, self.namespace, self.name)
    }
}

/// Those of all `DaemonSets` that collect logs.
pub fn find(sets: &[DaemonSet]) -> Vec<LogCollector> {
    sets.iter().filter_map(LogCollector::of).collect()
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    /// As the original pipeline's is.
    fn set(name: &str, image: &str) -> DaemonSet {
        let object = json!({
            "apiVersion": "apps/v1", "kind": "DaemonSet", "metadata": {"name": name, "namespace": "kube-system", "uid": "u1"},
            "spec": {"selector": {}, "template": {"spec": {
                "containers": [{"name": name, "image": image, "env": [{"name": "LOG_GROUP_NAME", "value": "leaderboard-20"}]}],
                "volumes": [{"name": "varlog", "hostPath": {"path": "/var/log"}},
                            {"name": "config", "configMap": {"name": "fluentd-config"}}],
            }}},
            "status": {"currentNumberScheduled": 2, "desiredNumberScheduled": 3, "numberMisscheduled": 0, "numberReady": 2},
        });
        serde_json::from_value(object).unwrap()
    }

    #[test]
    fn a_collector_is_known_by_its_image_wherever_it_is_mirrored() {
        for (image, product) in [
            (
                "fluent/fluentd-kubernetes-daemonset:v1.16.1-debian-cloudwatch-1.2",
                Some(Product::FluentD),
            ),
            ("registry:5000/mirror/FluentD", Some(Product::FluentD)),
            (
                "public.ecr.aws/aws-observability/aws-for-fluent-bit:2.32.2",
                Some(Product::FluentBit),
            ),
            ("cr.fluentbit.io/fluent/fluent-bit@sha256:00", Some(Product::FluentBit)),
            (
                "public.ecr.aws/cloudwatch-agent/cloudwatch-agent:1.3",
                Some(Product::CloudWatchAgent),
            ),
            ("registry.k8s.io/kube-proxy:v1.35.4", None),
            ("nvcr.io/nvidia/k8s-device-plugin:fluentd", None),
        ] {
            let found = find(&[set("x", image)]);
            assert_eq!(found.first().map(|one| one.product), product, "{image}");
        }
        assert_eq!(find(&[DaemonSet::default()]), []);
    }

    #[test]
    fn what_a_host_needs_of_it_is_read() {
        let found = find(&[set("proxy", "kube-proxy:1"), set("fluentd", "fluent/fluentd:v1")]);
        let [one] = &found[..] else { panic!("{found:?}") };
        assert_eq!(one.to_string(), "FluentD (DaemonSet kube-system/fluentd)");
        assert_eq!(
            (one.nodes, one.config.as_deref(), one.uid.as_str()),
            (2, Some("fluentd-config"), "u1")
        );
        assert!(one.names_group("leaderboard-20") && !one.names_group("leaderboard-10"));
        let excluded = one.product.exclusion("carla").unwrap();
        assert_eq!(excluded, "exclude_path [\"/var/log/containers/*_carla_*.log\"]");
    }
}
