//! The messages that EvalAI puts into the queue, in random order.

use std::collections::BTreeMap;

use aws_sdk_sqs::types::SendMessageBatchRequestEntry;
use futures::StreamExt;
use leaderboard_api::names;
use serde_json::json;

use crate::api::bridge::StandIn;

/// The phase that the Leaderboard serves.
pub const PHASE: u64 = 1;
/// The id of a submission whose name an object of somebody else has.
pub const TAKEN: i64 = 9_999_999;
/// Most entries of a batch.
const BATCH: usize = 10;
/// Batches on their way at once.
const AT_ONCE: usize = 8;

#[derive(Default)]
pub struct Messages {
    /// In the order in which they are sent.
    pub bodies: Vec<String>,
    ids: Vec<i64>,
    /// The bodies that cannot be used, and why.
    pub garbage: BTreeMap<String, String>,
}

impl Messages {
    /// One for each of `ids`, so many of them again, and so many that are of no use.
    pub fn of(ids: &[u64], duplicates: usize, garbage: usize) -> Self {
        let seed = fastrand::u64(..);
        println!("the order of the messages is of seed {seed}");
        let mut random = fastrand::Rng::with_seed(seed);
        let ids: Vec<i64> = ids.iter().map(|id| i64::try_from(*id).unwrap()).collect();
        let again: Vec<i64> = (0..duplicates).map(|_| ids[random.usize(..ids.len())]).collect();
        let good = ids.iter().chain(&again).map(|id| body(PHASE, *id, 0));
        let garbage: BTreeMap<_, _> = (0..garbage).map(useless).collect();
        let mut bodies: Vec<String> = good.chain(garbage.keys().cloned()).collect();
        random.shuffle(&mut bodies);
        Self { bodies, ids, garbage }
    }

    /// The Submissions that there have to be.
    pub fn names(&self) -> impl Iterator<Item = String> {
        self.ids.iter().map(|id| names::submission(*id))
    }

    pub async fn send(&self, stand_in: &StandIn, queue: &str) {
        let sqs = stand_in.sqs();
        let batches = self.bodies.chunks(BATCH).map(|bodies| {
            let entries = bodies.iter().enumerate().map(|(id, body)| {
                let entry = SendMessageBatchRequestEntry::builder().id(id.to_string());
                entry.message_body(body).build().unwrap()
            });
            let request = sqs.send_message_batch().queue_url(queue);
            request.set_entries(Some(entries.collect())).send()
        });
        let sent = futures::stream::iter(batches).buffer_unordered(AT_ONCE);
        sent.for_each(async |answer| assert_eq!(answer.unwrap().failed(), []))
            .await;
    }
}

fn body(phase: u64, submission: i64, number: usize) -> String {
    json!({
        "challenge_pk": "1", "phase_pk": phase.to_string(), "submission_pk": submission,
        "submitted_image_uri": "registry.example/team-a:1", "number": number,
    })
    .to_string()
}

/// A body that cannot be used, and why.
fn useless(number: usize) -> (String, String) {
    let (body, reason) = match number % 4 {
        0 => (format!("{{ no JSON {number}"), "Malformed"),
        1 => (
            json!({"challenge_pk": 1, "phase_pk": 1, "number": number}).to_string(),
            "Malformed",
        ),
        2 => (body(999, 7, number), "UnknownPhase"),
        _ => (body(PHASE, TAKEN, number), "IdTaken"),
    };
    (body, reason.to_owned())
}
