//! What a Pod is given of what a resolver answers, honest and hostile.

use std::sync::{Arc, Mutex};

use futures::FutureExt;
use serde_json::{Value, json};

use super::*;

fn ips(texts: &[&str]) -> Vec<IpAddr> {
    texts.iter().map(|text| text.parse().unwrap()).collect()
}

fn spec(more: &Value) -> LeaderboardSpec {
    let mut spec = json!({
        "leaderboardVersion": "V2", "tracks": [{"name": "sensors", "codename": "SENSORS"}],
        "contents": {"image": "contents"}, "simulator": {"image": "simulator"},
        "storage": {"bucket": "results", "region": "eu-west-1"},
        "network": {"dns": "Pinned", "egress": [{"cidr": "10.0.0.0/16", "ports": [443]}]},
    });
    for (key, value) in more.as_object().unwrap() {
        spec[key] = value.clone();
    }
    serde_json::from_value(spec).unwrap()
}

/// What the names of a Leaderboard lead to, by a resolver that answers so; with the names that it was asked for.
async fn looked(spec: &LeaderboardSpec, answer: &[&str]) -> (Looked, Vec<String>) {
    let asked = Arc::new(Mutex::new(Vec::new()));
    let (note, answer) = (Arc::clone(&asked), ips(answer));
    let names = Names::by(move |name| {
        note.lock().unwrap().push(name);
        let answer = answer.clone();
        async move { Ok(answer) }.boxed()
    });
    let question = question(spec, &spec.storage, Attempt(1));
    let found = find(&names, &question, None).await;
    let at = Timestamp::UNIX_EPOCH;
    let asked = asked.lock().unwrap().clone();
    (Looked { at, question, found }, asked)
}

async fn given(more: Value, answer: &[&str]) -> Result<names::Addresses, String> {
    let spec = spec(&more);
    usable(&spec.network, &looked(&spec, answer).await.0)
}

const S3: &str = "results.s3.eu-west-1.amazonaws.com";

#[tokio::test]
async fn a_pod_is_given_the_addresses_of_what_its_own_containers_use_and_no_others() {
    let with_all = json!({
        "podIdentity": {"roleARN": "arn:aws:iam::123456789012:role/pods", "serviceAccountName": "pods"},
        "logGroup": {"name": "carla", "region": "eu-central-1"},
        // The controller's own.
        "table": {"name": "rows", "region": "us-west-2"},
    });
    let given_all = given(with_all, &["10.0.4.10", "10.0.5.10"]).await.unwrap();
    let hosts = ["logs.eu-central-1.amazonaws.com", S3, "sts.eu-west-1.amazonaws.com"];
    assert_eq!(given_all.keys().map(String::as_str).collect::<Vec<_>>(), hosts);
    assert!(
        given_all
            .values()
            .all(|found| *found == ips(&["10.0.4.10", "10.0.5.10"]))
    );
    // Keys need no STS, and an address no resolver.
    let keys = json!({"podIdentity": {"secretName": "aws"}});
    assert_eq!(given(keys, &["10.0.4.10"]).await.unwrap().len(), 1);
    let spec = spec(&json!({"storage": {"bucket": "results", "endpoint": "http://10.0.0.5:9000"}}));
    let (looked, asked) = looked(&spec, &[]).await;
    assert_eq!(
        (usable(&spec.network, &looked), asked),
        (Ok(names::Addresses::new()), Vec::new())
    );
}

#[tokio::test]
async fn only_what_the_policy_allows_is_given() {
    let mixed = [
        "10.0.4.10",
        "10.9.0.1",
        "52.218.0.1",
        "169.254.169.254",
        "127.0.0.1",
        "::1",
    ];
    let found = given(json!({}), &mixed).await.unwrap();
    assert_eq!(found[S3], ips(&["10.0.4.10"]));
    // Whatever the cluster's own policies allow is not known.
    let external = json!({"network": {"dns": "Pinned", "policy": "External"}});
    let found = given(external, &mixed).await.unwrap();
    assert_eq!(found[S3], ips(&["10.0.4.10", "10.9.0.1", "52.218.0.1"]));
    let other_port = json!({"network": {"dns": "Pinned", "egress": [{"cidr": "10.0.0.0/16", "ports": [80]}]}});
    let error = given(other_port, &["10.0.4.10", "10.0.5.10"]).await.unwrap_err();
    let expected = format!(
        "The name {S3} (S3) leads to 10.0.4.10/32 and 1 other addresses, and network.egress allows none of them on port 443."
    );
    assert!(error.starts_with(&expected), "{error}");
}

#[tokio::test]
async fn a_name_that_leads_to_metadata_or_to_this_machine_is_refused_even_where_all_addresses_are_allowed() {
    let all = [json!({"cidr": "0.0.0.0/0"}), json!({"cidr": "::/0"})];
    for policy in ["Managed", "External"] {
        for address in [
            "169.254.169.254",
            "169.254.170.23",
            "100.100.100.200",
            "127.0.0.1",
            "0.0.0.0",
            "224.0.0.1",
            "::1",
            "fd00:ec2::254",
            "::ffff:169.254.169.254",
            "64:ff9b::169.254.169.254",
        ] {
            let network = json!({"dns": "Pinned", "policy": policy, "egress": all});
            let error = given(json!({ "network": network }), &[address]).await.unwrap_err();
            assert!(error.contains("which no Pod is given"), "{address}: {error}");
        }
    }
}

#[tokio::test]
async fn public_addresses_that_are_not_allowed_are_shown_in_words_that_do_not_change() {
    let first = given(json!({}), &["52.218.0.1"]).await.unwrap_err();
    let second = given(json!({}), &["52.218.7.7", "52.218.8.8"]).await.unwrap_err();
    assert_eq!(first, second);
    assert!(first.contains("make an interface endpoint"), "{first}");
}

#[tokio::test]
async fn an_error_of_a_resolver_is_one_line_and_names_what_to_do() {
    let names = Names::by(|_| async { Err(std::io::Error::other("no\nsuch \u{1b}[31mname.")) }.boxed());
    let spec = spec(&json!({}));
    let question = question(&spec, &spec.storage, Attempt(1));
    let found = find(&names, &question, None).await;
    let at = Timestamp::UNIX_EPOCH;
    let error = usable(&spec.network, &Looked { at, question, found }).unwrap_err();
    assert!(
        error.starts_with(&format!("The address of {S3} (S3) is not known: no such")),
        "{error}"
    );
    assert!(
        !error.contains(['\n', '\u{1b}']) && error.contains("correct the name"),
        "{error}"
    );
    let error = given(json!({"storage": {"bucket": "b", "endpoint": "nonsense"}}), &[])
        .await
        .unwrap_err();
    assert!(error.contains("Correct storage, logGroup or the region"), "{error}");
}
