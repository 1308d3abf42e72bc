//! Questions to the API server about itself: whether it serves our kinds, and whether it grants rights.
//!
//! The controller waits for the kinds at its start, because the definitions may be applied after the operator. `helm test` asks for both.

use std::time::Duration;

use futures::{StreamExt, stream};
use k8s_openapi::api::authorization::v1::{ResourceAttributes, SelfSubjectAccessReview, SelfSubjectAccessReviewSpec};
use kube::api::PostParams;
use kube::core::GroupVersion;
use kube::{Api, Client, discovery};
use tokio::time::sleep;

use super::call::{CallError, call_within};
use crate::observability::Observability;
use leaderboard_api::{GROUP, VERSION};

/// Name of the check for our kinds.
const KINDS_CHECK: &str = "custom resources";
/// For any one request.
const CALL_LIMIT: Duration = Duration::from_secs(10);
/// Between checks of the kinds.
const KINDS_PAUSE: Duration = Duration::from_secs(2);
/// Requests at once.
const AT_ONCE: usize = 8;

/// Right that the process needs, in words. Without a namespace it is a right in every one, or to a kind that has none.
pub fn described(right: &ResourceAttributes) -> String {
    let part = |before: &str, text: Option<&String>| match text {
        Some(text) if !text.is_empty() => format!("{before}{text}"),
        _ => String::new(),
    };
    let parts = [
        part("", right.verb.as_ref()),
        part(" ", right.resource.as_ref()),
        part("/", right.subresource.as_ref()),
        part(" of ", right.group.as_ref()),
        part(" ", right.name.as_ref()),
        part(" in namespace ", right.namespace.as_ref()),
    ];
    let everywhere = if right.namespace.is_none() {
        " in all namespaces"
    } else {
        ""
    };
    parts.concat() + everywhere
}

/// Registers the check for the kinds, so that the process is not ready before it is answered.
pub fn register(telemetry: &Observability) {
    let unasked = Err("the API server has not been asked yet".to_owned());
    telemetry.readiness.set(KINDS_CHECK, unasked);
}

/// Waits until the API server serves our kinds. False: the process was stopped meanwhile.
pub async fn await_kinds(client: &Client, plurals: &[&str], telemetry: &Observability) -> bool {
    let mut last = String::new();
    loop {
        let state = kinds_missing(client, plurals).await;
        let Some(missing) = state else {
            telemetry.readiness.set(KINDS_CHECK, Ok(()));
            telemetry.liveness.answered();
            return true;
        };
        if missing != last {
            tracing::warn!(missing, "waiting for the custom resources");
        }
        telemetry.readiness.set(KINDS_CHECK, Err(missing.clone()));
        last = missing;
        tokio::select! {
            biased;
            () = telemetry.stop.wait() => return false,
            () = sleep(KINDS_PAUSE) => {}
        }
    }
}

/// Which of our kinds the API server does not serve, as a sentence.
pub async fn kinds_missing(client: &Client, plurals: &[&str]) -> Option<String> {
    let version = GroupVersion::gv(GROUP, VERSION);
    let served = match call_within(
        CALL_LIMIT,
        "discovery",
        GROUP,
        discovery::pinned_group(client, &version),
    )
    .await
    {
        Ok(group) => group.versioned_resources(VERSION),
        // For an unknown group the server answers plain text, so that only the code is used.
        Err(error) if error.is_gone() => Vec::new(),
        // For a group without kinds discovery has an error of its own.
        Err(CallError::Refused { source, .. }) if matches!(*source, kube::Error::Discovery(_)) => Vec::new(),
        Err(error) => return Some(error.cause()),
    };
    let is_served = |plural: &str| served.iter().any(|(kind, _)| kind.plural == plural);
    let missing: Vec<_> = plurals.iter().filter(|plural| !is_served(plural)).copied().collect();
    (!missing.is_empty()).then(|| {
        format!(
            "the API server does not serve {} of {GROUP}/{VERSION}; install the operator's CRDs",
            missing.join(", ")
        )
    })
}

/// A sentence for each need that is not met, in the order of needs.
pub async fn access_missing(client: &Client, needs: &[ResourceAttributes]) -> Vec<String> {
    let reviews: Api<SelfSubjectAccessReview> = Api::all(client.clone());
    // Collected first: a stream of borrowing closures could not be sent to another thread.
    let asked: Vec<_> = needs.iter().map(|need| ask(&reviews, need)).collect();
    let answers = stream::iter(asked).buffered(AT_ONCE);
    answers.filter_map(|missing| async { missing }).collect().await
}

async fn ask(reviews: &Api<SelfSubjectAccessReview>, need: &ResourceAttributes) -> Option<String> {
    let spec = SelfSubjectAccessReviewSpec {
        resource_attributes: Some(need.clone()),
        ..Default::default()
    };
    let review = SelfSubjectAccessReview {
        spec,
        ..Default::default()
    };
    let params = PostParams::default();
    let asked = reviews.create(&params, &review);
    let need = described(need);
    match call_within(CALL_LIMIT, "a review of access", &need, asked).await {
        Ok(answer) if answer.status.as_ref().is_some_and(|status| status.allowed) => None,
        Ok(_) => Some(format!("may not {need}; add the verb to the operator's role")),
        Err(error) => Some(format!("can't ask whether it may {need}: {}", error.cause())),
    }
}
