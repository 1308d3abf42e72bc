//! The controller with the chart's own rights and no other, in two namespaces: it finds nothing missing, and a submission lives its
//! whole life. The rules are read from the chart's template, whose text is YAML but for a few words.
#![cfg(test)]

use k8s_openapi::api::rbac::v1::{ClusterRole, ClusterRoleBinding, PolicyRule, Role, RoleBinding};
use kube::api::{DeleteParams, ListParams, PostParams};
use kube::runtime::wait::await_condition;
use kube::{Api, Client, Config};
use leaderboard_api::{Leaderboard, conditions};
use leaderboard_operator::cli::rights::Rights;
use leaderboard_operator::kubernetes::Namespaces;
use leaderboard_operator::kubernetes::preflight::access_missing;
use leaderboard_operator::runtime::settings::Settings;
use leaderboard_policy::allowed::Allowed;
use serde_json::{Value, json};
use tokio::time::timeout;

use super::bridge::LIMIT;
use super::objects::{Kind, create};
use super::operator::{self, LEASE_NAME, Operator};
use super::world::World;
use crate::support::apiserver::server;

const CHART: &str = include_str!("../../charts/leaderboard-operator/templates/controller-rbac.yaml");
/// A right applies a moment after it was given, and the API server reports nothing then: it is asked this often.
const POLL: std::time::Duration = std::time::Duration::from_millis(50);
const SERVED: &str = r#"{{- define "operator.controller.rules" }}"#;
const CLUSTER: &str = r#"{{- define "operator.controller.clusterRules" }}"#;
const OWN: &str = r#"{{- define "operator.controller.ownRules" }}"#;
const GROUP: &str = "rbac.authorization.k8s.io";

/// The rules between the template's line that begins so and the next `{{- end }}`.
fn rules(begin: &str) -> Vec<PolicyRule> {
    let (_, rest) = CHART
        .split_once(begin)
        .unwrap_or_else(|| panic!("the template has no {begin}"));
    let lines = rest.lines().skip(1).take_while(|line| !line.starts_with("{{- end }}"));
    let text: Vec<String> = lines
        .map(|line| line.replace(r#"{{ include "operator.fullname" . }}"#, LEASE_NAME))
        .collect();
    let rules: Vec<PolicyRule> = serde_saphyr::from_str(&text.join("\n")).unwrap();
    assert!(!rules.is_empty());
    rules
}

fn role(name: &str, rules: &[PolicyRule]) -> Value {
    json!({"metadata": {"name": name}, "rules": rules})
}

fn binding(kind: &str, name: &str, user: &str) -> Value {
    json!({
        "metadata": {"name": name},
        "roleRef": {"apiGroup": GROUP, "kind": kind, "name": name},
        "subjects": [{"kind": "User", "apiGroup": GROUP, "name": user}],
    })
}

async fn grant(client: &Client, namespace: &str, name: &str, user: &str, rules: &[PolicyRule]) {
    let roles: Api<Role> = Api::namespaced(client.clone(), namespace);
    let bindings: Api<RoleBinding> = Api::namespaced(client.clone(), namespace);
    let params = PostParams::default();
    let made = serde_json::from_value(role(name, rules)).unwrap();
    roles.create(&params, &made).await.unwrap();
    let made = serde_json::from_value(binding("Role", name, user)).unwrap();
    bindings.create(&params, &made).await.unwrap();
}

/// Gives a user what the chart gives the controller, in these namespaces; hands back how the user reaches the server.
async fn installed(client: &Client, release: &str, namespaces: &[&str]) -> Config {
    let user = format!("controller-of-{release}");
    for namespace in namespaces {
        grant(client, namespace, "controller", &user, &rules(SERVED)).await;
    }
    grant(client, release, "lease", &user, &rules(OWN)).await;
    let secret = json!([{"apiGroups": [""], "resources": ["secrets"], "resourceNames": ["evalai"], "verbs": ["get"]}]);
    grant(
        client,
        release,
        "secrets",
        &user,
        &serde_json::from_value::<Vec<PolicyRule>>(secret).unwrap(),
    )
    .await;
    let params = PostParams::default();
    let of_cluster = role(&user, &rules(CLUSTER));
    let roles: Api<ClusterRole> = Api::all(client.clone());
    roles
        .create(&params, &serde_json::from_value(of_cluster).unwrap())
        .await
        .unwrap();
    let bindings: Api<ClusterRoleBinding> = Api::all(client.clone());
    let bound = binding("ClusterRole", &user, &user);
    bindings
        .create(&params, &serde_json::from_value(bound).unwrap())
        .await
        .unwrap();
    let mut config = server().await.config();
    config.auth_info.impersonate = Some(user);
    config.auth_info.impersonate_groups = Some(vec!["system:authenticated".into()]);
    config
}

/// Rights are known to the API server a moment after they were given.
async fn until_known(config: &Config, namespaces: &[&str]) {
    let client = Client::try_from(config.clone()).unwrap();
    let nodes: Api<k8s_openapi::api::core::v1::Node> = Api::all(client.clone());
    let known = async {
        for namespace in namespaces {
            let own: Api<Leaderboard> = Api::namespaced(client.clone(), namespace);
            while own.list(&ListParams::default()).await.is_err() {
                tokio::time::sleep(POLL).await;
            }
        }
        while nodes.list(&ListParams::default()).await.is_err() {
            tokio::time::sleep(POLL).await;
        }
    };
    timeout(LIMIT, known).await.expect("the rights are known");
}

async fn until_ready(client: &Client, namespace: &str, name: &str) {
    let boards: Api<Leaderboard> = Api::namespaced(client.clone(), namespace);
    let is_ready = |board: Option<&Leaderboard>| {
        let status = board.and_then(|board| board.status.as_ref());
        status.is_some_and(|status| conditions::is_true(&status.conditions, conditions::READY))
    };
    let ready = timeout(LIMIT, Box::pin(await_condition(boards.clone(), name, is_ready))).await;
    let Ok(ready) = ready else {
        panic!("it is not ready: {:?}", boards.get(name).await);
    };
    ready.unwrap();
}

async fn until_nothing_is_missing(operator: &Operator) {
    let nothing = async {
        while !operator.telemetry.readiness.missing().is_empty() {
            tokio::time::sleep(POLL).await;
        }
    };
    let found = timeout(LIMIT, nothing).await;
    assert!(found.is_ok(), "{:?}", operator.telemetry.readiness.missing());
}

#[tokio::test(flavor = "multi_thread")]
async fn the_preflight_lacks_nothing_with_the_charts_rights_and_names_what_is_taken_away() {
    let world = World::new().await;
    let release = world.namespace.as_str();
    let config = installed(&world.client, release, &[release]).await;
    until_known(&config, &[release]).await;
    let client = Client::try_from(config).unwrap();
    let served = Namespaces::of([release.to_owned()]);
    let rules = json!({"served": rules(SERVED), "cluster": rules(CLUSTER), "own": rules(OWN)});
    let rights: Rights = rules.to_string().parse().unwrap();
    let needs = rights.needs(&served, release);
    let missing = async || access_missing(&client, &needs).await;
    let granted = async {
        while !missing().await.is_empty() {
            tokio::time::sleep(POLL).await;
        }
    };
    let found = timeout(LIMIT, granted).await;
    assert!(found.is_ok(), "{:?}", missing().await);

    let bindings: Api<RoleBinding> = Api::namespaced(world.client.clone(), release);
    bindings.delete("lease", &DeleteParams::default()).await.unwrap();
    let taken = async {
        while missing().await.len() < 3 {
            tokio::time::sleep(POLL).await;
        }
    };
    timeout(LIMIT, taken).await.expect("the rights are taken away");
    let lines =
        ["create leases", "get leases", "update leases"].map(|verb| format!("may not {verb} of coordination.k8s.io"));
    for (line, begin) in missing().await.iter().zip(&lines) {
        assert!(
            line.starts_with(begin) && line.contains(&format!("in namespace {release}")),
            "{line}"
        );
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn the_charts_rights_in_two_namespaces_are_enough_for_a_whole_life() {
    let world = World::new().await;
    let (release, second) = (world.namespace.as_str(), server().await.namespace("second").await);
    let namespaces = [release, second.as_str()];
    let config = installed(&world.client, release, &namespaces).await;
    until_known(&config, &namespaces).await;
    let settings = Settings {
        namespaces: Namespaces::of(namespaces.map(str::to_owned)),
        has_cluster_rights: true,
        allowed: Allowed::default(),
        ..operator::settings(release)
    };
    let operator = Operator::start_with(settings, release, world.aws.aws.clone(), config);
    until_nothing_is_missing(&operator).await;

    world.leaderboard("lb", 1, "Hosts").await;
    until_ready(&world.client, release, "lb").await;
    let storage = json!({"spec": {"storage": {"s3": {"bucket": world.bucket, "prefix": "second/", "endpoint": world.aws.endpoint}}}});
    let api = Kind::Leaderboard.api(&world.client, &second);
    create(&api, Kind::Leaderboard.object("lb", &[&storage]), false)
        .await
        .unwrap();
    until_ready(&world.client, &second, "lb").await;

    let (pk, name) = world.submit("lb", 1).await;
    world.run_that_crashes(pk, &name).await;
    world
        .until(&name, "EvalAI has its end", |status| {
            conditions::is_true(&status.conditions, conditions::PUBLISHED)
        })
        .await;
    assert!(operator.is_running() && operator.telemetry.readiness.missing().is_empty());
    operator.end().await;
}
