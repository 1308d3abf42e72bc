//! Lists in pages, and writes that are answered with metadata alone.

use kube::api::{DeleteParams, Patch, PatchParams, PostParams};

use super::*;
use leaderboard_api::Submission;

/// A page of a list that goes on.
fn page(items: &[Value]) -> Answer {
    let metadata = json!({"resourceVersion": "10", "continue": "more"});
    Answer::Json(
        200,
        json!({"apiVersion": "v1", "kind": "List", "metadata": metadata, "items": items}),
    )
}

fn status(code: u16, reason: &str) -> Answer {
    Answer::Json(
        code,
        json!({"kind": "Status", "status": "Failure", "reason": reason, "code": code, "message": "no"}),
    )
}

#[tokio::test(start_paused = true)]
async fn a_page_with_an_unreadable_object_brings_all_others() {
    let mut rig = rig(vec![
        page(&[board("a", "1", "3"), malformed("bad", "2", "4")]),
        list(&[board("b", "3", "5")]),
    ]);
    let mut listed = vec![rig.next().await, rig.next().await];
    listed.sort();
    assert_eq!(listed, [event("a", "3", false), event("b", "5", false)]);
    assert!(rig.watch.synced.is_true() && !rig.watch.is_complete());
    assert_eq!(rig.watch.store.len(), 2);
}

#[tokio::test(start_paused = true)]
async fn what_was_deleted_between_two_pages_of_a_list_that_expired_is_not_there() {
    let mut rig = rig(vec![
        page(&[board("a", "1", "3"), board("b", "2", "4")]),
        status(410, "Expired"),
        page(&[board("a", "1", "3")]),
        list(&[board("c", "3", "5")]),
    ]);
    let mut listed = vec![rig.next().await, rig.next().await, rig.next().await];
    listed.sort();
    let gone = event("b", "4", true);
    assert_eq!(listed, [event("a", "3", false), gone, event("c", "5", false)]);
    assert_eq!(rig.watch.store.len(), 2);
}

#[tokio::test(start_paused = true)]
async fn a_change_that_a_broken_list_has_shown_is_an_event_of_the_next_one() {
    let mut rig = rig(vec![list(&[board("a", "1", "3"), board("b", "2", "4")])]);
    let mut first = vec![rig.next().await.0, rig.next().await.0];
    first.sort();
    assert_eq!(first, ["a", "b"]);
    rig.send(vec![
        Answer::Watch(vec![gone()]),
        page(&[board("a", "1", "20")]),
        status(500, "InternalError"),
        page(&[board("a", "1", "20")]),
        list(&[board("b", "2", "4")]),
        Answer::Watch(vec![line("ADDED", &board("last", "9", "30"))]),
    ]);
    assert_eq!(rig.next().await, event("a", "20", false));
    assert_eq!(rig.next().await, event("last", "30", false), "and nothing of b");
}

#[tokio::test(start_paused = true)]
async fn a_change_that_a_list_after_a_refusal_shows_is_an_event_once_the_cache_is_in_sync() {
    let mut rig = rig(vec![list(&[board("a", "1", "3")])]);
    assert_eq!(rig.next().await, event("a", "3", false));
    rig.send(vec![status(403, "Forbidden"), page(&[board("a", "1", "20")])]);
    while rig.watch.store.state().remove(0).resource_version().as_deref() != Some("20") {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    assert!(!rig.watch.synced.is_true());
    let early = timeout(Duration::from_secs(1), rig.events.next()).await;
    assert!(early.is_err(), "nothing would wake its reader again");
    rig.send(vec![list(&[])]);
    assert_eq!(rig.next().await, event("a", "20", false));
    assert!(rig.watch.synced.is_true());
}

#[test]
fn what_nobody_reads_is_not_kept() {
    let mut object = board("a", "1", "3");
    object["metadata"]["managedFields"] = json!([{"manager": "kubectl", "fieldsV1": {"f:spec": {}}}]);
    object["metadata"]["annotations"] =
        json!({"kubectl.kubernetes.io/last-applied-configuration": "{}", "leaderboard.carla.org/other": "x"});
    object["metadata"]["finalizers"] = json!(["one"]);
    let text = object.to_string();
    let item: Item<Leaderboard> = serde_json::from_str(&text).unwrap();
    let metadata = item.object.unwrap().metadata;
    assert!(metadata.managed_fields.is_none());
    let annotations: Vec<_> = metadata.annotations.unwrap().into_keys().collect();
    assert_eq!(annotations, ["leaderboard.carla.org/other"]);
    assert_eq!(metadata.finalizers.as_deref(), Some(&["one".to_owned()][..]));
}

/// A client, and what it has sent: the line of the request, and what answer it takes.
fn answered(answers: Vec<Answer>) -> (Client, mpsc::UnboundedReceiver<(String, String)>) {
    let (service, mut handle) = pair::<Request<Body>, Response<Body>>();
    let (tell, sent) = mpsc::unbounded_channel();
    tokio::spawn(async move {
        for answer in answers {
            let Some((request, send)) = handle.next_request().await else {
                return;
            };
            let accept = request.headers()["accept"].to_str().unwrap().to_owned();
            let _ = tell.send((format!("{} {}", request.method(), request.uri().path()), accept));
            let Answer::Json(code, body) = answer else { return };
            let response = Response::builder()
                .status(code)
                .body(Body::from(body.to_string().into_bytes()));
            send.send_response(response.unwrap());
        }
    });
    (Client::new(service, "default"), sent)
}

#[tokio::test]
async fn a_write_is_answered_with_metadata_alone() {
    let partial = || {
        let metadata =
            json!({"name": "a", "namespace": "ns", "uid": "u", "resourceVersion": "12", "managedFields": [{}]});
        Answer::Json(
            200,
            json!({"kind": "PartialObjectMetadata", "apiVersion": "meta.k8s.io/v1", "metadata": metadata}),
        )
    };
    let deleted = Answer::Json(200, json!({"kind": "Status", "metadata": {}, "status": "Success"}));
    let (client, mut sent) = answered(vec![partial(), partial(), partial(), deleted, status(409, "Conflict")]);
    let api = Writes::<Submission>::new(&Writer::new(client.clone(), || true), "ns");
    let patch = Patch::Merge(json!({}));
    let (post, params) = (PostParams::default(), PatchParams::default());
    for answer in [
        api.create(&post, &json!({})).await,
        api.patch("a", &params, &patch).await,
        api.patch_status("a", &params, &patch).await,
    ] {
        assert_eq!(answer.unwrap().metadata.resource_version.as_ref(), "12");
    }
    assert!(api.delete("a", &DeleteParams::default()).await.is_ok());
    let refused = api.patch("a", &params, &patch).await;
    assert!(matches!(refused, Err(kube::Error::Api(status)) if status.code == 409));
    let lost = Writes::<Submission>::new(&Writer::new(client, || false), "ns");
    assert!(lost.patch("a", &params, &patch).await.is_err(), "nothing is sent");
    let all = "/apis/leaderboard.carla.org/v1alpha1/namespaces/ns/submissions";
    let (one, of_status) = (format!("{all}/a"), format!("{all}/a/status"));
    for expected in [
        format!("POST {all}"),
        format!("PATCH {one}"),
        format!("PATCH {of_status}"),
        format!("DELETE {one}"),
        format!("PATCH {one}"),
    ] {
        let (request, accept) = sent.recv().await.unwrap();
        assert_eq!(request, expected);
        assert_eq!(accept, "application/json;as=PartialObjectMetadata;g=meta.k8s.io;v=v1");
    }
    assert!(sent.try_recv().is_err());
}
