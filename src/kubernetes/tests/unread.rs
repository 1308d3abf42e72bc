//! Changes of fields that no code reads.

use super::*;
use crate::kubernetes::objects::Pod;

fn pod(version: &str, finalizers: &[&str], phase: &str) -> Value {
    json!({"apiVersion": "v1", "kind": "Pod",
        "metadata": {"name": "p", "namespace": "ns", "uid": "1", "resourceVersion": version, "finalizers": finalizers},
        "status": {"phase": phase}})
}

#[tokio::test(start_paused = true)]
async fn what_nobody_reads_is_cached_and_is_no_event() {
    let (client, script) = scripted(vec![list(&[pod(
        "5",
        &["batch.kubernetes.io/job-tracking"],
        "Running",
    )])]);
    let (_stop, receiver) = Stop::new();
    let telemetry = Observability::new(receiver);
    let apis = vec![guarded::<Pod>(client, Some("ns"))];
    let watch = spawn_watch(apis, Config::default(), |_| None, &telemetry);
    let mut events = watch.subscribe();
    let mut next = async || {
        let event = timeout(LIMIT, events.next()).await.unwrap().unwrap();
        event.object.metadata.resource_version.to_string()
    };
    assert_eq!(next().await, "5");
    // Each line is read only once the one before is cached.
    let lines = [pod("11", &[], "Running"), pod("12", &[], "Succeeded")].map(|pod| line("MODIFIED", &pod));
    send(&script, vec![Answer::Watch(lines.into())]);
    assert_eq!(next().await, "12");
    send(
        &script,
        vec![Answer::Watch(vec![line("MODIFIED", &pod("13", &[], "Succeeded"))])],
    );
    send(&script, vec![Answer::Watch(vec![gone()]), list(&[])]);
    assert_eq!(next().await, "13", "what is gone is shown as it was last");
}
