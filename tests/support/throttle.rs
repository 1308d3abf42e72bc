//! A proxy before the stand-in that plays an AWS with too many requests. It refuses as many requests as a test asks for, and hands on the
//! others.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use axum::body::Body;
use axum::extract::Request;
use http::{HeaderMap, Response, StatusCode, header};
use tokio::net::TcpListener;
use tokio::task::JoinHandle;

/// Largest request that is handed on.
const LARGEST: usize = 16 << 20;

/// The running proxy.
pub struct Throttle {
    endpoint: String,
    left: Arc<AtomicU32>,
    refused: Arc<AtomicU32>,
    task: JoinHandle<()>,
}

impl Throttle {
    /// Starts the proxy before `to`. Its refusals have the error `code`.
    pub async fn start(to: &str, code: &'static str) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let endpoint = format!("http://{}", listener.local_addr().unwrap());
        let (left, refused) = (Arc::new(AtomicU32::new(0)), Arc::new(AtomicU32::new(0)));
        let (to, counts) = (to.to_owned(), (Arc::clone(&left), Arc::clone(&refused)));
        // Another test may have done it already.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let http = reqwest::Client::builder().no_proxy().build().unwrap();
        let router = axum::Router::new().fallback(move |request: Request| {
            let (to, (left, refused), http) = (to.clone(), counts.clone(), http.clone());
            async move {
                let takes = |count: u32| count.checked_sub(1);
                if left.fetch_update(Ordering::SeqCst, Ordering::SeqCst, takes).is_ok() {
                    refused.fetch_add(1, Ordering::SeqCst);
                    return too_many(code);
                }
                hand_on(&http, &to, request).await
            }
        });
        let task = tokio::spawn(async move { axum::serve(listener, router).await.unwrap() });
        Self {
            endpoint,
            left,
            refused,
            task,
        }
    }

    /// `http://127.0.0.1:<port>`.
    pub fn endpoint(&self) -> &str {
        &self.endpoint
    }

    /// Refuses so many requests from now on.
    pub fn refuse(&self, requests: u32) {
        self.left.store(requests, Ordering::SeqCst);
    }

    /// How many requests it has refused.
    pub fn refused(&self) -> u32 {
        self.refused.load(Ordering::SeqCst)
    }
}

impl Drop for Throttle {
    fn drop(&mut self) {
        self.task.abort();
    }
}

fn too_many(code: &str) -> Response<Body> {
    let body = serde_json::json!({"__type": code, "message": "Rate exceeded"}).to_string();
    let answer = Response::builder().status(StatusCode::BAD_REQUEST);
    let answer = answer.header(header::CONTENT_TYPE, "application/x-amz-json-1.1");
    answer.body(Body::from(body)).unwrap()
}

/// Asks the server itself, and hands its answer back.
pub async fn hand_on(http: &reqwest::Client, to: &str, request: Request) -> Response<Body> {
    let (parts, body) = request.into_parts();
    let body = axum::body::to_bytes(body, LARGEST).await.unwrap();
    let url = format!("{to}{}", parts.uri);
    let headers: HeaderMap = parts
        .headers
        .into_iter()
        .filter_map(|(name, value)| Some((name?, value)))
        .collect();
    let mut request = http.request(parts.method, url).body(body);
    for (name, value) in &headers {
        if !matches!(*name, header::HOST | header::CONTENT_LENGTH) {
            request = request.header(name, value);
        }
    }
    let answer = request.send().await.unwrap();
    let mut handed = Response::builder().status(answer.status());
    for name in [header::CONTENT_TYPE, header::ETAG] {
        if let Some(value) = answer.headers().get(&name) {
            handed = handed.header(name, value);
        }
    }
    handed.body(Body::from(answer.bytes().await.unwrap())).unwrap()
}
