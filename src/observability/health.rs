//! The HTTP server for probes and metrics: `/livez`, `/readyz`, `/metrics`.
//!
//! Started by `main` before anything that may take long. Answers from the registries alone: no call to anything outside.

use std::net::SocketAddr;

use axum::Router;
use axum::extract::State;
use axum::http::StatusCode;
use axum::http::header::CONTENT_TYPE;
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use tokio::net::TcpListener;
use tokio::sync::oneshot;
use tokio::task::JoinHandle;

use super::Observability;
use crate::metrics;

/// Why there is no health server.
#[derive(Debug, thiserror::Error)]
pub enum HealthError {
    #[error("can't listen on {address} for probes and metrics: {source}; choose another address or end what uses it")]
    Bind {
        address: SocketAddr,
        source: std::io::Error,
    },
}

/// A running server; it ends when this is closed or dropped.
#[derive(Debug)]
pub struct HealthServer {
    address: SocketAddr,
    close: oneshot::Sender<()>,
    task: JoinHandle<Option<()>>,
}

impl HealthServer {
    /// Listens on an address; port 0 takes a free one. It serves on while the process stops, so that a probe gets an answer.
    ///
    /// # Errors
    /// If the address cannot be bound.
    pub async fn start(address: SocketAddr, telemetry: Observability) -> Result<Self, HealthError> {
        let bind = |source| HealthError::Bind { address, source };
        let listener = TcpListener::bind(address).await.map_err(bind)?;
        let address = listener.local_addr().map_err(bind)?;
        let (close, closed) = oneshot::channel();
        let tasks = telemetry.tasks.clone();
        let task = tasks.may_end("health server", async move {
            let served = axum::serve(listener, router(telemetry)).with_graceful_shutdown(async {
                // Closed and dropped are the same to the server.
                let _ = closed.await;
            });
            // It ends when it is closed, and by no error: one that can't accept a connection waits and continues.
            let _ = served.await;
        });
        tracing::info!(%address, "serving /livez, /readyz and /metrics");
        Ok(Self { address, close, task })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Takes no more requests and returns when those under way are answered.
    pub async fn close(self) {
        // A server that has panicked has been reported as a failed task.
        let _ = self.close.send(());
        let _ = self.task.await;
    }
}

/// The three pages.
pub fn router(telemetry: Observability) -> Router {
    Router::new()
        .route("/livez", get(livez))
        .route("/readyz", get(readyz))
        .route("/metrics", get(metrics_page))
        .with_state(telemetry)
}

async fn livez(State(telemetry): State<Observability>) -> Response {
    page(&telemetry.liveness.problems())
}

async fn readyz(State(telemetry): State<Observability>) -> Response {
    let mut missing = telemetry.readiness.missing();
    if telemetry.stop.is_set() {
        missing.insert(0, "running: the process is stopping".to_owned());
    }
    page(&missing)
}

async fn metrics_page(State(telemetry): State<Observability>) -> Response {
    match telemetry.metrics.text() {
        Ok(text) => ([(CONTENT_TYPE, metrics::CONTENT_TYPE)], text).into_response(),
        Err(error) => (
            StatusCode::INTERNAL_SERVER_ERROR,
            format!("a metric can't be written: {error}\n"),
        )
            .into_response(),
    }
}

fn page(problems: &[String]) -> Response {
    if problems.is_empty() {
        return "ok\n".into_response();
    }
    // As on the API server's own pages: of a 503 `kubectl get --raw` shows no text.
    (StatusCode::INTERNAL_SERVER_ERROR, problems.join("\n") + "\n").into_response()
}

#[cfg(test)]
mod tests {
    use super::*;
    use leaderboard_base::shutdown::Stop;
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    use tokio::net::TcpStream;

    async fn get(address: SocketAddr, path: &str) -> (u16, String) {
        let mut stream = TcpStream::connect(address).await.unwrap();
        let request = format!("GET {path} HTTP/1.1\r\nHost: probe\r\nConnection: close\r\n\r\n");
        stream.write_all(request.as_bytes()).await.unwrap();
        let mut answer = String::new();
        stream.read_to_string(&mut answer).await.unwrap();
        let code = answer.split(' ').nth(1).unwrap().parse().unwrap();
        (code, answer)
    }

    fn body(answer: &str) -> &str {
        answer.split_once("\r\n\r\n").unwrap().1
    }

    #[tokio::test]
    async fn readyz_names_what_is_missing_and_turns_when_the_process_stops() {
        let (sender, stop) = Stop::new();
        let telemetry = Observability::new(stop);
        let server = HealthServer::start(([127, 0, 0, 1], 0).into(), telemetry.clone())
            .await
            .unwrap();
        let (code, answer) = get(server.address(), "/readyz").await;
        assert_eq!(
            (code, body(&answer)),
            (500, "process: starting; not all checks are registered\n")
        );
        telemetry
            .readiness
            .set("submissions synced", Err("the list has not come yet".into()));
        telemetry.readiness.registered();
        let (code, answer) = get(server.address(), "/readyz").await;
        assert_eq!(
            (code, body(&answer)),
            (500, "submissions synced: the list has not come yet\n")
        );
        telemetry.readiness.set("submissions synced", Ok(()));
        let (code, answer) = get(server.address(), "/readyz").await;
        assert_eq!((code, body(&answer)), (200, "ok\n"));
        sender.send(true).unwrap();
        let (code, answer) = get(server.address(), "/readyz").await;
        assert_eq!((code, body(&answer)), (500, "running: the process is stopping\n"));
        let (code, _) = get(server.address(), "/livez").await;
        assert_eq!(code, 200, "a process that drains is not to be killed for it");
        server.close().await;
    }

    #[tokio::test]
    async fn a_fresh_process_is_alive_and_its_metrics_are_openmetrics() {
        let (_sender, stop) = Stop::new();
        let telemetry = Observability::new(stop);
        let server = HealthServer::start(([127, 0, 0, 1], 0).into(), telemetry.clone())
            .await
            .unwrap();
        let (code, answer) = get(server.address(), "/livez").await;
        assert_eq!((code, body(&answer)), (200, "ok\n"));
        let (code, answer) = get(server.address(), "/metrics").await;
        assert!(code == 200 && answer.contains(metrics::CONTENT_TYPE) && answer.contains("leaderboard_is_leader 0"));
        assert_eq!(get(server.address(), "/other").await.0, 404);
        server.close().await;
    }

    #[tokio::test]
    async fn a_taken_address_is_an_error_that_names_it() {
        let (_sender, stop) = Stop::new();
        let telemetry = Observability::new(stop);
        let server = HealthServer::start(([127, 0, 0, 1], 0).into(), telemetry.clone())
            .await
            .unwrap();
        let error = HealthServer::start(server.address(), telemetry)
            .await
            .unwrap_err()
            .to_string();
        assert!(error.contains(&server.address().to_string()), "{error}");
        server.close().await;
    }
}
