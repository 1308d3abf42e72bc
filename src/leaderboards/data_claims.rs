//! The claims that hold a challenge's dataset and labels: they have to be there, and the Pods of all submissions have to get them at once.
//!
//! Reads the claims while the Pods of a Leaderboard are tried; one that may not be read goes unchecked. `judge` is pure.

use k8s_openapi::api::core::v1::PersistentVolumeClaim;
use kube::{Api, Client, ResourceExt};

use super::pod_findings::TriedPods;
use crate::kubernetes::call;
use leaderboard_api::{DataSource, Leaderboard};

/// Reads the claims that the Leaderboard names.
pub(super) async fn look(client: &Client, leaderboard: &Leaderboard, tried: &mut TriedPods) {
    let namespace = leaderboard.namespace().unwrap_or_default();
    let api: Api<PersistentVolumeClaim> = Api::namespaced(client.clone(), &namespace);
    for (field, claim) in named(leaderboard) {
        if let Ok(found) = call("reading the PersistentVolumeClaim", claim, api.get_opt(claim)).await {
            judge(field, claim, found.map(access_modes).as_deref(), tried);
        }
    }
}

/// The claims, each with the field that names it.
pub(super) fn named(leaderboard: &Leaderboard) -> Vec<(&'static str, &str)> {
    let Some(container) = leaderboard.spec.evaluation.container() else {
        return Vec::new();
    };
    let sources = [("dataset", &container.dataset), ("labels", &container.labels)];
    let claims = sources.into_iter().filter_map(|(field, source)| match source {
        Some(DataSource::PersistentVolumeClaim(claim)) => Some((field, claim.claim_name.as_str())),
        Some(DataSource::Image(_)) | None => None,
    });
    claims.collect()
}

/// Those of the volume, and before there is one, those that are asked for.
fn access_modes(claim: PersistentVolumeClaim) -> Vec<String> {
    let of_volume = claim.status.and_then(|status| status.access_modes);
    let asked_for = claim.spec.and_then(|spec| spec.access_modes);
    of_volume.or(asked_for).unwrap_or_default()
}

/// `modes`: its access modes; None: there is no such claim.
fn judge(field: &str, claim: &str, modes: Option<&[String]>, tried: &mut TriedPods) {
    let what = format!("PersistentVolumeClaim {claim} of evaluation.container.{field}");
    let Some(modes) = modes else {
        let text = format!("{what} does not exist in this namespace. Create it, or correct its name.");
        tried.refused.get_or_insert(text);
        return;
    };
    let is = |mode: &str| modes.iter().any(|found| found == mode);
    if is("ReadOnlyMany") || is("ReadWriteMany") {
        return;
    }
    let limit = if is("ReadWriteOnce") {
        "on one node at a time, to which all Pods are pinned"
    } else {
        "by one Pod at a time, so that submissions run one by one"
    };
    tried.notes.push(format!(
        "{what} can be mounted {limit}. Use one with ReadOnlyMany or ReadWriteMany."
    ));
}

#[cfg(test)]
mod tests {
    use http::{Request, Response, StatusCode};
    use kube::client::Body;
    use serde_json::{Value, json};

    use super::*;

    fn board(container: &Value) -> Leaderboard {
        let mut evaluation = json!({"mode": "Batch", "image": "e", "command": ["e"]});
        let fields = container.as_object().unwrap().clone();
        evaluation.as_object_mut().unwrap().extend(fields);
        let spec = json!({
            "tracks": [{"name": "test"}], "evaluation": {"container": evaluation}, "storage": {"s3": {"bucket": "bucket"}},
        });
        Leaderboard::new("board", serde_json::from_value(spec).unwrap())
    }

    #[test]
    fn the_claims_of_dataset_and_labels_are_asked_for() {
        let claim = |name: &str| json!({"persistentVolumeClaim": {"claimName": name}});
        let image = json!({"image": {"reference": "data:1"}});
        for (fields, expected) in [
            (json!({}), vec![]),
            (json!({"dataset": image, "labels": image}), vec![]),
            (json!({"dataset": claim("d"), "labels": image}), vec![("dataset", "d")]),
            (
                json!({"dataset": claim("d"), "labels": claim("l")}),
                vec![("dataset", "d"), ("labels", "l")],
            ),
        ] {
            assert_eq!(named(&board(&fields)), expected, "{fields}");
        }
        let carla = crate::fixtures::leaderboard("carla", "http://127.0.0.1:1");
        assert!(named(&carla).is_empty());
    }

    #[test]
    fn a_missing_claim_is_refused_and_one_that_few_pods_get_is_noted() {
        let present = |modes: &[&str]| Some(modes.iter().map(|mode| (*mode).to_owned()).collect::<Vec<_>>());
        let what = "PersistentVolumeClaim d of evaluation.container.dataset";
        for (seen, refused, note) in [
            (None, Some("does not exist in this namespace"), None),
            (present(&["ReadOnlyMany"]), None, None),
            (present(&["ReadWriteMany"]), None, None),
            (present(&["ReadWriteOnce", "ReadOnlyMany"]), None, None),
            (
                present(&["ReadWriteOnce"]),
                None,
                Some("can be mounted on one node at a time, to which all Pods are pinned"),
            ),
            (
                present(&["ReadWriteOncePod"]),
                None,
                Some("can be mounted by one Pod at a time"),
            ),
        ] {
            let mut problems = TriedPods::default();
            judge("dataset", "d", seen.as_deref(), &mut problems);
            let begins = |found: Option<&String>, rest: Option<&str>| match (found, rest) {
                (Some(found), Some(rest)) => found.starts_with(&format!("{what} {rest}")),
                (found, rest) => found.is_none() && rest.is_none(),
            };
            let found = (&problems.refused, &problems.notes);
            assert!(begins(problems.refused.as_ref(), refused), "{seen:?}: {found:?}");
            assert!(begins(problems.notes.first(), note), "{seen:?}: {found:?}");
        }
    }

    #[test]
    fn a_volume_may_be_mounted_more_often_than_its_claim_asks_for() {
        let of = |claim: Value| access_modes(serde_json::from_value(claim).unwrap());
        let spec = json!({"accessModes": ["ReadWriteOnce"]});
        assert_eq!(of(json!({ "spec": spec })), ["ReadWriteOnce"]);
        let bound = json!({"spec": spec, "status": {"accessModes": ["ReadWriteOnce", "ReadOnlyMany"]}});
        assert_eq!(of(bound), ["ReadWriteOnce", "ReadOnlyMany"]);
        assert_eq!(
            of(json!({"spec": spec, "status": {"phase": "Pending"}})),
            ["ReadWriteOnce"]
        );
    }
    #[tokio::test]
    async fn a_claim_is_read_in_the_namespace_of_its_leaderboard_and_one_that_may_not_be_read_goes_unchecked() {
        let claim = json!({"metadata": {"name": "l"}, "spec": {"accessModes": ["ReadWriteOnce"]}});
        let refusal = |code: u16, reason: &str| json!({"kind": "Status", "status": "Failure", "message": "no", "code": code, "reason": reason});
        for (code, answer, is_refused, notes) in [
            (200, claim, false, 1),
            (404, refusal(404, "NotFound"), true, 0),
            (403, refusal(403, "Forbidden"), false, 0),
        ] {
            let (service, mut server) = tower_test::mock::pair::<Request<Body>, Response<Body>>();
            let client = Client::new(service, "default");
            let mut board = board(&json!({"labels": {"persistentVolumeClaim": {"claimName": "l"}}}));
            board.metadata.namespace = Some("ns".into());
            let serve = async {
                let (request, send) = server.next_request().await.unwrap();
                assert_eq!(request.uri().path(), "/api/v1/namespaces/ns/persistentvolumeclaims/l");
                let mut response = Response::new(Body::from(answer.to_string().into_bytes()));
                *response.status_mut() = StatusCode::from_u16(code).unwrap();
                send.send_response(response);
            };
            let mut found = TriedPods::default();
            tokio::join!(look(&client, &board, &mut found), serve);
            assert_eq!(
                (found.refused.is_some(), found.notes.len()),
                (is_refused, notes),
                "{code}"
            );
        }
    }
}
