//! `dashboard`: a browser's way to the operator's page. A listener on 127.0.0.1, and for each of its connections a port-forward to a replica.
//!
//! Called by `main`. `replica` is pure. Nothing is read of what passes: the page itself refuses a browser that came by another name.

use std::net::{Ipv4Addr, SocketAddr};
use std::process::ExitCode;
use std::sync::Arc;

use clap::Args;
use k8s_openapi::api::core::v1::Pod;
use kube::api::ListParams;
use kube::{Api, ResourceExt};
use tokio::io::copy_bidirectional;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;

use super::cluster::{Cluster, Scope};
use super::error::{Error, phrase};
use super::output::{note_once, print};
use leaderboard_api::client_errors;

/// The controller's replicas, whatever the release is called.
const SELECTOR: &str = "app.kubernetes.io/part-of=leaderboard-operator,app.kubernetes.io/component=controller";
/// Name of the page's port in a replica.
const PORT: &str = "page";
/// A browser opens a few.
const CONNECTIONS: usize = 48;

/// Open the operator's page for a browser on this machine, until Ctrl-C.
#[derive(Args, Debug)]
pub struct Dashboard {
    /// Port on 127.0.0.1 [default: a free one].
    #[arg(long, default_value_t = 0, hide_default_value = true)]
    port: u16,
    /// The operator's namespace [default: that of the operator which drives the Leaderboards of this namespace].
    #[arg(long, value_name = "NAMESPACE")]
    operator_namespace: Option<String>,
}

/// Serves until Ctrl-C.
pub async fn dashboard(cluster: &Cluster, wanted: &Dashboard) -> Result<ExitCode, Error> {
    let namespace = operator_namespace(cluster, wanted.operator_namespace.as_deref()).await?;
    let pods: Api<Pod> = Api::namespaced(cluster.client.clone(), &namespace);
    // A missing replica or port is an error before a browser opens.
    find(&pods).await.map_err(Error::Unfit)?;
    let address = SocketAddr::from((Ipv4Addr::LOCALHOST, wanted.port));
    let taken = |error| Error::Unfit(format!("cannot listen on {address}: {error}. Choose another --port"));
    let listener = TcpListener::bind(address).await.map_err(taken)?;
    let address = listener.local_addr().map_err(taken)?;
    print(&[
        format!("http://{address}/ shows what the operator in namespace {namespace} sees; it changes nothing."),
        "Everyone on this machine can open it while this command runs. Ctrl-C ends it.".to_owned(),
    ]);
    tokio::select! {
        biased;
        ended = tokio::signal::ctrl_c() => ended.map_err(Error::Runtime)?,
        () = accept(&listener, &pods) => {}
    }
    Ok(ExitCode::SUCCESS)
}

/// The controller's replicas, or why they cannot be listed.
pub async fn replicas(pods: &Api<Pod>) -> Result<Vec<Pod>, String> {
    let found = pods.list(&ListParams::default().labels(SELECTOR)).await;
    Ok(found.map_err(|error| of_rights(&error, "list pods"))?.items)
}

/// Namespace of the operator: the one that is named, or that of the operator which drives the Leaderboards here.
pub async fn operator_namespace(cluster: &Cluster, named: Option<&str>) -> Result<String, Error> {
    if let Some(named) = named {
        return Ok(named.to_owned());
    }
    let boards = cluster.leaderboards(&Scope::default()).await?.unwrap_or_default();
    let operators = boards
        .iter()
        .filter_map(|board| board.status.as_ref()?.operator.as_deref());
    let mut namespaces: Vec<&str> = operators.filter_map(|name| Some(name.split_once('/')?.0)).collect();
    namespaces.sort_unstable();
    namespaces.dedup();
    match namespaces.as_slice() {
        [one] => Ok((*one).to_owned()),
        [] => Err(Error::Unfit(format!(
            "no Leaderboard that you can read in namespace {} names its operator. Use -n for a namespace with Leaderboards, or --operator-namespace",
            cluster.namespace
        ))),
        several => Err(Error::Unfit(format!(
            "the Leaderboards of namespace {} have operators in the namespaces {}. Choose one with --operator-namespace",
            cluster.namespace,
            several.join(", ")
        ))),
    }
}

async fn accept(listener: &TcpListener, pods: &Api<Pod>) {
    let places = Arc::new(Semaphore::new(CONNECTIONS));
    while let Ok(place) = Arc::clone(&places).acquire_owned().await {
        // One that has gone before it was accepted is no reason to end.
        let Ok((stream, _)) = listener.accept().await else {
            continue;
        };
        let pods = pods.clone();
        tokio::spawn(async move {
            if let Err(why) = forward(&pods, stream).await {
                note_once(&why);
            }
            drop(place);
        });
    }
}

/// Name and port of a replica that serves the page, or why there is none.
async fn find(pods: &Api<Pod>) -> Result<(String, u16), String> {
    replica(&replicas(pods).await?)
}

async fn forward(pods: &Api<Pod>, mut browser: TcpStream) -> Result<(), String> {
    let (pod, port) = find(pods).await?;
    let opened = pods.portforward(&pod, &[port]).await;
    let mut forward = opened.map_err(|error| of_rights(&error, "create pods/portforward"))?;
    let errors = forward.take_error(port);
    let Some(mut page) = forward.take_stream(port) else {
        return Ok(());
    };
    let failed = async {
        match errors {
            Some(error) => error.await,
            None => None,
        }
    };
    let result = tokio::select! {
        biased;
        // Either side may end a connection at any time.
        _ = copy_bidirectional(&mut browser, &mut page) => Ok(()),
        Some(why) = failed => Err(format!("the operator's page does not answer: {}", phrase(&why))),
    };
    forward.abort();
    result
}

/// Name and port of the first replica that is ready and serves the page.
fn replica(pods: &[Pod]) -> Result<(String, u16), String> {
    let none =
        "the operator has no replica in this namespace. Check --operator-namespace, and that its Deployment runs";
    if pods.is_empty() {
        return Err(none.to_owned());
    }
    let mut serving: Vec<(&Pod, u16)> = pods.iter().filter_map(|pod| Some((pod, page_port(pod)?))).collect();
    if serving.is_empty() {
        return Err(
            "the operator serves no page. Its host turns it on with the chart's value webUI.enabled".to_owned(),
        );
    }
    serving.retain(|(pod, _)| is_ready(pod));
    let first = serving.into_iter().map(|(pod, port)| (pod.name_any(), port)).min();
    first.ok_or_else(|| "no replica of the operator is ready. `kubectl describe pod` says why".to_owned())
}

fn page_port(pod: &Pod) -> Option<u16> {
    let containers = pod.spec.as_ref()?.containers.iter();
    let mut ports = containers.flat_map(|container| container.ports.iter().flatten());
    let port = ports.find(|port| port.name.as_deref() == Some(PORT))?;
    u16::try_from(port.container_port).ok()
}

fn is_ready(pod: &Pod) -> bool {
    let conditions = pod.status.as_ref().and_then(|status| status.conditions.as_ref());
    let mut conditions = conditions.into_iter().flatten();
    let is_ready = conditions.any(|condition| condition.type_ == "Ready" && condition.status == "True");
    is_ready && pod.metadata.deletion_timestamp.is_none()
}

/// Reports which right is missing, and where a Role with it is.
fn of_rights(error: &kube::Error, right: &str) -> String {
    let text = phrase(&client_errors::kube(error));
    match error {
        kube::Error::Api(status) if status.is_forbidden() => format!(
            "missing right to {right} in the operator's namespace: {text}. Ask for a RoleBinding to the chart's Role that ends in -page"
        ),
        _ => format!("the operator's page does not answer: {text}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn pod(name: &str, ready: &str, port: Option<&str>) -> Pod {
        let ports: Vec<_> = port
            .map(|name| json!({"name": name, "containerPort": 8081}))
            .into_iter()
            .collect();
        let pod = json!({
            "metadata": {"name": name},
            "spec": {"containers": [{"name": "controller", "ports": ports}]},
            "status": {"conditions": [{"type": "Ready", "status": ready}]},
        });
        serde_json::from_value(pod).unwrap()
    }

    #[test]
    fn the_first_ready_replica_that_serves_the_page_is_taken() {
        let replicas = [
            pod("a", "False", Some("page")),
            pod("d", "True", Some("page")),
            pod("c", "True", Some("page")),
            pod("b", "True", Some("http")),
        ];
        assert_eq!(replica(&replicas), Ok(("c".to_owned(), 8081)));
    }

    #[test]
    fn each_reason_for_no_page_has_its_own_next_step() {
        for (pods, next) in [
            (vec![], "--operator-namespace"),
            (
                vec![pod("a", "True", Some("http")), pod("b", "True", None)],
                "webUI.enabled",
            ),
            (vec![pod("a", "False", Some("page"))], "kubectl describe pod"),
        ] {
            let why = replica(&pods).unwrap_err();
            assert!(why.contains(next), "{why}");
        }
    }
}
