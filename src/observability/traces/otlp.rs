//! Sends spans to a collector by OTLP over HTTP, as the standard variables `OTEL_*` set.

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use opentelemetry::trace::{SpanContext, SpanId, SpanKind, Status, TraceFlags, TraceId, TraceState};
use opentelemetry::{InstrumentationScope, KeyValue};
use opentelemetry_otlp::{ExporterBuildError, Protocol, SpanExporter, WithExportConfig, WithHttpConfig};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::trace::{
    Config, SamplingDecision, ShouldSample, SpanData, SpanEvents, SpanExporter as _, SpanLinks,
};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinHandle;

use super::{Kind, Span, Traces, Value};
use crate::metrics::Metrics;
use crate::observability::Observability;
use leaderboard_api::names::OPERATOR;
use leaderboard_base::tasks::Tasks;

/// Spans that wait: those of some 200 submissions that end at once.
const QUEUE: usize = 2048;
/// Spans of one request.
const BATCH: usize = 512;
/// How long a batch is filled.
const FILL: Duration = Duration::from_secs(1);
/// How long the collector may take for a request.
const LIMIT: Duration = Duration::from_secs(10);
/// How long the last spans may take while the process stops.
const LAST: Duration = Duration::from_secs(3);
/// Either of these turns traces on.
const ENDPOINTS: [&str; 2] = ["OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT"];

/// Why no traces can be sent.
#[derive(Debug, thiserror::Error)]
pub enum TracesError {
    #[error("no HTTP client could be made for traces: {0}; check the machine's trusted certificates")]
    Client(String),
    #[error("the settings OTEL_* of traces can't be used: {0}; correct them, or remove OTEL_EXPORTER_OTLP_ENDPOINT")]
    Settings(#[from] ExporterBuildError),
}

/// The way into the queue.
#[derive(Clone, Debug)]
pub struct Outlet {
    queue: mpsc::Sender<Span>,
    metrics: Arc<Metrics>,
}

impl Outlet {
    pub(super) fn send(&self, spans: Vec<Span>) {
        for span in spans {
            if self.queue.try_send(span).is_err() {
                self.metrics.work.spans.of(["dropped"]).inc();
            }
        }
    }
}

/// The task that sends.
#[derive(Debug)]
pub struct Sending {
    close: oneshot::Sender<()>,
    task: JoinHandle<Option<()>>,
}

impl Sending {
    /// Sends what is left, within a limit of time.
    pub async fn finish(self) {
        // A task that has panicked has been reported as a failed one.
        let _ = self.close.send(());
        let _ = tokio::time::timeout(LAST, self.task).await;
    }
}

/// Sends from here on, where the environment names a collector.
///
/// # Errors
/// If the settings cannot be used.
pub fn begin(mut telemetry: Observability) -> Result<(Observability, Option<Sending>), TracesError> {
    if !is_wanted(|name| std::env::var(name).ok()) {
        return Ok((telemetry, None));
    }
    let (traces, sending) = start(None, &telemetry.metrics, &telemetry.tasks)?;
    telemetry.traces = traces;
    Ok((telemetry, Some(sending)))
}

/// True if the environment names a collector, and does not switch traces off.
fn is_wanted(variable: impl Fn(&str) -> Option<String>) -> bool {
    let is = |name: &str, value: &str| variable(name).is_some_and(|is| is.trim().eq_ignore_ascii_case(value));
    let has_endpoint = ENDPOINTS
        .iter()
        .any(|name| variable(name).is_some_and(|is| !is.trim().is_empty()));
    has_endpoint && !is("OTEL_SDK_DISABLED", "true") && !is("OTEL_TRACES_EXPORTER", "none")
}

/// Sends from here on. `endpoint` goes before that of the environment.
///
/// # Errors
/// If the settings cannot be used. A collector that is away is no error.
pub fn start(endpoint: Option<&str>, metrics: &Arc<Metrics>, tasks: &Tasks) -> Result<(Traces, Sending), TracesError> {
    let client = reqwest::Client::builder()
        .connect_timeout(LIMIT)
        .timeout(LIMIT)
        // The headers hold credentials, which are for this address alone.
        .redirect(reqwest::redirect::Policy::none())
        .build()
        .map_err(|error| TracesError::Client(leaderboard_api::text::chain(&error)))?;
    let builder = SpanExporter::builder()
        .with_http()
        .with_http_client(client)
        .with_protocol(Protocol::HttpBinary);
    let mut exporter = match endpoint {
        Some(endpoint) => builder.with_endpoint(endpoint).build()?,
        None => builder.build()?,
    };
    exporter.set_resource(&resource());
    let (queue, spans) = mpsc::channel(QUEUE);
    let (close, closed) = oneshot::channel();
    let sender = Sender {
        exporter,
        sampler: Config::default().sampler,
        scope: InstrumentationScope::builder(OPERATOR)
            .with_version(env!("CARGO_PKG_VERSION"))
            .build(),
        metrics: Arc::clone(metrics),
        fails: false,
    };
    let task = tasks.may_end("traces", sender.run(spans, closed));
    let outlet = Outlet {
        queue,
        metrics: Arc::clone(metrics),
    };
    Ok((Traces(Some(outlet)), Sending { close, task }))
}

/// The process as the environment describes it; its name is the operator's if the environment gives none.
fn resource() -> Resource {
    let given = Resource::builder().build();
    let name = given.get(&"service.name".into()).map(|name| name.to_string());
    let mut builder = Resource::builder();
    if name.is_none_or(|name| name.starts_with("unknown_service")) {
        builder = builder.with_service_name(OPERATOR);
    }
    builder
        .with_attribute(KeyValue::new("service.version", env!("CARGO_PKG_VERSION")))
        .build()
}

struct Sender {
    exporter: SpanExporter,
    sampler: Box<dyn ShouldSample>,
    scope: InstrumentationScope,
    metrics: Arc<Metrics>,
    /// The last request has failed.
    fails: bool,
}

impl Sender {
    async fn run(mut self, mut spans: mpsc::Receiver<Span>, mut closed: oneshot::Receiver<()>) {
        let mut is_open = true;
        let mut batch = Vec::with_capacity(BATCH);
        while is_open {
            tokio::select! {
                biased;
                _ = &mut closed => is_open = false,
                found = spans.recv_many(&mut batch, BATCH) => if found == 0 { return },
            }
            if is_open {
                tokio::select! {
                    biased;
                    _ = &mut closed => is_open = false,
                    () = tokio::time::sleep(FILL) => {}
                }
            }
            while let Ok(span) = spans.try_recv() {
                if batch.len() == BATCH {
                    self.export(&mut batch).await;
                }
                batch.push(span);
            }
            self.export(&mut batch).await;
        }
    }

    async fn export(&mut self, batch: &mut Vec<Span>) {
        let sampled = batch.drain(..).map(|span| data(span, &self.scope));
        let sampled: Vec<SpanData> = sampled.filter(|span| self.is_sampled(span)).collect();
        let count = u64::try_from(sampled.len()).unwrap_or(u64::MAX);
        if count == 0 {
            return;
        }
        let failure = self.exporter.export(sampled).await.err();
        let outcome = if failure.is_some() { "failed" } else { "sent" };
        self.metrics.work.spans.of([outcome]).inc_by(count);
        match &failure {
            Some(error) if !self.fails => tracing::warn!(%error, "the collector of traces does not take spans"),
            None if self.fails => tracing::info!("the collector of traces takes spans again"),
            _ => {}
        }
        self.fails = failure.is_some();
    }

    /// By the trace alone, so that a trace is whole or absent.
    fn is_sampled(&self, span: &SpanData) -> bool {
        let trace = span.span_context.trace_id();
        let found = self
            .sampler
            .should_sample(None, trace, &span.name, &span.span_kind, &span.attributes, &[]);
        found.decision == SamplingDecision::RecordAndSample
    }
}

fn data(span: Span, scope: &InstrumentationScope) -> SpanData {
    let id = |number: u64| SpanId::from(number);
    let trace = TraceId::from(span.trace.number());
    let attributes = span.attributes.into_iter().map(|(key, value)| match value {
        Value::Text(text) => KeyValue::new(key, text),
        Value::Word(word) => KeyValue::new(key, word),
        Value::Number(number) => KeyValue::new(key, number),
    });
    SpanData {
        span_context: SpanContext::new(trace, id(span.id), TraceFlags::SAMPLED, false, TraceState::default()),
        parent_span_id: span.parent.map_or(SpanId::INVALID, id),
        parent_span_is_remote: false,
        span_kind: match span.kind {
            Kind::Internal => SpanKind::Internal,
            Kind::Consumer => SpanKind::Consumer,
            Kind::Client => SpanKind::Client,
        },
        name: span.name.into(),
        start_time: SystemTime::from(span.start),
        end_time: SystemTime::from(span.end),
        attributes: attributes.collect(),
        dropped_attributes_count: 0,
        events: SpanEvents::default(),
        links: SpanLinks::default(),
        status: span.error.map_or(Status::Unset, Status::error),
        instrumentation_scope: scope.clone(),
    }
}

#[cfg(test)]
mod tests;
