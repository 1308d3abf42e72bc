//! Watches and the preflight on a real API server.

use std::time::Duration;

use futures::StreamExt;
use k8s_openapi::api::authorization::v1::ResourceAttributes;
use k8s_openapi::api::core::v1::Event;
use kube::api::{DeleteParams, Patch, PatchParams, PostParams};
use kube::runtime::watcher::Config;
use kube::{Api, ResourceExt};
use leaderboard_api::Submission;
use leaderboard_base::shutdown::Stop;
use leaderboard_operator::kubernetes::preflight::{access_missing, await_kinds};
use leaderboard_operator::kubernetes::{WatchEvents, guarded, objects, spawn_uncached, spawn_watch};
use leaderboard_operator::observability::Observability;
use leaderboard_operator::submissions::observe::causes::OF_PODS;
use serde_json::json;
use tokio::sync::mpsc;
use tokio::time::timeout;

use crate::support::apiserver::server;

/// Longer than anything here may take, also on a busy machine.
const LIMIT: Duration = Duration::from_mins(2);

/// The next event that `is` waited for; earlier states may come or not.
async fn next(events: &mut WatchEvents<Submission>, is: impl Fn(&Submission, bool) -> bool) {
    let search = async {
        while let Some(event) = events.next().await {
            if is(&event.object, event.is_gone) {
                return;
            }
        }
        panic!("the watch has ended");
    };
    timeout(LIMIT, search).await.expect("an event in time");
}

#[tokio::test]
async fn creations_changes_and_deletions_are_events() {
    let (client, namespace) = (server().await.client(), server().await.namespace("watches").await);
    let (_sender, stop) = Stop::new();
    let telemetry = Observability::new(stop);
    telemetry.readiness.registered();
    let watch = spawn_watch::<Submission>(
        vec![guarded(client.clone(), Some(&namespace))],
        Config::default(),
        |_| None,
        &telemetry,
    );
    let mut events = watch.subscribe();
    watch.store.wait_until_ready().await.unwrap();
    let submissions = Api::<Submission>::namespaced(client, &namespace);
    let object = json!({"apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Submission", "metadata": {"name": "one"},
        "spec": {"leaderboardName": "board", "image": "agent:1", "track": "SENSORS"}});
    submissions
        .create(&PostParams::default(), &serde_json::from_value(object).unwrap())
        .await
        .unwrap();
    next(&mut events, |object, is_gone| object.name_any() == "one" && !is_gone).await;
    let patch = Patch::Merge(json!({"spec": {"priority": 7}}));
    submissions.patch("one", &PatchParams::default(), &patch).await.unwrap();
    next(&mut events, |object, _| object.spec.priority == 7).await;
    assert!(watch.store.state()[0].metadata.managed_fields.is_none());
    submissions.delete("one", &DeleteParams::default()).await.unwrap();
    next(&mut events, |object, is_gone| object.name_any() == "one" && is_gone).await;
    assert!(watch.store.is_empty() && telemetry.readiness.missing().is_empty());
}

/// An event of a Pod, as its source writes it: the scheduler names itself in the newer field alone.
fn event(namespace: &str, source: &str, reason: &str) -> Event {
    let is_new = source == "default-scheduler";
    let time = "2026-01-01T00:00:00.000000Z";
    let event = json!({
        "metadata": {"generateName": "p.", "namespace": namespace},
        "involvedObject": {"kind": "Pod", "namespace": namespace, "name": "p", "uid": "u"},
        "reason": reason, "message": "m", "type": "Normal",
        "source": {"component": (!is_new).then_some(source)},
        "reportingComponent": if is_new { source } else { "" },
        "reportingInstance": if is_new { "one" } else { "" },
        "action": if is_new { "Scheduling" } else { "" },
        "eventTime": is_new.then_some(time),
    });
    serde_json::from_value(event).unwrap()
}

#[tokio::test]
async fn of_the_events_of_pods_those_of_kubelet_and_scheduler_are_not_sent() {
    let (client, namespace) = (server().await.client(), server().await.namespace("events").await);
    let (_sender, stop) = Stop::new();
    let telemetry = Observability::new(stop);
    let api = Api::<Event>::namespaced(client.clone(), &namespace);
    let make = async |source: &str, reason: &str| {
        let event = event(&namespace, source, reason);
        api.create(&PostParams::default(), &event).await.unwrap();
    };
    for (source, reason) in [
        ("kubelet", "Pulled"),
        ("karpenter", "Nominated"),
        ("default-scheduler", "FailedScheduling"),
    ] {
        make(source, reason).await;
    }
    let (sender, mut heard) = mpsc::unbounded_channel();
    let take = move |event: objects::Event| sender.send(event.reason.unwrap_or_default().to_string()).unwrap();
    let config = Config::default().fields(OF_PODS);
    spawn_uncached(
        "events of Pods",
        vec![guarded(client, Some(&namespace))],
        config,
        &telemetry,
        take,
    );
    let mut next = async || timeout(LIMIT, heard.recv()).await.expect("an event in time").unwrap();
    assert_eq!(next().await, "Nominated", "what was there");
    for (source, reason) in [
        ("default-scheduler", "FailedScheduling"),
        ("kubelet", "Started"),
        ("cluster-autoscaler", "NotTriggerScaleUp"),
    ] {
        make(source, reason).await;
    }
    assert_eq!(next().await, "NotTriggerScaleUp", "what came");
}

#[tokio::test]
async fn the_preflight_finds_the_kinds_and_the_permissions_of_an_administrator() {
    let client = server().await.client();
    let (_sender, stop) = Stop::new();
    let telemetry = Observability::new(stop);
    telemetry.readiness.registered();
    let found = timeout(
        LIMIT,
        await_kinds(&client, &["leaderboards", "submissions"], &telemetry),
    )
    .await;
    assert!(found.expect("in time") && telemetry.readiness.missing().is_empty());
    let need = |verb: &str, subresource: Option<&str>| ResourceAttributes {
        group: Some("leaderboard.carla.org".into()),
        resource: Some("submissions".into()),
        subresource: subresource.map(Into::into),
        verb: Some(verb.into()),
        ..ResourceAttributes::default()
    };
    let needs = [need("watch", None), need("patch", Some("status"))];
    assert_eq!(access_missing(&client, &needs).await, Vec::<String>::new());
}
