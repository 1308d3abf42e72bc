//! One queue as the bridge reads it, against the AWS stand-in.
#![cfg(test)]

use std::time::Duration;

use aws_credential_types::provider::error::CredentialsError;
use aws_credential_types::provider::{ProvideCredentials, SharedCredentialsProvider, future};
use aws_sdk_sqs::types::MessageSystemAttributeName;
use leaderboard_aws::clients::Aws;
use leaderboard_aws::fault::Fault;
use leaderboard_base::clock::Clock;
use leaderboard_base::meter::Meter;
use leaderboard_operator::bridge::queue::Reader;
use leaderboard_operator::intake::source::Received;
use leaderboard_policy::intake::route::DeadReason;

use super::bridge::{LIMIT, StandIn};

async fn reader(stand_in: &StandIn, url: &str) -> Reader {
    Reader::open(stand_in.sqs(), url, Meter::default()).await.unwrap()
}

async fn receive(reader: &Reader, count: usize) -> Vec<Received> {
    let mut all = Vec::new();
    let take = async {
        while all.len() < count {
            all.extend(reader.receive(10, &Clock::system()).await.unwrap());
        }
    };
    tokio::time::timeout(LIMIT, take).await.expect("messages arrive");
    all
}

#[tokio::test]
async fn a_queue_gives_messages_back_until_they_are_deleted() {
    let stand_in = StandIn::start().await;
    let url = stand_in.queue("q").await;
    stand_in.set_visibility(&url, 7).await;
    let reader = reader(&stand_in, &url).await;
    assert_eq!(reader.visibility(), Duration::from_secs(7));
    let before = jiff::Timestamp::now().as_millisecond();
    stand_in.send(&url, "hello").await;
    let first = receive(&reader, 1).await.remove(0);
    assert_eq!((first.body.as_str(), first.receives, first.group), ("hello", 1, None));
    assert!(
        (before - 5000..before + 60_000).contains(&first.sent_ms),
        "milliseconds: {}",
        first.sent_ms
    );
    assert!(first.first_seen_ms >= first.sent_ms);
    // Given back at once.
    reader.hold(&[&first.receipt], 0).await.unwrap();
    let second = receive(&reader, 1).await.remove(0);
    assert_eq!((second.id.as_str(), second.receives), (first.id.as_str(), 2));
    reader.delete(&[&second.receipt]).await.unwrap();
    stand_in.drained(&url).await;
    reader
        .delete(&[&second.receipt, &first.receipt])
        .await
        .expect("what is deleted already is done");
}

#[tokio::test]
async fn a_dead_letter_shows_why_and_from_where_it_came() {
    let stand_in = StandIn::start().await;
    let (url, dead) = (stand_in.queue("q.fifo").await, stand_in.queue("dead.fifo").await);
    let send = stand_in.sqs().send_message().queue_url(&url).message_body("{}");
    send.message_group_id("3-12")
        .message_deduplication_id("7-x")
        .send()
        .await
        .unwrap();
    let reader = reader(&stand_in, &url).await;
    let message = receive(&reader, 1).await.remove(0);
    assert_eq!(message.group.as_deref(), Some("3-12"));
    let reason = DeadReason::Malformed("challenge_pk is\nmissing".into());
    // A crash between sending and deleting sends it twice; a FIFO queue keeps one.
    reader.send_dead(&dead, &message, &reason).await.unwrap();
    reader.send_dead(&dead, &message, &reason).await.unwrap();
    assert_eq!(stand_in.depth(&dead).await, (1, 0));
    let letters = stand_in
        .sqs()
        .receive_message()
        .queue_url(&dead)
        .message_attribute_names("All");
    let letters = letters.message_system_attribute_names(MessageSystemAttributeName::MessageGroupId);
    let letter = letters.send().await.unwrap().messages.unwrap().remove(0);
    assert_eq!(letter.body(), Some("{}"));
    assert_eq!(
        letter.attributes().unwrap()[&MessageSystemAttributeName::MessageGroupId],
        "3-12"
    );
    let attributes = letter.message_attributes.unwrap();
    let text = |name: &str| attributes[name].string_value.clone().unwrap();
    assert_eq!(
        (text("reason"), text("detail")),
        ("Malformed".into(), "challenge_pk is missing".into())
    );
    assert_eq!((text("queue"), text("messageId")), (url, message.id));
    assert!(
        text("firstSeen").parse::<jiff::Timestamp>().is_ok(),
        "{}",
        text("firstSeen")
    );
}

#[tokio::test]
async fn a_queue_that_cannot_be_used_is_named_with_what_to_do() {
    let stand_in = StandIn::start().await;
    let missing = format!("{}/000000000000/nowhere", stand_in.endpoint);
    let error = Reader::open(stand_in.sqs(), &missing, Meter::default())
        .await
        .err()
        .unwrap();
    assert_eq!(error.fault, Fault::Missing, "{error}");
    let text = error.to_string();
    assert!(
        text.starts_with(&format!("queue {missing}: GetQueueAttributes failed: ")),
        "{text}"
    );
    assert!(
        text.ends_with("check queue.sqs.url, queue.sqs.region and queue.sqs.endpoint of its Leaderboards"),
        "{text}"
    );
    let port = std::net::TcpListener::bind(("127.0.0.1", 0))
        .unwrap()
        .local_addr()
        .unwrap()
        .port();
    let nobody = stand_in.aws.sqs(None, Some(&format!("http://127.0.0.1:{port}")));
    let error = Reader::open(nobody, &missing, Meter::default()).await.err().unwrap();
    assert_eq!(error.fault, Fault::Unavailable, "{error}");
    let anonymous = aws_config::SdkConfig::builder()
        .behavior_version(aws_config::BehaviorVersion::latest())
        .http_client(aws_smithy_http_client::Builder::new().build_http())
        .credentials_provider(SharedCredentialsProvider::new(Nobody))
        .build();
    let anonymous = Aws::from_config(anonymous).sqs(None, Some(&stand_in.endpoint));
    // Without the attribute the usual visibility is assumed; the receive then fails.
    let reader = Reader::open(anonymous, &missing, Meter::default()).await.unwrap();
    let error = reader.receive(1, &Clock::system()).await.err().unwrap();
    assert_eq!(error.fault, Fault::Denied, "{error}");
    assert!(
        error.to_string().ends_with("and that they allow sqs:ReceiveMessage"),
        "{error}"
    );
}

/// Has no credentials.
#[derive(Debug)]
struct Nobody;

impl ProvideCredentials for Nobody {
    fn provide_credentials<'a>(&'a self) -> future::ProvideCredentials<'a>
    where
        Self: 'a,
    {
        future::ProvideCredentials::ready(Err(CredentialsError::not_loaded("nothing is set")))
    }
}
