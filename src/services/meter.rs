//! Counts what is asked of the services around the cluster: which service, what, with which outcome, how long it took.
//!
//! Every client here reports its calls to one. All labels are fixed, so that neither a secret nor the name of an object can get into a
//! metric.

use std::future::Future;
use std::sync::Arc;
use std::time::Instant;

use aws_sdk_sqs::config::http::HttpResponse;
use aws_sdk_sqs::error::{ProvideErrorMetadata, SdkError};

use super::fault;
use crate::observability::metrics::Metrics;

/// The metrics that calls are counted in. Clones have the same; the default has none.
#[derive(Clone, Debug, Default)]
pub struct Meter(Option<Arc<Metrics>>);

impl Meter {
    /// Counts every call in the metrics of the process.
    pub fn for_metrics(metrics: &Arc<Metrics>) -> Self {
        Self(Some(Arc::clone(metrics)))
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
        let Some(metrics) = &self.meter.0 else { return };
        let (service, op, took) = (self.service, self.op, self.began.elapsed().as_secs_f64());
        if service == "evalai" {
            metrics.evalai.requests.of([op, self.outcome]).inc();
            metrics.evalai.duration.of([op]).observe(took);
        } else {
            metrics.shared.cloud_calls.of([service, op, self.outcome]).inc();
            metrics.shared.cloud_call_duration.of([service, op]).observe(took);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::observability::metrics::Program;

    #[test]
    fn every_call_is_counted_once_also_one_that_was_abandoned() {
        let metrics = Arc::new(Metrics::new(Program::Controller));
        let meter = Meter::for_metrics(&metrics);
        meter.begin("s3", "GetObject").end("ok");
        drop(meter.clone().begin("evalai", "get_submission"));
        Meter::default().begin("s3", "GetObject").end("ok");
        let text = metrics.text().unwrap();
        for line in [
            "leaderboard_cloud_calls_total{service=\"s3\",op=\"GetObject\",outcome=\"ok\"} 1",
            "leaderboard_evalai_requests_total{op=\"get_submission\",outcome=\"abandoned\"} 1",
        ] {
            assert!(text.lines().any(|found| found == line), "{line} is missing in\n{text}");
        }
    }
}
