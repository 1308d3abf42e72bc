//! The parts of the AWS stand-in that one test has: a queue with its dead-letter queue, two tables and a prefix in a bucket.

use std::collections::BTreeMap;
use std::time::Duration;

use aws_sdk_dynamodb::types::{
    AttributeDefinition, AttributeValue, BillingMode, KeySchemaElement, KeyType, ScalarAttributeType,
};
use aws_sdk_sqs::types::{Message, MessageSystemAttributeName, QueueAttributeName};
use leaderboard_aws::clients::Aws;
use tokio::time::{Instant, sleep};

/// The region that the stand-in plays.
pub const REGION: &str = "us-east-1";
/// The bucket of all tests.
pub const BUCKET: &str = "leaderboard-tests";
/// SQS has no events: its counts are asked for this often.
const ASK_EVERY: Duration = Duration::from_millis(250);

/// One test's own things in AWS.
#[derive(Clone)]
pub struct Cloud {
    /// The stand-in's address, for everybody.
    pub endpoint: String,
    /// Name of the queue.
    pub queue: String,
    /// Its URL.
    pub queue_url: String,
    /// URL of its dead-letter queue.
    pub dead_url: String,
    /// A table keyed `team_id`, `submission_id`.
    pub table: String,
    /// A table keyed `team-id`, `submission-id`.
    pub hyphen_table: String,
    /// Prefix of all keys, with the final slash.
    pub prefix: String,
    pub sqs: aws_sdk_sqs::Client,
    pub s3: aws_sdk_s3::Client,
    pub dynamodb: aws_sdk_dynamodb::Client,
}

/// A message in the dead-letter queue.
#[derive(Debug)]
pub struct Letter {
    pub body: String,
    /// Its attributes `reason`, `detail` and so on.
    pub attributes: BTreeMap<String, String>,
    /// When it was put there, in milliseconds since 1970.
    pub sent_ms: i64,
}

impl Cloud {
    /// Makes everything anew under `name`.
    pub async fn make(endpoint: &str, name: &str) -> Self {
        let aws = Aws::load("tests").await;
        let (region, url) = (Some(REGION), Some(endpoint));
        let mut cloud = Self {
            endpoint: endpoint.to_owned(),
            queue: name.to_owned(),
            queue_url: String::new(),
            dead_url: String::new(),
            table: name.to_owned(),
            hyphen_table: format!("{name}-hyphen"),
            prefix: format!("{name}/"),
            sqs: aws.sqs(region, url),
            s3: aws.s3(region, url),
            dynamodb: aws.dynamodb(region, url),
        };
        cloud.queue_url = cloud.make_queue(name).await;
        cloud.dead_url = cloud.make_queue(&format!("{name}-dead")).await;
        // Another test may have made it in the meantime.
        _ = cloud.s3.create_bucket().bucket(BUCKET).send().await;
        cloud.make_table(&cloud.table, ["team_id", "submission_id"]).await;
        cloud
            .make_table(&cloud.hyphen_table, ["team-id", "submission-id"])
            .await;
        cloud
    }

    async fn make_queue(&self, name: &str) -> String {
        let made = self.sqs.create_queue().queue_name(name);
        let made = made.attributes(QueueAttributeName::VisibilityTimeout, "30");
        made.send()
            .await
            .expect("the AWS stand-in makes no queue")
            .queue_url
            .unwrap()
    }

    async fn make_table(&self, name: &str, keys: [&str; 2]) {
        let mut request = self.dynamodb.create_table().table_name(name);
        for (key, kind) in keys.into_iter().zip([KeyType::Hash, KeyType::Range]) {
            let element = KeySchemaElement::builder().attribute_name(key).key_type(kind);
            let definition = AttributeDefinition::builder().attribute_name(key);
            request = request
                .key_schema(element.build().unwrap())
                .attribute_definitions(definition.attribute_type(ScalarAttributeType::S).build().unwrap());
        }
        request.billing_mode(BillingMode::PayPerRequest).send().await.unwrap();
    }

    /// Queues and tables go; what is in the bucket is a few kB and goes with the stand-in.
    pub async fn remove(&self) {
        for url in [&self.queue_url, &self.dead_url] {
            _ = self.sqs.delete_queue().queue_url(url).send().await;
        }
        for table in [&self.table, &self.hyphen_table] {
            _ = self.dynamodb.delete_table().table_name(table).send().await;
        }
    }

    /// How long a received message stays hidden.
    pub async fn set_visibility(&self, seconds: u32) {
        let request = self.sqs.set_queue_attributes().queue_url(&self.queue_url);
        let request = request.attributes(QueueAttributeName::VisibilityTimeout, seconds.to_string());
        request.send().await.unwrap();
    }

    /// Sends a message and hands back when, in milliseconds since 1970.
    pub async fn send(&self, body: &str) -> i64 {
        let sent = jiff::Timestamp::now().as_millisecond();
        self.sqs
            .send_message()
            .queue_url(&self.queue_url)
            .message_body(body)
            .send()
            .await
            .unwrap();
        sent
    }

    /// Messages in the queue: those that wait, and those that somebody has received.
    pub async fn messages(&self) -> [u32; 2] {
        self.depth(&self.queue_url).await
    }

    /// The depth of any queue: visible messages, and received ones.
    pub async fn depth(&self, url: &str) -> [u32; 2] {
        let request = self.sqs.get_queue_attributes().queue_url(url);
        let answer = request.attribute_names(QueueAttributeName::All).send().await.unwrap();
        let attributes = answer.attributes.unwrap_or_default();
        let names = [
            QueueAttributeName::ApproximateNumberOfMessages,
            QueueAttributeName::ApproximateNumberOfMessagesNotVisible,
        ];
        names.map(|name| attributes[&name].parse().unwrap())
    }

    /// Waits until the queue holds so many messages that wait and so many that were received.
    pub async fn await_messages(&self, wanted: [u32; 2], limit: Duration) {
        let end = Instant::now() + limit;
        loop {
            let found = self.messages().await;
            if found == wanted {
                return;
            }
            assert!(
                Instant::now() < end,
                "the queue holds {found:?} messages (waiting, received), not {wanted:?}"
            );
            sleep(ASK_EVERY).await;
        }
    }

    /// The next message of the dead-letter queue, which leaves it.
    pub async fn dead_letter(&self, limit: Duration) -> Letter {
        let end = Instant::now() + limit;
        while Instant::now() < end {
            let request = self
                .sqs
                .receive_message()
                .queue_url(&self.dead_url)
                .wait_time_seconds(5);
            let request = request.message_attribute_names("All").max_number_of_messages(1);
            let request = request.message_system_attribute_names(MessageSystemAttributeName::SentTimestamp);
            let answer = request.send().await.unwrap();
            if let Some(message) = answer.messages.unwrap_or_default().pop() {
                let receipt = message.receipt_handle.clone().unwrap();
                let delete = self
                    .sqs
                    .delete_message()
                    .queue_url(&self.dead_url)
                    .receipt_handle(receipt);
                delete.send().await.unwrap();
                return letter(message);
            }
        }
        panic!("no dead letter within {} s", limit.as_secs());
    }

    /// The keys of a run in S3, without its prefix, and their sizes.
    pub async fn keys(&self, run: &str) -> BTreeMap<String, i64> {
        let prefix = format!("{}{run}/", self.prefix);
        let answer = self
            .s3
            .list_objects_v2()
            .bucket(BUCKET)
            .prefix(&prefix)
            .send()
            .await
            .unwrap();
        let objects = answer.contents.unwrap_or_default().into_iter();
        let named = objects.map(|object| (object.key.unwrap_or_default(), object.size.unwrap_or_default()));
        named
            .map(|(key, size)| (key[prefix.len()..].to_owned(), size))
            .collect()
    }

    /// The text of an object of a run.
    pub async fn text(&self, run: &str, key: &str) -> String {
        let key = format!("{}{run}/{key}", self.prefix);
        let object = self.s3.get_object().bucket(BUCKET).key(&key).send().await;
        let object = object.unwrap_or_else(|error| panic!("{key} is not in S3: {error:?}"));
        String::from_utf8(object.body.collect().await.unwrap().to_vec()).unwrap()
    }

    /// The texts of all objects of a run, by their keys without its prefix.
    pub async fn texts(&self, run: &str) -> BTreeMap<String, String> {
        let mut texts = BTreeMap::new();
        for key in self.keys(run).await.into_keys() {
            let text = self.text(run, &key).await;
            texts.insert(key, text);
        }
        texts
    }

    /// The row of a submission.
    pub async fn row_of(&self, table: &str, submission: u64) -> BTreeMap<String, String> {
        let id = submission.to_string();
        let is_its = |row: &BTreeMap<String, String>| {
            let key = row.get("submission_id").or_else(|| row.get("submission-id"));
            key == Some(&id)
        };
        let rows: Vec<_> = self.rows(table).await.into_iter().filter(is_its).collect();
        let [row] = rows.as_slice() else {
            panic!("submission {id} has one row in {table}: {rows:?}")
        };
        row.clone()
    }

    /// All rows of a table, each as texts.
    pub async fn rows(&self, table: &str) -> Vec<BTreeMap<String, String>> {
        let answer = self
            .dynamodb
            .scan()
            .table_name(table)
            .consistent_read(true)
            .send()
            .await
            .unwrap();
        let text = |value: AttributeValue| match value {
            AttributeValue::S(text) | AttributeValue::N(text) => text,
            other => panic!("a column is neither a text nor a number: {other:?}"),
        };
        let rows = answer.items.unwrap_or_default().into_iter();
        rows.map(|row| row.into_iter().map(|(name, value)| (name, text(value))).collect())
            .collect()
    }

    /// The only row of a table.
    pub async fn row(&self, table: &str) -> BTreeMap<String, String> {
        let mut rows = self.rows(table).await;
        assert_eq!(rows.len(), 1, "one submission has one row: {rows:?}");
        rows.remove(0)
    }
}

fn letter(message: Message) -> Letter {
    let attributes = message.message_attributes.unwrap_or_default().into_iter();
    let system = message.attributes.unwrap_or_default();
    Letter {
        body: message.body.unwrap_or_default(),
        attributes: attributes
            .map(|(name, value)| (name, value.string_value.unwrap_or_default()))
            .collect(),
        sent_ms: system[&MessageSystemAttributeName::SentTimestamp].parse().unwrap(),
    }
}
