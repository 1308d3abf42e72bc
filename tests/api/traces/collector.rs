//! A real OpenTelemetry Collector on loopback, whose exporter prints what it has received.

use std::time::Duration;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use opentelemetry_proto::tonic::collector::trace::v1::ExportTraceServiceRequest;
use opentelemetry_proto::tonic::resource::v1::Resource;
use opentelemetry_proto::tonic::trace::v1::Span;
use prost::Message;
use serde_json::json;
use tokio::io::{AsyncBufReadExt, BufReader, Lines};
use tokio::process::{Child, ChildStdout};
use tokio::time::timeout;

use crate::support::tools;

/// Longer than a batch is filled.
const LIMIT: Duration = Duration::from_mins(1);

pub(super) struct Collector {
    /// Where it takes traces.
    pub(super) url: String,
    batches: Lines<BufReader<ChildStdout>>,
    spans: Vec<Span>,
    pub(super) resources: Vec<Resource>,
    _child: Child,
}

impl Collector {
    pub(super) async fn start() -> Self {
        let settings = json!({
            "receivers": {"otlp": {"protocols": {"http": {"endpoint": "127.0.0.1:0"}}}},
            "exporters": {"lines": {}},
            "service": {
                "pipelines": {"traces": {"receivers": ["otlp"], "exporters": ["lines"]}},
                "telemetry": {"metrics": {"level": "none"}},
            },
        });
        let program = tools::program("otelcol").await;
        let arguments = [format!("--config=yaml:{settings}")];
        let (mut child, address) = tools::start(&program, &arguments, "Starting HTTP server").await;
        Self {
            url: format!("http://{address}/v1/traces"),
            batches: BufReader::new(child.stdout.take().unwrap()).lines(),
            spans: Vec::new(),
            resources: Vec::new(),
            _child: child,
        }
    }

    /// Once it has a span of each name.
    pub(super) async fn with(&mut self, names: &[&str]) -> Vec<Span> {
        let is_in = |spans: &[Span], name: &str| spans.iter().any(|span| span.name == name);
        while !names.iter().all(|name| is_in(&self.spans, name)) {
            let line = timeout(LIMIT, self.batches.next_line()).await;
            let Ok(Ok(Some(line))) = line else {
                panic!("not all of {names:?}: {:?}, {line:?}", self.spans);
            };
            let batch = ExportTraceServiceRequest::decode(&*STANDARD.decode(line).unwrap()).unwrap();
            for of in batch.resource_spans {
                self.resources.extend(of.resource);
                self.spans
                    .extend(of.scope_spans.into_iter().flat_map(|scope| scope.spans));
            }
        }
        self.spans.clone()
    }
}
