//! The definitions as the API server serves them: names, defaults, `null`, raw fields, selectors, the status.

use k8s_openapi::apiextensions_apiserver::pkg::apis::apiextensions::v1::CustomResourceDefinition;
use kube::Client;
use kube::api::{Api, ListParams, Patch, PatchParams};
use leaderboard_api::{Leaderboard, Submission};
use leaderboard_operator::crds;
use serde_json::{Value, json};

use super::objects::{Kind, causes, create, merge};
use super::rule_cases::container::by_container;
use crate::support::apiserver::server;

#[tokio::test]
async fn both_definitions_are_established_and_structural() {
    let api: Api<CustomResourceDefinition> = Api::all(server().await.client());
    for definition in crds::definitions().unwrap() {
        let name = definition.object().unwrap().metadata.name.unwrap();
        let read = serde_json::to_value(api.get(&name).await.unwrap()).unwrap();
        let conditions: Vec<String> = read["status"]["conditions"]
            .as_array()
            .unwrap()
            .iter()
            .map(|c| format!("{}={}", c["type"].as_str().unwrap(), c["status"].as_str().unwrap()))
            .collect();
        assert_eq!(conditions, ["NamesAccepted=True", "Established=True"], "{name}");
        assert_eq!(read["spec"]["versions"][0]["subresources"], json!({"status": {}}));
    }
}

#[tokio::test]
async fn short_names_and_the_category_are_served() {
    let client = server().await.client();
    let list = client
        .list_api_group_resources("leaderboard.carla.org/v1alpha1")
        .await
        .unwrap();
    let mut served: Vec<String> = list
        .resources
        .iter()
        .map(|resource| {
            let (short, categories) = (resource.short_names.as_deref(), resource.categories.as_deref());
            format!(
                "{} {:?} {:?}",
                resource.name,
                short.unwrap_or_default(),
                categories.unwrap_or_default()
            )
        })
        .collect();
    served.sort();
    assert_eq!(
        served,
        [
            r#"leaderboards ["lb"] ["challenges"]"#,
            "leaderboards/status [] []",
            r#"submissions ["lbsub"] ["challenges"]"#,
            "submissions/status [] []",
        ]
    );
}

#[tokio::test]
async fn a_minimal_leaderboard_reads_back_whole() {
    let server = server().await;
    let api = Kind::Leaderboard.api(&server.client(), &server.namespace("minimal").await);
    let read = create(&api, Kind::Leaderboard.object("a", &[]), false).await.unwrap();
    assert_eq!(
        read.data["spec"],
        json!({
        "tracks": [{"name": "sensors"}],
        "evaluation": {"carla": {
            "version": "V2", "contents": {"image": "contents:1"},
            "simulator": {"image": "simulator:1", "display": "Offscreen"}, "pairs": 4, "routes": 20,
            "verify": "Warn",
        }},
        "agent": {"logSizeLimit": "2Gi"},
        "retries": {"perWorker": 3, "infrastructure": 2},
        "deadlines": {
            "pullSeconds": 5400,
            "startSeconds": 1800,
            "readySeconds": 3600,
            "idleSeconds": 800,
            "cancelSeconds": 120,
            "flushSeconds": 1800,
            "finalizeSeconds": 900,
        },
        "storage": {"s3": {"bucket": "results", "sizeLimit": "20Gi"}},
        "network": {"policy": "Managed", "enforcement": "Warn", "dns": "Cluster", "dnsServers": ["169.254.20.10"]},
        "concurrency": {},
        "paused": false,
        "syncPeriodSeconds": 10,
        "ttlSecondsAfterFinished": 604_800,
        "retention": {},
                })
    );
}

#[tokio::test]
async fn a_minimal_leaderboard_of_a_hosts_container_reads_back_whole() {
    let server = server().await;
    let api = Kind::Leaderboard.api(&server.client(), &server.namespace("container").await);
    let patch = json!({"spec": by_container(&json!({}))});
    let read = create(&api, Kind::Leaderboard.object("a", &[&patch]), false)
        .await
        .unwrap();
    assert_eq!(
        read.data["spec"]["evaluation"],
        json!({"container": {
            "mode": "Interactive", "image": "evaluator:1", "command": ["evaluate"], "workers": 1, "shmSize": "64Mi",
            "answerSeconds": 600, "merge": "Mean",
        }})
    );
    assert_eq!(
        read.data["spec"]["tracks"],
        json!([{"name": "sensors", "container": {"score": {"metric": "accuracy", "order": "Descending"}}}])
    );
}

#[tokio::test]
async fn a_leaderboard_has_exactly_one_kind_of_evaluation() {
    let server = server().await;
    let api = Kind::Leaderboard.api(&server.client(), &server.namespace("kinds").await);
    let carla = Kind::Leaderboard.object("a", &[]);
    let both = json!({"spec": by_container(&json!({"evaluation": {"carla": carla["spec"]["evaluation"]["carla"]}}))});
    let none = json!({"spec": {"evaluation": {"carla": null}}});
    for patch in [both, none] {
        let refused = create(&api, Kind::Leaderboard.object("a", &[&patch]), true).await;
        let causes = causes(&refused.unwrap_err());
        assert!(
            causes.iter().any(|cause| cause.contains("spec.evaluation")),
            "{causes:?}"
        );
    }
}

#[tokio::test]
async fn a_minimal_submission_reads_back_whole() {
    let server = server().await;
    let api = Kind::Submission.api(&server.client(), &server.namespace("minimal").await);
    let read = create(&api, Kind::Submission.object("a", &[]), false).await.unwrap();
    assert_eq!(
        read.data["spec"],
        json!({
            "leaderboardName": "local",
            "track": "sensors",
            "image": "agent:1",
            "priority": 0,
            "attempt": 1,
            "cancel": false,
        })
    );
}

/// A field of a Leaderboard, what is sent there, and what is read back.
type HalfFilled = (&'static str, Value, Value);

fn half_filled_runs() -> Vec<HalfFilled> {
    vec![
        (
            "agent",
            json!({"command": ["a"]}),
            json!({"command": ["a"], "logSizeLimit": "2Gi"}),
        ),
        (
            "agent",
            json!({"images": []}),
            json!({"logSizeLimit": "2Gi", "images": []}),
        ),
        (
            "retries",
            json!({"perWorker": 0}),
            json!({"perWorker": 0, "infrastructure": 2}),
        ),
        (
            "retries",
            json!({"infrastructure": 0}),
            json!({"perWorker": 3, "infrastructure": 0}),
        ),
        (
            "deadlines",
            json!({"startSeconds": 5, "runSeconds": 7200}),
            json!({
                    "pullSeconds": 5400,
                "startSeconds": 5,
                "readySeconds": 3600,
                "idleSeconds": 800,
                "runSeconds": 7200,
                "cancelSeconds": 120,
                "flushSeconds": 1800,
                "finalizeSeconds": 900,
            }),
        ),
    ]
}

#[allow(clippy::needless_pass_by_value, reason = "the cases read better")]
fn carla(simulator: Value, more: Value) -> Value {
    let mut carla = json!({"version": "V2", "contents": {"image": "contents:1"}, "simulator": simulator});
    merge(&mut carla, &more);
    json!({ "carla": carla })
}

fn half_filled_pods() -> Vec<HalfFilled> {
    vec![
        (
            "network",
            json!({"egress": [{"cidr": "10.0.0.0/16"}]}),
            json!({
                "policy": "Managed",
                "enforcement": "Warn",
                "egress": [{"cidr": "10.0.0.0/16"}],
                "dns": "Cluster",
                "dnsServers": ["169.254.20.10"],
            }),
        ),
        (
            "network",
            json!({"dns": "None", "policy": "External"}),
            json!({"dns": "None", "dnsServers": ["169.254.20.10"], "policy": "External", "enforcement": "Warn"}),
        ),
        (
            "tracks",
            json!([{"name": "sensors", "carla": {"codename": "SENSORS", "routeSubsets": ["0-4", "5-9", "10-14", "15-19"]},
                    "deadlines": {"runSeconds": 3601}, "agent": {"resources": {"limits": {"memory": "1Gi"}}}}]),
            json!([{"name": "sensors", "carla": {"codename": "SENSORS", "routeSubsets": ["0-4", "5-9", "10-14", "15-19"]},
                    "deadlines": {"runSeconds": 3601}, "agent": {"resources": {"limits": {"memory": "1Gi"}}}}]),
        ),
        ("concurrency", json!({"total": 3}), json!({"total": 3})),
        (
            "evaluation",
            carla(
                json!({"image": "simulator:1", "display": "X11Socket", "x11": {}}),
                json!({}),
            ),
            carla(
                json!({"image": "simulator:1", "display": "X11Socket", "x11": {"display": ":0"}}),
                json!({"pairs": 4, "routes": 20, "verify": "Warn"}),
            ),
        ),
        (
            "gpu",
            json!({"resourceName": "nvidia.com/gpu"}),
            json!({"resourceName": "nvidia.com/gpu"}),
        ),
    ]
}

fn half_filled_services() -> Vec<HalfFilled> {
    let evalai = |token: Value, log_tail: &str| {
        json!({
            "apiServer": "https://eval.ai",
            "challenge": 1,
            "split": "leaderboard",
            "token": token,
            "requestsPerMinute": 54,
            "sweepSeconds": 60,
            "logTail": log_tail,
            "mode": "Publish",
        })
    };
    let sent = |token: Value| json!({"apiServer": "https://eval.ai", "challenge": 1, "token": token});
    let secret = json!({"secretKeyRef": {"name": "evalai", "key": "token"}});
    let named = json!({"name": "results"});
    let in_manager = |manager: Value| json!({ "secretsManager": manager });
    vec![
        (
            "storage",
            json!({"s3": {"bucket": "results", "prefix": "a/"}}),
            json!({"s3": {"bucket": "results", "prefix": "a/", "sizeLimit": "20Gi"}}),
        ),
        ("evalai", sent(secret.clone()), evalai(secret, "Hosts")),
        (
            "evalai",
            sent(in_manager(json!({"id": "evalai"}))),
            evalai(in_manager(json!({"id": "evalai", "key": "auth_token"})), "Hosts"),
        ),
        (
            "queue",
            json!({"evalai": {"name": "carla-1"}}),
            json!({"evalai": {"name": "carla-1", "unknownAfterSeconds": 900}}),
        ),
        (
            "queue",
            json!({"sqs": {"url": "https://sqs.example.org/1/a"}}),
            json!({"sqs": {"url": "https://sqs.example.org/1/a", "unknownAfterSeconds": 900, "foreign": "DeadLetter"}}),
        ),
        (
            "podIdentity",
            json!({"secretName": "aws"}),
            json!({"secretName": "aws"}),
        ),
        (
            "table",
            json!({"dynamoDB": named.clone()}),
            json!({"dynamoDB": named.clone()}),
        ),
        (
            "logs",
            json!({"cloudWatch": named.clone()}),
            json!({"cloudWatch": named}),
        ),
    ]
}

#[tokio::test]
async fn every_half_filled_object_reads_back_whole() {
    let server = server().await;
    let api = Kind::Leaderboard.api(&server.client(), &server.namespace("half").await);
    let all = [half_filled_runs(), half_filled_pods(), half_filled_services()];
    for (field, sent, expected) in all.into_iter().flatten() {
        let mut object = Kind::Leaderboard.object("a", &[&json!({"spec": {field: sent}})]);
        if ["evalai", "queue"].contains(&field) {
            serve_evalai(&mut object);
        }
        let read = create(&api, object.clone(), true).await;
        let read = read.unwrap_or_else(|error| panic!("{field} {sent}: {:?}", causes(&error)));
        assert_eq!(read.data["spec"][field], expected, "{field} {sent}");
        // The types fill in the same as the schema: programs without a cluster see what the operator sees.
        let ours: Leaderboard = serde_json::from_value(object).unwrap();
        let theirs = typed(&read);
        assert_eq!(ours.spec, theirs.spec, "{field} {sent}");
    }
}

fn typed(object: &kube::core::DynamicObject) -> Leaderboard {
    serde_json::from_value(serde_json::to_value(object).unwrap()).unwrap()
}

fn serve_evalai(object: &mut Value) {
    object["spec"]["tracks"][0]["phase"] = json!(7);
    if object["spec"]["evalai"].is_null() {
        let token = json!({"secretKeyRef": {"name": "evalai", "key": "token"}});
        object["spec"]["evalai"] = json!({"apiServer": "https://eval.ai", "challenge": 1, "token": token});
    }
}

#[tokio::test]
async fn a_null_is_as_good_as_a_field_left_out() {
    let server = server().await;
    let client = server.client();
    let api = Kind::Leaderboard.api(&client, &server.namespace("null").await);
    let plain = create(&api, Kind::Leaderboard.object("plain", &[]), false)
        .await
        .unwrap();
    let nulls = [
        json!({
            "evalai": null, "queue": null, "table": null, "logs": null, "podIdentity": null,
            "runtimeClassName": null, "podOverrides": null, "agent": null, "retries": null, "deadlines": null, "network": null,
            "concurrency": null, "paused": null, "syncPeriodSeconds": null,
        }),
        json!({
            "tracks": [{
                "name": "sensors", "phase": null,
                "carla": {"codename": null, "pairs": null, "routeSubsets": null, "routesFile": null},
            }],
            "storage": {"s3": {
                "bucket": "results", "prefix": null, "region": null, "endpoint": null, "sizeLimit": null, "kmsKeyARN": null,
                "storageClass": null,
            }},
            "deadlines": {"scheduleSeconds": null, "runSeconds": null},
            "concurrency": {"total": null, "perTeam": null},
            "agent": {"command": null, "args": null, "resources": null, "logSizeLimit": null, "images": null},
            "evaluation": {"carla": {
                "version": "V2", "simulator": {"image": "simulator:1"},
                "contents": {"image": "contents:1", "command": null, "args": null, "securityContext": null},
                "repetitions": null, "verify": null, "pairs": null,
            }},
        }),
    ];
    for (number, spec) in nulls.iter().enumerate() {
        let mut object = Kind::Leaderboard.object("null", &[]);
        // Not a merge patch: the nulls are meant to arrive.
        for (field, value) in spec.as_object().unwrap() {
            object["spec"][field] = value.clone();
        }
        let created = create(&api, object.clone(), true).await;
        let created = created.unwrap_or_else(|error| panic!("{number}: {:?}", causes(&error)));
        assert_eq!(typed(&created).spec, typed(&plain).spec, "created with nulls {number}");
        let params = PatchParams::apply("tests").force();
        object["metadata"]["name"] = json!(format!("applied-{number}"));
        let applied = api
            .patch(&format!("applied-{number}"), &params, &Patch::Apply(object))
            .await;
        let applied = applied.unwrap_or_else(|error| panic!("{number}: {:?}", causes(&error)));
        assert_eq!(typed(&applied).spec, typed(&plain).spec, "applied with nulls {number}");
    }
}

#[tokio::test]
async fn a_null_does_not_get_around_a_rule() {
    let server = server().await;
    let api = Kind::Submission.api(&server.client(), &server.namespace("null").await);
    let mut neither = Kind::Submission.object("a", &[]);
    neither["spec"]["track"] = Value::Null;
    neither["spec"]["evalai"] = Value::Null;
    let causes_of = causes(&create(&api, neither, true).await.unwrap_err());
    assert!(
        matches!(causes_of.as_slice(), [only] if only.contains("not both and not neither")),
        "{causes_of:?}"
    );
    let mut object = Kind::Submission.object("a", &[]);
    object["spec"]["evalai"] = Value::Null;
    object["spec"]["team"] = Value::Null;
    create(&api, object, false).await.unwrap();
}

#[tokio::test]
async fn nothing_is_switched_off_by_a_zero() {
    let server = server().await;
    let api = Kind::Leaderboard.api(&server.client(), &server.namespace("zero").await);
    for (part, field) in [
        ("deadlines", "runSeconds"),
        ("deadlines", "scheduleSeconds"),
        ("deadlines", "finalizeSeconds"),
        ("retention", "finishedSeconds"),
    ] {
        let zero = json!({"spec": {part: {field: 0}}});
        let refused = create(&api, Kind::Leaderboard.object("a", &[&zero]), true)
            .await
            .unwrap_err();
        let first = &causes(&refused)[0];
        assert!(
            first.contains(field) && first.contains("greater than or equal to 1"),
            "{first}"
        );
    }
}

#[tokio::test]
async fn what_lies_in_pod_is_kept_as_it_is() {
    let server = server().await;
    let api = Kind::Leaderboard.api(&server.client(), &server.namespace("pod").await);
    let pod = json!({
        "metadata": {"annotations": {"a": "b"}},
        "spec": {
            "fieldOfANewerKubernetes": {"deep": [1, "two", {"three": null}]},
            "priorityClassName": null,
            "containers": [{"name": "agent", "resizePolicy": [{"resourceName": "cpu", "unheardOf": true}]}],
        },
    });
    let object = {
        let mut object = Kind::Leaderboard.object("a", &[]);
        object["spec"]["podOverrides"] = pod.clone();
        object
    };
    create(&api, object, false).await.unwrap();
    assert_eq!(typed(&api.get("a").await.unwrap()).spec.pod_overrides, Some(pod));
}

#[tokio::test]
async fn submissions_are_found_by_leaderboard_id_and_state() {
    let server = server().await;
    let (client, namespace) = (server.client(), server.namespace("select").await);
    let api = Kind::Submission.api(&client, &namespace);
    let evalai = |id: i64| {
        let ids = json!({"challenge": 1, "phase": 7, "submission": id});
        json!({"spec": {"track": null, "evalai": ids, "leaderboardName": "carla"}})
    };
    for (name, patch) in [("a", json!({})), ("b", evalai(1)), ("c", evalai(2))] {
        create(&api, Kind::Submission.object(name, &[&patch]), false)
            .await
            .unwrap();
    }
    let running = Patch::Merge(json!({"status": {"state": "Running"}}));
    api.patch_status("c", &PatchParams::default(), &running).await.unwrap();
    for (selector, expected) in [
        ("spec.leaderboardName=carla", vec!["b", "c"]),
        ("spec.leaderboardName!=carla", vec!["a"]),
        ("spec.evalai.submission=2", vec!["c"]),
        ("status.state=Running", vec!["c"]),
        ("status.state=Running,spec.evalai.submission=1", vec![]),
    ] {
        assert_eq!(
            names(&client, &namespace, selector).await.unwrap(),
            expected,
            "{selector}"
        );
    }
    let unknown = names(&client, &namespace, "spec.image=agent:1").await.unwrap_err();
    assert!(causes(&unknown)[0].contains("field label not supported"), "{unknown}");
}

async fn names(client: &Client, namespace: &str, selector: &str) -> kube::Result<Vec<String>> {
    let api: Api<Submission> = Api::namespaced(client.clone(), namespace);
    let list = api.list(&ListParams::default().fields(selector)).await?;
    Ok(list.items.into_iter().filter_map(|found| found.metadata.name).collect())
}

#[tokio::test]
async fn spec_and_status_are_written_apart() {
    let server = server().await;
    let api = Kind::Submission.api(&server.client(), &server.namespace("status").await);
    let born = Kind::Submission.object("a", &[&json!({"status": {"state": "Finished"}})]);
    let first = create(&api, born, false).await.unwrap();
    assert_eq!(
        first.data.get("status"),
        None,
        "a status given at birth counts for nothing"
    );
    let both =
        |priority: i64, state: &str| Patch::Merge(json!({"spec": {"priority": priority}, "status": {"state": state}}));
    let params = PatchParams::default();
    let second = api.patch_status("a", &params, &both(1, "Running")).await.unwrap();
    assert_eq!(
        (&second.data["spec"]["priority"], &second.data["status"]["state"]),
        (&json!(0), &json!("Running"))
    );
    assert_eq!(second.metadata.generation, first.metadata.generation);
    let third = api.patch("a", &params, &both(2, "Failed")).await.unwrap();
    assert_eq!(
        (&third.data["spec"]["priority"], &third.data["status"]["state"]),
        (&json!(2), &json!("Running"))
    );
    assert_eq!(
        third.metadata.generation,
        first.metadata.generation.map(|generation| generation + 1)
    );
}

#[tokio::test]
async fn a_full_status_of_our_types_is_kept_whole() {
    let server = server().await;
    let namespace = server.namespace("status").await;
    let api: Api<Submission> = Api::namespaced(server.client(), &namespace);
    let raw = Kind::Submission.api(&server.client(), &namespace);
    create(&raw, Kind::Submission.object("a", &[]), false).await.unwrap();
    let status = super::columns::full_status();
    let params = PatchParams::default();
    let read = api
        .patch_status("a", &params, &Patch::Merge(json!({"status": status})))
        .await
        .unwrap();
    assert_eq!(serde_json::to_value(read.status).unwrap(), status);
}
