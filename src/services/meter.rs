//! Counts what is asked of the services around the cluster: which service, what, with which outcome, how long it took.
//!
//! Every client here reports its calls to one; what becomes of them is up to the process. All labels are fixed, so that neither a secret
//! nor the name of an object can get into a metric.

use std::fmt;
use std::future::Future;
use std::sync::Arc;
use std::time::{Duration, Instant};

use aws_sdk_sqs::config::http::HttpResponse;
use aws_sdk_sqs::error::{ProvideErrorMetadata, SdkError};

use super::fault;
use crate::observability::metrics::Metrics;

/// A call that is over.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Call {
    /// `evalai`, `s3`, `dynamodb` and so on.
    pub service: &'static str,
    /// What was asked, as the service calls it.
    pub op: &'static str,
    /// `ok`, the kind of a failure, or `abandoned`.
    pub outcome: &'static str,
    /// From the first byte sent, retries included.
    pub took: Duration,
}

type Listener = dyn Fn(&Call) + Send + Sync;

/// A listener to calls. Clones have the same one; the default has none.
#[derive(Clone, Default)]
pub struct Meter(Option<Arc<Listener>>);

impl fmt::Debug for Meter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if self.0.is_some() { "Meter(…)" } else { "Meter" })
    }
}

impl Meter {
    /// Reports every call to `listener`.
    pub fn new(listener: impl Fn(&Call) + Send + Sync + 'static) -> Self {
        Self(Some(Arc::new(listener)))
    }

    /// Counts every call in the metrics of the process.
    pub fn for_metrics(metrics: &Arc<Metrics>) -> Self {
        let metrics = Arc::clone(metrics);
        Self::new(
            move |Call {
                      service,
                      op,
                      outcome,
                      took,
                  }| {
                let (evalai, shared) = (&metrics.evalai, &metrics.shared);
                if *service == "evalai" {
                    evalai.requests.of([*op, outcome]).inc();
                    evalai.duration.of([*op]).observe(took.as_secs_f64());
                } else {
                    shared.cloud_calls.of([*service, op, outcome]).inc();
                    shared
                        .cloud_call_duration
                        .of([*service, op])
                        .observe(took.as_secs_f64());
                }
            },
        )
    }

    /// A call begins. One that is dropped without an end, by a limit of time or a stop, was abandoned.
    pub fn begin(&self, service: &'static str, op: &'static str) -> Running {
        Running {
            meter: self.clone(),
            service,
            op,
            outcome: "abandoned",
            began: Instant::now(),
        }
    }

    /// Counts a call of AWS.
    pub fn aws<T, E>(
        &self,
        service: &'static str,
        op: &'static str,
        call: impl Future<Output = Result<T, SdkError<E, HttpResponse>>> + Send,
    ) -> impl Future<Output = Result<T, SdkError<E, HttpResponse>>> + Send
    where
        E: ProvideErrorMetadata + std::error::Error + 'static,
    {
        let running = self.begin(service, op);
        // The SDK's futures are large, and every caller would be as large as what it counts.
        let call = Box::pin(call);
        async move {
            let answer = call.await;
            running.end(answer.as_ref().map_or_else(outcome, |_| "ok"));
            answer
        }
    }
}

fn outcome<E>(error: &SdkError<E, HttpResponse>) -> &'static str
where
    E: ProvideErrorMetadata + std::error::Error + 'static,
{
    // Two answers of S3 that are no failures.
    match error.raw_response().map(|response| response.status().as_u16()) {
        Some(304) => "unchanged",
        Some(404) => "missing",
        _ => fault::of(error).as_str(),
    }
}

/// A call under way.
#[must_use]
pub struct Running {
    meter: Meter,
    service: &'static str,
    op: &'static str,
    outcome: &'static str,
    began: Instant,
}

impl Running {
    /// It is over.
    pub fn end(mut self, outcome: &'static str) {
        self.outcome = outcome;
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let Some(listener) = &self.meter.0 else { return };
        listener(&Call {
            service: self.service,
            op: self.op,
            outcome: self.outcome,
            took: self.began.elapsed(),
        });
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use super::*;

    #[test]
    fn every_call_is_reported_once_also_one_that_was_abandoned() {
        let reported = Arc::new(Mutex::new(Vec::new()));
        let listener = Arc::clone(&reported);
        let meter = Meter::new(move |call| listener.lock().unwrap().push((call.service, call.op, call.outcome)));
        meter.begin("s3", "GetObject").end("ok");
        drop(meter.clone().begin("evalai", "get_submission"));
        Meter::default().begin("s3", "GetObject").end("ok");
        let all = [("s3", "GetObject", "ok"), ("evalai", "get_submission", "abandoned")];
        assert_eq!(*reported.lock().unwrap(), all);
    }
}
