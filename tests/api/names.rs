//! Where `network.dns` is `Pinned`: the policy opens no way to a resolver, and the Job carries what the operator has looked up.

use std::net::IpAddr;
use std::sync::{Arc, Mutex};

use futures::FutureExt;
use k8s_openapi::api::networking::v1::NetworkPolicy;
use leaderboard_api::{Submission, reasons};
use leaderboard_operator::services::names::Names;
use serde_json::{Value, json};

use super::isolation::{World, run};
use super::operator::Operator;

const ENDPOINT: &str = "https://s3.pinned.invalid";

/// A controller whose resolver answers so, and which names it was asked for.
async fn operator(world: &World, answer: &[&str]) -> (Operator, Arc<Mutex<Vec<String>>>) {
    let answer: Vec<IpAddr> = answer.iter().map(|text| text.parse().unwrap()).collect();
    let asked = Arc::new(Mutex::new(Vec::new()));
    let note = Arc::clone(&asked);
    let names = Names::by(move |name| {
        note.lock().unwrap().push(name);
        let answer = answer.clone();
        async move { Ok(answer) }.boxed()
    });
    let aws = world.aws.aws.clone().naming_by(names);
    (Operator::start(&world.namespace, aws).await, asked)
}

fn pinned(cidr: &str) -> Value {
    json!({"dns": "Pinned", "egress": [{"cidr": cidr, "ports": [443]}]})
}

#[tokio::test(flavor = "multi_thread")]
async fn no_pod_may_ask_a_resolver_and_its_own_containers_are_given_addresses() {
    let world = World::new().await;
    let answer = ["10.0.4.10", "10.0.5.10", "169.254.169.254"];
    let (operator, asked) = operator(&world, &answer).await;
    world.leaderboard_at(ENDPOINT, &pinned("10.0.4.0/24")).await;
    for name in ["first", "second"] {
        world.submit(name).await;
    }
    let jobs = [world.job("first").await, world.job("second").await];
    let expected = json!({"s3.pinned.invalid": ["10.0.4.10"]});
    for job in &jobs {
        for own in ["workspace", "logcopy"] {
            assert_eq!(run(job, own).unwrap()["addresses"], expected, "{own}");
        }
        for other in ["contents", "simulator-1", "agent-1"] {
            assert_eq!(run(job, other), None, "{other}");
        }
    }
    let policy: NetworkPolicy = world.until("leaderboard-carla", "it is applied", |_| true).await;
    let egress = json!(policy.spec.unwrap().egress);
    let allowed = json!([{"to": [{"ipBlock": {"cidr": "10.0.4.0/24"}}], "ports": [{"protocol": "TCP", "port": 443}]}]);
    assert_eq!(egress, allowed);
    assert_eq!(
        *asked.lock().unwrap(),
        ["s3.pinned.invalid"],
        "the second submission has the first one's answer"
    );
    operator.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_address_that_the_policy_forbids_is_named_and_the_hosts_edit_starts_the_run() {
    let world = World::new().await;
    let (operator, _) = operator(&world, &["10.9.0.1"]).await;
    world.leaderboard_at(ENDPOINT, &pinned("10.0.4.0/24")).await;
    world.submit("one").await;
    let waits = |submission: &Submission| {
        let status = submission.status.as_ref();
        let message = status.and_then(|status| status.message.as_deref()).unwrap_or_default();
        status.and_then(|status| status.reason.as_deref()) == Some(reasons::NAME_NOT_RESOLVED)
            && message.contains("s3.pinned.invalid (S3) leads to 10.9.0.1/32")
    };
    world.until("one", "it says which address is not allowed", waits).await;
    world.change(&pinned("10.9.0.1/32")).await;
    let job = world.job("one").await;
    let addresses = &run(&job, "logcopy").unwrap()["addresses"];
    assert_eq!(addresses, &json!({"s3.pinned.invalid": ["10.9.0.1"]}));
    operator.end().await;
}
