//! The original's entries in Secrets Manager, imported and applied: one submission of each Leaderboard runs to its score.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Output, Stdio};
use std::time::Duration;

use evalai_stand_in::model::Status;
use kube::Api;
use kube::api::{ApiResource, DynamicObject, Patch, PatchParams};
use kube::core::{GroupVersionKind, TypeMeta};
use leaderboard_api::{Leaderboard, State, Submission};
use leaderboard_aws::clients::Aws;
use serde_json::{Value, json};
use tokio::io::AsyncWriteExt as _;
use tokio::process::Command;

use super::expected::{assert_finished, assert_row};
use crate::aws::{BUCKET, REGION};
use crate::evalai::{Evalai, HOST_TOKEN};
use crate::operator::{bridge, controller};
use crate::scene::{Scene, USER_AGENT, scenario, state};

/// Region of the entries alone: the lab has its own in [`REGION`].
const ENTRIES: &str = "us-west-2";
const LIMIT: Duration = Duration::from_mins(5);

/// Stores the four entries, as the original has them, and gives what `aws secretsmanager get-secret-value` prints of them.
async fn store_entries(scene: &Scene, evalai: &Evalai) -> String {
    let secrets = Aws::load("tests")
        .await
        .secrets(Some(ENTRIES), Some(&scene.cloud.endpoint));
    let board = |table: &str| {
        json!({
            "name": "cluster", "endpoint": "https://cluster.example", "certificate_authority": "LS0t",
            "simulator_image": scene.lab.challenge("simulator:1"),
            "leaderboard_image": scene.lab.challenge("contents:1"),
            "logcopy_image": scene.lab.challenge("logcopy:1"),
            "s3_bucket": BUCKET, "dynamodb_submissions_table": table,
        })
    };
    let mut printed = Vec::new();
    for (name, entry) in [
        ("evalai", json!({"auth_token": HOST_TOKEN, "api_server": evalai.url})),
        (
            "evalai-tracks",
            json!({"1": "leaderboard-20-sensors", "2": "leaderboard-10-map"}),
        ),
        ("leaderboard-10", board(&scene.cloud.hyphen_table)),
        ("leaderboard-20", board(&scene.cloud.table)),
    ] {
        let text = entry.to_string();
        // A run before this one may have left it.
        _ = secrets.create_secret().name(name).secret_string(&text).send().await;
        secrets
            .put_secret_value()
            .secret_id(name)
            .secret_string(&text)
            .send()
            .await
            .unwrap();
        let stored = secrets.get_secret_value().secret_id(name).send().await.unwrap();
        let answer = json!({"ARN": stored.arn, "Name": stored.name, "SecretString": stored.secret_string});
        printed.push(format!("{answer:#}\n"));
    }
    printed.concat()
}

/// The decisions of this cluster's host: it has no GPUs and one small node, AWS and EvalAI are stand-ins, and policies have no effect.
fn decisions(scene: &Scene) -> Value {
    let resources = json!({
        "requests": {"cpu": null, "memory": null, "ephemeral-storage": "16Mi"},
        "limits": {"ephemeral-storage": "4Gi"},
    });
    let (region, endpoint) = (REGION, &scene.cloud.endpoint);
    json!({
        "evalai": {"token": {"secretsManager": {"endpoint": endpoint}}},
        "gpu": {"mode": "None", "resourceName": null},
        "evaluation": {"carla": {
            "simulator": {"resources": resources, "securityContext": null, "display": "Offscreen"},
        }},
        "agent": {"resources": resources, "images": [], "env": [{"name": "ROUTE_MS", "value": "100"}]},
        "storage": {"s3": {"region": region, "endpoint": endpoint, "prefix": scene.cloud.prefix}},
        "table": {"dynamoDB": {"region": region, "endpoint": scene.gate.url}},
        "queue": {"sqs": {"region": region, "endpoint": scene.gate.url, "deadLetterURL": scene.cloud.dead_url}},
        "podIdentity": {"secretName": "aws", "serviceAccountName": null, "roleARN": null},
        "network": {
            "dns": "None", "enforcement": "Disabled", "egress": [{"cidr": format!("{}/32", scene.lab.host), "ports": [443]}],
        },
        "concurrency": {"total": 2, "perTeam": 2},
        "syncPeriodSeconds": 2,
    })
}

/// The decisions as a file of kubectl's kustomize, over the command's output.
fn kustomization(scene: &Scene) -> Value {
    let spec = json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Leaderboard", "metadata": {"name": "both"},
        "spec": decisions(scene),
    });
    let nodes = json!([
        {"op": "remove", "path": "/spec/tracks/0/nodeSelector"}, {"op": "remove", "path": "/spec/tracks/0/tolerations"},
    ]);
    let patches = [spec, nodes].map(|patch| json!({"target": {"kind": "Leaderboard"}, "patch": patch.to_string()}));
    json!({"resources": ["challenge.yaml"], "patches": patches})
}

async fn ended(command: &mut Command, input: &str) -> Output {
    command
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    let mut child = command.spawn().unwrap();
    child.stdin.take().unwrap().write_all(input.as_bytes()).await.unwrap();
    let output = child.wait_with_output().await.unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    output
}

/// The command's manifests, with the cluster's decisions laid over them.
async fn import(scene: &Scene, entries: &str) -> String {
    let program = Path::new(env!("CARGO_BIN_EXE_leaderboard-operator")).with_file_name("kubectl-leaderboard");
    let mut command = Command::new(program);
    command
        .env_clear()
        .args(["import", "-", "--challenge", "1", "--queue", &scene.cloud.queue_url])
        .args(["--namespace", &scene.namespace]);
    let output = ended(&mut command, entries).await;
    let all = [&output.stdout[..], &output.stderr].concat();
    assert!(!String::from_utf8(all).unwrap().contains(HOST_TOKEN));
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("challenge.yaml"), output.stdout).unwrap();
    let file = folder.path().join("kustomization.yaml");
    std::fs::write(file, kustomization(scene).to_string()).unwrap();
    let mut kubectl = Command::new("kubectl");
    let laid_over = ended(kubectl.arg("kustomize").arg(folder.path()), "").await;
    String::from_utf8(laid_over.stdout).unwrap()
}

/// Applies what was printed, object by object, as `kubectl apply --server-side` does.
async fn apply(scene: &Scene, manifests: &str) {
    let objects: Vec<Value> = serde_saphyr::from_multiple(manifests).unwrap();
    let kinds: Vec<_> = objects.iter().map(|object| object["kind"].as_str().unwrap()).collect();
    assert_eq!(kinds, ["Namespace", "ServiceAccount", "Leaderboard", "Leaderboard"]);
    for object in objects {
        let types: TypeMeta = serde_json::from_value(object.clone()).unwrap();
        let kind = ApiResource::from_gvk(&GroupVersionKind::try_from(&types).unwrap());
        let name = object["metadata"]["name"].as_str().unwrap();
        let api: Api<DynamicObject> = if object["kind"] == "Namespace" {
            Api::all_with(scene.client.clone(), &kind)
        } else {
            Api::namespaced_with(scene.client.clone(), &scene.namespace, &kind)
        };
        let params = PatchParams::apply(USER_AGENT).force();
        let applied = api.patch(name, &params, &Patch::Apply(&object)).await;
        applied.unwrap_or_else(|error| panic!("{name}: {error}"));
    }
}

#[tokio::test]
async fn what_import_prints_runs_a_submission_of_each_leaderboard() {
    scenario("import", async |scene: &Scene| {
        let evalai = Evalai::start(scene).await;
        let entries = Box::pin(store_entries(scene, &evalai)).await;
        let manifests = import(scene, &entries).await;
        apply(scene, &manifests).await;
        let (_controller, _bridge) = (controller(scene), bridge(scene));
        for name in ["leaderboard-10", "leaderboard-20"] {
            scene.ready(name).await;
        }
        let boards = scene.all::<Leaderboard>().await;
        let token = |board: &Leaderboard| board.spec.evalai.as_ref().unwrap().token.secrets_manager.clone();
        assert!(
            boards.iter().all(|board| token(board).unwrap().id == "evalai"),
            "the token is read where it was"
        );

        let image = scene.lab.challenge("agent:standard");
        let (twenty, ten) = (evalai.submit(&image, 1).await, evalai.submit(&image, 2).await);
        let finished = scene.settled(&format!("submission-{twenty}"), LIMIT).await;
        assert_finished(&finished);
        assert_eq!(finished.spec.leaderboard_name, "leaderboard-20");
        assert_row(&scene.cloud.row(&scene.cloud.table).await);

        let finished = scene.settled(&format!("submission-{ten}"), LIMIT).await;
        assert_eq!(finished.spec.leaderboard_name, "leaderboard-10");
        assert_eq!(state(&finished), Some(State::Finished));
        assert_eq!(progress(&finished).as_deref(), Some("100/100"), "20 routes, five times");
        let row = scene.cloud.row(&scene.cloud.hyphen_table).await;
        assert_metrics_of_ten(&row);
        for pk in [twenty, ten] {
            assert_eq!(evalai.submission(pk).status, Status::Finished);
        }
    })
    .await;
}

fn progress(submission: &Submission) -> Option<String> {
    let progress = submission.status.as_ref()?.progress.as_ref()?;
    Some(progress.text.clone())
}

/// 1.0 has twelve metrics, and none of the three that only 2.0 has.
fn assert_metrics_of_ten(row: &BTreeMap<String, String>) {
    assert_eq!(row["submission_status"], "FINISHED");
    for (column, is_there) in [
        ("driving_score", true),
        ("agent_blocked", true),
        ("min_speed_infractions", false),
    ] {
        assert_eq!(row.contains_key(column), is_there, "{column} of {row:?}");
    }
}
