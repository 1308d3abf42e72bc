//! The dead letters of a test.

use std::collections::BTreeMap;

use crate::api::bridge::StandIn;

/// A dead letter's body and its reason.
pub type Letter = (String, String);

/// Takes all that are there.
pub async fn take_all(stand_in: &StandIn, url: &str) -> Vec<Letter> {
    let sqs = stand_in.sqs();
    let mut letters = Vec::new();
    while stand_in.depth(url).await != (0, 0) {
        let receive = sqs.receive_message().queue_url(url).max_number_of_messages(10);
        let answer = receive.message_attribute_names("reason").send().await.unwrap();
        for message in answer.messages.unwrap_or_default() {
            let delete = sqs.delete_message().queue_url(url);
            delete
                .receipt_handle(message.receipt_handle.unwrap())
                .send()
                .await
                .unwrap();
            let reason = message.message_attributes.unwrap()["reason"].string_value.clone();
            letters.push((message.body.unwrap(), reason.unwrap()));
        }
    }
    letters
}

/// The reason of each body.
pub fn reasons(letters: &[Letter]) -> BTreeMap<String, String> {
    letters.iter().cloned().collect()
}

/// Bodies by reason.
pub fn by_reason(letters: &[Letter]) -> BTreeMap<String, usize> {
    let mut counts = BTreeMap::new();
    for reason in reasons(letters).into_values() {
        *counts.entry(reason).or_insert(0) += 1;
    }
    counts
}

/// A kill between a dead letter and the deletion of its message makes another copy: how many there are.
pub fn copies(letters: &[Letter]) -> usize {
    letters.len() - reasons(letters).len()
}
