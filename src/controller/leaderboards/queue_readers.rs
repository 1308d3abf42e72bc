//! What the bridges of this operator may hold of a queue: read from the caches, and asked of the API server only for a queue in
//! question.

use std::sync::Arc;

use jiff::{SignedDuration, Timestamp};
use k8s_openapi::api::core::v1::Event;
use kube::api::ListParams;
use kube::{Api, Client, ResourceExt};

use super::shared_queue::{Sign, by_number, is_recent, is_shared_on_purpose};
use crate::controller::stores::Stores;
use crate::kubernetes::call;
use crate::services::queue::Reading;
use leaderboard_api::{Leaderboard, Queue, Submission, reasons};

/// What a bridge reports of messages that it cannot use, now or ever: no Submission shows that it has received them.
const HELD_BACK: [&str; 3] = [
    reasons::MESSAGES_HELD_BACK,
    reasons::QUEUE_BLOCKED,
    reasons::DEAD_LETTER,
];
/// So long after such a report the messages may still be held back: the bridges' longest wait of 15 min, and time to report it again.
const HELD_FOR: SignedDuration = SignedDuration::from_mins(20);
/// Most events of a Leaderboard that are read.
const MOST_EVENTS: u32 = 200;

/// Whether a Leaderboard of this queue asks for another reader.
pub(super) fn is_on_purpose(stores: &Stores, queue: &Queue) -> bool {
    let all = stores.leaderboards.state();
    is_shared_on_purpose(queue, all.iter().map(Arc::as_ref))
}

/// What a reading shows.
pub(super) async fn sign(client: &Client, stores: &Stores, queue: &Queue, reading: &Reading, now: Timestamp) -> Sign {
    if let Some(sign) = by_number(reading) {
        return sign;
    }
    let mut boards = stores.leaderboards.state();
    boards.retain(|board| board.spec.queue.as_ref().is_some_and(|other| other.url == queue.url));
    let is_of_queue = |submission: &Submission| {
        let of = |board: &Arc<Leaderboard>| {
            board.namespace() == submission.namespace() && board.name_any() == submission.spec.leaderboard_name
        };
        boards.iter().any(of)
    };
    let all = stores.submissions.state();
    if all.iter().any(|one| is_recent(one, reading, now) && is_of_queue(one)) {
        return Sign::Unclear;
    }
    for board in &boards {
        if may_hold_back(client, board, now).await {
            return Sign::Unclear;
        }
    }
    Sign::Foreign
}

/// Whether a bridge has reported for this Leaderboard that it holds messages back. It has, if that cannot be read.
async fn may_hold_back(client: &Client, board: &Leaderboard, now: Timestamp) -> bool {
    let (namespace, name) = (board.namespace().unwrap_or_default(), board.name_any());
    let events: Api<Event> = Api::namespaced(client.clone(), &namespace);
    let selector = format!("involvedObject.kind=Leaderboard,involvedObject.name={name}");
    let params = ListParams::default().fields(&selector).limit(MOST_EVENTS);
    let listed = call("the events of a Leaderboard", &name, events.list(&params)).await;
    listed.map_or(true, |listed| listed.items.iter().any(|event| is_report(event, now)))
}

fn is_report(event: &Event, now: Timestamp) -> bool {
    let is_meant = event
        .reason
        .as_deref()
        .is_some_and(|reason| HELD_BACK.contains(&reason));
    let series = event
        .series
        .as_ref()
        .and_then(|series| series.last_observed_time.as_ref());
    let times = [
        series.map(|time| time.0),
        event.event_time.as_ref().map(|time| time.0),
        event.last_timestamp.as_ref().map(|time| time.0),
    ];
    let last = times.into_iter().flatten().max();
    is_meant && last.is_none_or(|last| now.duration_since(last) < HELD_FOR)
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    #[test]
    fn a_bridge_that_has_reported_of_late_may_still_hold_messages_back() {
        let now: Timestamp = "2026-11-20T12:00:00Z".parse().unwrap();
        let (young, old) = ("2026-11-20T11:40:01.000000Z", "2026-11-20T11:40:00.000000Z");
        let cases = [
            (json!({"reason": "MessagesHeldBack", "eventTime": young}), true),
            (json!({"reason": "QueueBlocked", "eventTime": young}), true),
            (json!({"reason": "DeadLetter", "eventTime": young}), true),
            (json!({"reason": "Ready", "eventTime": young}), false),
            (json!({"reason": "MessagesHeldBack", "eventTime": old}), false),
            (
                json!({"reason": "MessagesHeldBack", "eventTime": old, "series": {"count": 2, "lastObservedTime": young}}),
                true,
            ),
            (
                json!({"reason": "MessagesHeldBack", "lastTimestamp": "2026-11-20T11:59:00Z"}),
                true,
            ),
            (json!({"reason": "MessagesHeldBack"}), true),
        ];
        for (mut event, expected) in cases {
            event["involvedObject"] = json!({});
            event["metadata"] = Value::Object(serde_json::Map::default());
            let event: Event = serde_json::from_value(event).unwrap();
            assert_eq!(is_report(&event, now), expected, "{event:?}");
        }
    }
}
