//! How old what lies in a queue is. The bridge shows it of queues in SQS, the controller's leader of those in EvalAI.

use prometheus_client::metrics::family::Family;
use prometheus_client::registry::Registry;

use super::labels::OfQueue;
use super::{FloatGauge, Metrics, zero};

#[derive(Debug)]
pub(super) struct Queues {
    oldest: Family<OfQueue, FloatGauge>,
}

impl Queues {
    pub(super) fn new(r: &mut Registry) -> Self {
        Self {
            oldest: zero(
                r,
                "queue_oldest_message_timestamp_seconds",
                "Unix time at which the oldest message was sent that was received and is not deleted; absent without one. `queue` is the URL of a queue in SQS, or the name of one in EvalAI, where a message is as old as its row's last request to be run",
            ),
        }
    }

    pub(super) fn leave_to_the_leader(&self) {
        self.oldest.clear();
    }
}

impl Metrics {
    /// When the oldest message of a queue was sent that was received and not deleted, in milliseconds since 1970; None without one.
    pub fn set_oldest_message(&self, queue: &str, sent_ms: Option<i64>) {
        let of = OfQueue {
            queue: queue.to_owned(),
        };
        match sent_ms {
            Some(sent) => {
                #[expect(clippy::cast_precision_loss, reason = "milliseconds since 1970 fit")]
                let seconds = sent as f64 / 1000.0;
                self.queues.oldest.get_or_create(&of).set(seconds);
            }
            None => {
                self.queues.oldest.remove(&of);
            }
        }
    }
}
