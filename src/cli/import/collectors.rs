//! Which `DaemonSets` of the cluster would store the lines of a run once more: asked with the person's kubeconfig, if there is one.
//!
//! Called for a Leaderboard with a log group. Nothing depends on the answer: it takes a question off the list, or gives it a name.

use std::collections::BTreeSet;
use std::time::Duration;

use k8s_openapi::api::apps::v1::DaemonSet;
use kube::api::ListParams;
use kube::config::Kubeconfig;
use kube::{Api, Client};
use leaderboard_api::client_errors;
use leaderboard_api::log_collectors::{self, LogCollector};
use leaderboard_api::text::{LONGEST_NAME, one_line};

use crate::cli::serve;

/// Time that the cluster may take.
const LIMIT: Duration = Duration::from_secs(20);

/// What is known of them.
#[derive(Debug)]
pub(super) enum Collectors {
    /// Nobody could be asked, and why.
    Unknown(String),
    /// Those of a cluster, which the person calls so.
    Known { cluster: String, found: Vec<LogCollector> },
}

/// Asks the cluster that `kubectl` speaks to.
pub(super) async fn ask() -> Collectors {
    let client = match serve::cluster("import").await {
        Ok(config) => Client::try_from(config).map_err(|error| client_errors::kube(&error)),
        Err(why) => Err(why),
    };
    match client {
        Ok(client) => of(client, context()).await,
        Err(why) => Collectors::Unknown(why),
    }
}

/// The context's name; in a Pod there is none.
fn context() -> String {
    let config = Kubeconfig::read().ok();
    let name = config.and_then(|config| config.current_context);
    name.map_or_else(|| "of this Pod".to_owned(), |name| one_line(&name, LONGEST_NAME))
}

async fn of(client: Client, cluster: String) -> Collectors {
    match tokio::time::timeout(LIMIT, list(client)).await {
        Ok(Ok(found)) => Collectors::Known { cluster, found },
        Ok(Err(error)) => Collectors::Unknown(format!("the cluster {cluster}: {}", client_errors::kube(&error))),
        Err(_) => {
            let limit = LIMIT.as_secs();
            Collectors::Unknown(format!("the cluster {cluster} did not answer within {limit} s"))
        }
    }
}

async fn list(client: Client) -> kube::Result<Vec<LogCollector>> {
    let api: Api<DaemonSet> = Api::all(client);
    Ok(log_collectors::find(&api.list(&ListParams::default()).await?.items))
}

impl Collectors {
    /// Whether the cluster has answered that there is none.
    pub(super) fn is_nobody(&self) -> bool {
        matches!(self, Self::Known { found, .. } if found.is_empty())
    }

    /// The same as sentences, for Leaderboards of a namespace with these log groups.
    pub(super) fn lines(&self, namespace: &str, groups: &BTreeSet<String>) -> Vec<String> {
        let (cluster, found) = match self {
            Self::Unknown(why) => {
                let why = why.trim_end_matches('.');
                let by_hand = "kubectl get daemonsets --all-namespaces --output wide";
                return vec![format!(
                    "not known: {why}; look for FluentD, Fluent Bit or the CloudWatch agent by hand: {by_hand}"
                )];
            }
            Self::Known { cluster, found } if found.is_empty() => {
                return vec![format!(
                    "none: no DaemonSet of the cluster {cluster} collects the lines of containers"
                )];
            }
            Self::Known { cluster, found } => (cluster, found),
        };
        let line = |one: &LogCollector| {
            let group = groups.iter().find(|group| one.names_group(group));
            let twice = match group {
                Some(group) => format!("has the log group {group}, too, so that each line is stored twice"),
                None => "may store each line a second time".to_owned(),
            };
            let exclude = one.product.exclusion(namespace).map(|line| format!(" ({line})"));
            format!(
                "{one} of the cluster {cluster}, now on {} nodes, {twice} where it runs on the nodes of the Pods; leave the namespace \
                 {namespace} out of what it reads{}, or decide logGroup: null (docs/migrate.md, Logs twice)",
                one.nodes,
                exclude.unwrap_or_default()
            )
        };
        found.iter().map(line).collect()
    }
}

#[cfg(test)]
mod tests {
    use http::{Request, Response};
    use kube::client::Body;
    use serde_json::{Value, json};
    use tower_test::mock::pair;

    use super::*;

    /// What is found where the API server answers this.
    async fn answered(code: u16, answer: Value) -> Collectors {
        let (service, mut handle) = pair::<Request<Body>, Response<Body>>();
        let server = tokio::spawn(async move {
            let (request, send) = handle.next_request().await.unwrap();
            let body = Body::from(answer.to_string().into_bytes());
            send.send_response(Response::builder().status(code).body(body).unwrap());
            request.uri().path().to_owned()
        });
        let found = of(Client::new(service, "default"), "new".to_owned()).await;
        assert_eq!(server.await.unwrap(), "/apis/apps/v1/daemonsets", "of all namespaces");
        found
    }

    fn lines(found: &Collectors) -> Vec<String> {
        found.lines("leaderboard", &BTreeSet::from(["leaderboard-20".to_owned()]))
    }

    fn set(name: &str, image: &str, group: &str) -> Value {
        json!({
            "metadata": {"name": name, "namespace": "kube-system"},
            "spec": {"selector": {}, "template": {"spec": {"containers": [
                {"name": name, "image": image, "env": [{"name": "LOG_GROUP_NAME", "value": group}]},
            ]}}},
            "status": {"currentNumberScheduled": 3, "desiredNumberScheduled": 3, "numberMisscheduled": 0, "numberReady": 3},
        })
    }

    fn list_of(items: &Value) -> Value {
        json!({"apiVersion": "apps/v1", "kind": "DaemonSetList", "metadata": {}, "items": items})
    }

    #[tokio::test]
    async fn each_that_collects_logs_is_named_with_what_keeps_it_away() {
        let items = json!([
            set("kube-proxy", "kube-proxy:1", ""),
            set(
                "fluentd",
                "fluent/fluentd-kubernetes-daemonset:v1.16.1",
                "leaderboard-20"
            ),
            set("agent", "cloudwatch-agent:1", "x"),
        ]);
        let found = answered(200, list_of(&items)).await;
        assert!(!found.is_nobody());
        assert_eq!(
            lines(&found),
            [
                "FluentD (DaemonSet kube-system/fluentd) of the cluster new, now on 3 nodes, has the log group leaderboard-20, too, so that \
                 each line is stored twice where it runs on the nodes of the Pods; leave the namespace leaderboard out of what it reads \
                 (exclude_path [\"/var/log/containers/*_leaderboard_*.log\"]), or decide logGroup: null (docs/migrate.md, Logs twice)",
                "the CloudWatch agent (DaemonSet kube-system/agent) of the cluster new, now on 3 nodes, may store each line a second time \
                 where it runs on the nodes of the Pods; leave the namespace leaderboard out of what it reads, or decide logGroup: null \
                 (docs/migrate.md, Logs twice)",
            ]
        );
    }

    #[tokio::test]
    async fn a_cluster_without_one_answers_the_question_and_a_refusal_leaves_it_open() {
        let nobody = answered(200, list_of(&json!([set("kube-proxy", "kube-proxy:1", "")]))).await;
        assert!(nobody.is_nobody());
        assert_eq!(
            lines(&nobody),
            ["none: no DaemonSet of the cluster new collects the lines of containers"]
        );
        let message =
            "daemonsets.apps is forbidden: User \"host\" cannot list resource \"daemonsets\" at the cluster scope";
        let refusal = json!({"apiVersion": "v1", "kind": "Status", "metadata": {}, "status": "Failure", "code": 403,
                             "reason": "Forbidden", "message": message});
        let refused = answered(403, refusal).await;
        assert!(!refused.is_nobody());
        let line = &lines(&refused)[0];
        assert!(
            line.starts_with("not known: the cluster new: the API server answered 403: daemonsets.apps is forbidden")
                && line.ends_with("by hand: kubectl get daemonsets --all-namespaces --output wide"),
            "{line}"
        );
    }
}
