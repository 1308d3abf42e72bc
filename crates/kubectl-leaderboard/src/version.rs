//! `version`: this program's version, and that of the operator that drives the Leaderboards of the namespace. `lines` is pure.

use std::collections::BTreeMap;
use std::process::ExitCode;

use clap::Args;
use k8s_openapi::api::core::v1::Pod;
use kube::{Api, ResourceExt};
use serde_json::{Value, json};

use crate::cluster::{Cluster, Target};
use crate::commands::frame;
use crate::dashboard::{operator_namespace, replicas};
use crate::error::Error;
use crate::output::{self, Output, print};
use crate::text::{Frame, counted};

/// This program's version.
const OWN: &str = env!("CARGO_PKG_VERSION");
/// Where the program of a version is.
const RELEASES: &str = concat!(env!("CARGO_PKG_REPOSITORY"), "/releases/tag/v");
/// The label by which the chart marks a Pod with the version.
const LABEL: &str = "app.kubernetes.io/version";

/// Arguments of `version`.
#[derive(Args, Debug)]
pub struct Version {
    /// Only this program's: no cluster is asked.
    #[arg(long)]
    client: bool,
    /// The operator's namespace [default: that of the operator which drives the Leaderboards of this namespace].
    #[arg(long, value_name = "NAMESPACE")]
    operator_namespace: Option<String>,
    #[command(flatten)]
    output: Output,
}

/// Number of replicas by version and image.
pub(super) type Running = BTreeMap<(String, String), usize>;

/// Prints the versions. Without a cluster the own one is printed all the same.
pub async fn version(target: Target, wanted: &Version) -> Result<ExitCode, Error> {
    let asked = if wanted.client {
        Ok(None)
    } else {
        ask(target, wanted).await.map(Some)
    };
    let (operator, end) = match asked {
        Ok(operator) => (operator, Ok(ExitCode::SUCCESS)),
        Err(error) => (None, Err(error)),
    };
    let found = operator
        .as_ref()
        .map(|(namespace, running)| (namespace.as_str(), running));
    let lines_of_it = output::document(wanted.output.format, &value(found));
    print(&lines_of_it.unwrap_or_else(|| lines(OWN, found, frame())));
    end
}

async fn ask(target: Target, wanted: &Version) -> Result<(String, Running), Error> {
    let cluster = Cluster::connect(target).await?;
    let asked = async {
        let namespace = operator_namespace(&cluster, wanted.operator_namespace.as_deref()).await?;
        let pods = Api::namespaced(cluster.client.clone(), &namespace);
        let pods = replicas(&pods).await.map_err(Error::Unfit)?;
        Ok((namespace, running(&pods)))
    };
    asked.await.map_err(|error: Error| error.naming(&cluster.server))
}

/// The versions and images of the replicas.
pub(super) fn running(pods: &[Pod]) -> Running {
    let mut running = Running::new();
    for pod in pods {
        let version = pod.labels().get(LABEL).cloned().unwrap_or_else(|| "unknown".to_owned());
        let container = pod.spec.as_ref().and_then(|spec| spec.containers.first());
        let image = container
            .and_then(|container| container.image.clone())
            .unwrap_or_default();
        *running.entry((version, image)).or_default() += 1;
    }
    running
}

fn value(operator: Option<(&str, &Running)>) -> Value {
    let operator = operator.map(|(namespace, running)| {
        let all = running
            .iter()
            .map(|((version, image), replicas)| json!({"version": version, "image": image, "replicas": replicas}));
        json!({"namespace": namespace, "running": all.collect::<Vec<_>>()})
    });
    json!({"client": {"version": OWN}, "operator": operator})
}

/// Both versions, and what to do where they differ.
pub(super) fn lines(own: &str, operator: Option<(&str, &Running)>, frame: Frame) -> Vec<String> {
    let mut page = frame.page();
    page.row("Client", own);
    let Some((namespace, running)) = operator else {
        return page.into_lines();
    };
    if running.is_empty() {
        page.row("Operator", &format!("has no replica in namespace {namespace}."));
    }
    for ((version, image), replicas) in running {
        let replicas = counted(*replicas, "replica");
        page.row("Operator", &format!("{version}, {replicas} in namespace {namespace}"));
        page.whole("Image", image);
    }
    let others: Vec<&str> = running
        .keys()
        .map(|(version, _)| version.as_str())
        .filter(|version| *version != own)
        .collect();
    if let Some(other) = others.first() {
        page.gap();
        page.paragraph(&format!(
            "The versions differ, so this program may show less than the operator knows. Install version {other} of it: {RELEASES}{other}"
        ));
    }
    page.into_lines()
}
