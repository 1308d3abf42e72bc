//! The page's files, its stream of events and one submission at a time, for a browser that came by its own address alone.
//!
//! A name that leads to 127.0.0.1 (DNS rebinding) is refused by its Host, and another site's script by `Sec-Fetch-Site`. Everything else
//! that a browser could do with the texts of strangers is forbidden by the policy of the content.

use std::convert::Infallible;
use std::sync::Arc;

use axum::Router;
use axum::body::Body;
use axum::extract::{Path, Request, State};
use axum::http::header::{self, HeaderName};
use axum::http::{HeaderMap, HeaderValue, StatusCode};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use axum::routing::{MethodRouter, get};
use futures::StreamExt;

use super::hub::{Hub, Source};
use leaderboard_base::shutdown::Stop;

/// Content policy: the browser loads and runs our own files alone, and no text becomes markup.
const POLICY: &str = include_str!("web/policy.txt");
/// The answer to a viewer without a place; the browser asks again after this time, in milliseconds.
const FULL: &str = "retry: 15000\nevent: full\ndata: {}\n\n";

const HTML: &str = "text/html; charset=utf-8";
const CSS: &str = "text/css; charset=utf-8";
const SCRIPT: &str = "text/javascript; charset=utf-8";
const SVG: &str = "image/svg+xml";
const JSON: &str = "application/json";

#[derive(Clone)]
struct Shown {
    hub: Hub,
    source: Arc<dyn Source>,
    stop: Stop,
}

pub(super) fn router(hub: Hub, source: Arc<dyn Source>, stop: Stop) -> Router {
    Router::new()
        .route("/", file(HTML, include_str!("web/index.html")))
        .route("/page.css", file(CSS, include_str!("web/page.css")))
        .route("/page.js", file(SCRIPT, include_str!("web/page.js")))
        .route("/sections.js", file(SCRIPT, include_str!("web/sections.js")))
        .route("/detail.js", file(SCRIPT, include_str!("web/detail.js")))
        .route("/timeline.js", file(SCRIPT, include_str!("web/timeline.js")))
        .route("/elements.js", file(SCRIPT, include_str!("web/elements.js")))
        .route("/icon.svg", file(SVG, include_str!("web/icon.svg")))
        .route("/events", get(events))
        .route("/submissions/{namespace}/{name}", get(detail))
        .layer(middleware::from_fn(guard))
        .with_state(Shown { hub, source, stop })
}

fn file(kind: &'static str, text: &'static str) -> MethodRouter<Shown> {
    get(move || async move { ([(header::CONTENT_TYPE, kind)], text) })
}

async fn events(State(Shown { hub, stop, .. }): State<Shown>) -> Response {
    let body = match hub.join() {
        Some(viewer) => Body::from_stream(viewer.events(stop).map(Ok::<_, Infallible>)),
        None => Body::from(FULL),
    };
    ([(header::CONTENT_TYPE, "text/event-stream")], body).into_response()
}

async fn detail(State(shown): State<Shown>, Path((namespace, name)): Path<(String, String)>) -> Response {
    match shown.source.detail(&namespace, &name) {
        Some(body) => ([(header::CONTENT_TYPE, JSON)], body).into_response(),
        None => (StatusCode::NOT_FOUND, "There is no submission of this name.\n").into_response(),
    }
}

/// Refuses what comes by another name or from another site, and gives every answer its headers.
async fn guard(request: Request, next: Next) -> Response {
    let mut response = match refusal(request.headers(), request.uri().path()) {
        Some(why) => (StatusCode::FORBIDDEN, why).into_response(),
        None => next.run(request).await,
    };
    for (name, value) in HEADERS {
        response.headers_mut().insert(name, HeaderValue::from_static(value));
    }
    if let Ok(policy) = HeaderValue::from_str(POLICY.trim()) {
        response.headers_mut().insert(header::CONTENT_SECURITY_POLICY, policy);
    }
    response
}

const HEADERS: [(HeaderName, &str); 6] = [
    (header::CACHE_CONTROL, "no-store"),
    (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
    (header::X_FRAME_OPTIONS, "DENY"),
    (header::REFERRER_POLICY, "no-referrer"),
    (HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
    (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
];

fn refusal(headers: &HeaderMap, path: &str) -> Option<&'static str> {
    if !host(headers).is_some_and(is_loopback) {
        return Some("This page is read at 127.0.0.1: open the address that `kubectl leaderboard dashboard` prints.\n");
    }
    let site = headers.get("sec-fetch-site").map(HeaderValue::as_bytes);
    // A link on another site may lead here, and its scripts may read nothing.
    let is_ours = matches!(site, None | Some(b"same-origin" | b"none")) || path == "/";
    (!is_ours).then_some("Another site may not read this page.\n")
}

/// The one Host; none if there are several.
fn host(headers: &HeaderMap) -> Option<&str> {
    let mut hosts = headers.get_all(header::HOST).iter();
    let host = hosts.next().filter(|_| hosts.next().is_none())?;
    host.to_str().ok()
}

/// True if a Host names this machine by a name that no other machine can have.
fn is_loopback(host: &str) -> bool {
    let name = match host.rsplit_once(':') {
        Some((name, port)) if port.bytes().all(|byte| byte.is_ascii_digit()) => name,
        _ => host,
    };
    ["127.0.0.1", "localhost", "[::1]"].contains(&name)
}

#[cfg(test)]
mod tests;
