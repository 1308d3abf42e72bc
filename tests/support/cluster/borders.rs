//! The definitions in the cluster, and what keeps its other operators out of the tests' namespaces.

use std::time::Duration;

use k8s_openapi::api::admissionregistration::v1::{ValidatingAdmissionPolicy, ValidatingAdmissionPolicyBinding};
use k8s_openapi::api::core::v1::Secret;
use k8s_openapi::apiextensions_apiserver::pkg::apis::apiextensions::v1::CustomResourceDefinition;
use kube::api::{Api, Patch, PatchParams, PostParams};
use kube::runtime::wait::{await_condition, conditions::is_crd_established};
use kube::{Client, Config, ResourceExt};
use leaderboard_operator::crds;
use serde_json::json;
use tokio::time::{sleep, timeout};

use super::{LABEL, Scene, USER_AGENT};

/// Name of the policy that keeps other operators out.
const POLICY: &str = "leaderboard-tests";

/// Installs the definitions, and keeps others out.
pub(super) async fn draw(client: &Client) {
    install_definitions(client).await;
    keep_others_out(client).await;
}

/// Installs the definitions, or brings them up to date.
async fn install_definitions(client: &Client) {
    let api: Api<CustomResourceDefinition> = Api::all(client.clone());
    for definition in crds::definitions().unwrap() {
        let object = definition.object().unwrap();
        let name = object.name_any();
        let params = PatchParams::apply(USER_AGENT).force();
        let applied = api.patch(&name, &params, &Patch::Apply(definition.json())).await;
        applied.unwrap_or_else(|error| panic!("the cluster takes no definition {name}: {error}; is it up?"));
        let established = timeout(
            Duration::from_mins(1),
            await_condition(api.clone(), &name, is_crd_established()),
        );
        established.await.expect("a definition is not served").unwrap();
    }
}

/// Keeps an operator out that serves all namespaces, such as the demo's. It may write nothing here. The AWS that it would read and change
/// is out of its reach, on loopback.
async fn keep_others_out(client: &Client) {
    let policy = json!({
        "apiVersion": "admissionregistration.k8s.io/v1",
        "kind": "ValidatingAdmissionPolicy",
        "metadata": {"name": POLICY},
        "spec": {
            "failurePolicy": "Fail",
            "matchConstraints": {
                "namespaceSelector": {"matchLabels": {LABEL: "true"}},
                "resourceRules": [{
                    "apiGroups": ["*"],
                    "apiVersions": ["*"],
                    "operations": ["CREATE", "UPDATE", "DELETE"],
                    "resources": ["*/*"],
                }],
            },
            "validations": [{
                "expression": "!request.userInfo.username.startsWith('system:serviceaccount:') || \
                    request.userInfo.username.startsWith('system:serviceaccount:kube-system:')",
                "message": "this namespace belongs to a test, which runs an operator of its own",
            }],
        },
    });
    let binding = json!({
        "apiVersion": "admissionregistration.k8s.io/v1",
        "kind": "ValidatingAdmissionPolicyBinding",
        "metadata": {"name": POLICY},
        "spec": {"policyName": POLICY, "validationActions": ["Deny"]},
    });
    let params = PatchParams::apply(USER_AGENT).force();
    let policies: Api<ValidatingAdmissionPolicy> = Api::all(client.clone());
    policies.patch(POLICY, &params, &Patch::Apply(&policy)).await.unwrap();
    let bindings: Api<ValidatingAdmissionPolicyBinding> = Api::all(client.clone());
    bindings.patch(POLICY, &params, &Patch::Apply(&binding)).await.unwrap();
}

impl Scene {
    /// Waits until others are kept out: the API server takes a new policy in only after a moment.
    pub(super) async fn await_policy(&self) {
        let mut config = Config::infer().await.unwrap();
        config.auth_info.impersonate = Some("system:serviceaccount:somewhere:operator".into());
        config.auth_info.impersonate_groups = Some(vec!["system:masters".into()]);
        let others = Client::try_from(config).unwrap();
        let others: Api<Secret> = Api::namespaced(others, &self.namespace);
        let (trial, params) = (
            json!({"metadata": {"name": "trial"}}),
            PostParams {
                dry_run: true,
                ..PostParams::default()
            },
        );
        let trial: Secret = serde_json::from_value(trial).unwrap();
        let kept_out = async {
            while others.create(&params, &trial).await.is_ok() {
                sleep(Duration::from_millis(200)).await;
            }
        };
        timeout(Duration::from_mins(1), kept_out)
            .await
            .expect("the policy has no effect");
    }
}
