//! A Leaderboard that names a place it may not: `Ready` shows it, and the controller uses no place of it until that is corrected.
#![cfg(test)]

use kube::Api;
use kube::api::{Patch, PatchParams};
use kube::runtime::wait::await_condition;
use leaderboard_api::{Leaderboard, Reason, conditions};
use leaderboard_operator::runtime::settings::Settings;
use serde_json::{Value, json};
use tokio::time::timeout;

use super::bridge::LIMIT;
use super::operator::{self, Operator};
use super::world::World;
use crate::support::apiserver::server;

const QUEUE: &str = "https://sqs.us-east-1.amazonaws.com/123456789012/payroll";

async fn change(world: &World, spec: &Value) {
    let api: Api<Leaderboard> = world.api();
    let patch = Patch::Merge(json!({ "spec": spec }));
    api.patch("lb", &PatchParams::default(), &patch).await.unwrap();
}

/// The message of `Ready` once it has this reason and this part.
async fn until_says(world: &World, reason: Reason, part: &str) -> String {
    let condition = |board: Option<&Leaderboard>| {
        let status = board.and_then(|board| board.status.as_ref())?;
        conditions::get(&status.conditions, conditions::READY).cloned()
    };
    let says = |board: Option<&Leaderboard>| {
        condition(board).is_some_and(|ready| ready.reason == reason && ready.message.contains(part))
    };
    let found = timeout(LIMIT, Box::pin(await_condition(world.api::<Leaderboard>(), "lb", says))).await;
    let Ok(found) = found else {
        panic!(
            "not {reason} with {part:?}: {:?}",
            world.api::<Leaderboard>().get("lb").await
        );
    };
    condition(found.unwrap().as_ref()).unwrap().message.into()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_leaderboard_that_names_what_it_may_not_is_not_ready_until_it_does_not() {
    let world = World::new().await;
    let namespace = &world.namespace;
    let allowed = json!({ namespace: {"queues": ["submissions"], "buckets": [world.bucket]} });
    let settings = Settings {
        allowed: allowed.to_string().parse().unwrap(),
        ..operator::settings(namespace)
    };
    let config = server().await.config();
    let operator = Operator::start_with(settings, namespace, world.aws.aws.clone(), config);
    world
        .leaderboard_with("lb", 1, "Hosts", &json!({"queue": {"sqs": {"url": QUEUE}}}))
        .await;
    let said = until_says(&world, Reason::NotAllowed, "").await;
    for part in ["the queue", QUEUE, "allow.queues", "entry in namespaces"] {
        assert!(said.contains(part), "{said}");
    }
    let (_, name) = world.submit("lb", 1).await;

    let entry = json!({"secretsManager": {"id": "payroll"}, "secretKeyRef": null});
    change(&world, &json!({"queue": null, "evalai": {"token": entry}})).await;
    until_says(&world, Reason::NotAllowed, "Secrets Manager payroll").await;

    let secret = json!({"secretsManager": null, "secretKeyRef": {"name": "evalai", "key": "token"}});
    change(
        &world,
        &json!({"evalai": {"token": secret}, "table": {"dynamoDB": {"name": "theirs"}}}),
    )
    .await;
    until_says(&world, Reason::NotAllowed, "the table theirs").await;
    change(
        &world,
        &json!({"table": null, "logs": {"cloudWatch": {"name": "theirs"}}}),
    )
    .await;
    until_says(&world, Reason::NotAllowed, "the log group theirs").await;

    change(&world, &json!({"logs": null})).await;
    until_says(&world, Reason::Ready, "").await;
    world.job(&name, 0).await;
    operator.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_token_is_not_sent_in_clear_over_the_internet() {
    let world = World::new().await;
    let _controller = world.controller();
    let server = json!({"evalai": {"apiServer": "http://evalai.example.org"}});
    world.leaderboard_with("lb", 1, "Hosts", &server).await;
    let said = until_says(&world, Reason::InsecureServer, "").await;
    assert!(
        said.contains("http://evalai.example.org") && said.contains("use https"),
        "{said}"
    );
}
