//! Counts a call of AWS with its outcome.

use std::future::Future;

use aws_sdk_sqs::config::http::HttpResponse;
use aws_sdk_sqs::error::{ProvideErrorMetadata, SdkError};

use super::fault;
use leaderboard_base::meter::Meter;

/// Clients of AWS whose calls a [`Meter`] counts.
pub trait Metered {
    /// Counts a call of AWS.
    fn aws<T, E>(
        &self,
        service: &'static str,
        op: &'static str,
        call: impl Future<Output = Result<T, SdkError<E, HttpResponse>>> + Send,
    ) -> impl Future<Output = Result<T, SdkError<E, HttpResponse>>> + Send
    where
        E: ProvideErrorMetadata + std::error::Error + 'static;
}

impl Metered for Meter {
    fn aws<T, E>(
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
