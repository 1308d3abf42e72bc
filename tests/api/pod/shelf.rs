//! S3 in memory, as much of it as logcopy asks for: keeps the order of what is stored, and does not answer for chosen keys.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use axum::body::{Body, to_bytes};
use axum::extract::Request;
use axum::http::{Method, StatusCode};
use axum::response::{IntoResponse, Response};
use tokio::sync::watch;

/// An object in the store.
#[derive(Clone, Debug, Default)]
struct Stored {
    bytes: Vec<u8>,
    etag: String,
}

#[derive(Debug, Default)]
struct State {
    objects: BTreeMap<String, Stored>,
    /// Keys as they were stored, each time.
    order: Vec<String>,
    /// Keys whose uploads in parts were begun.
    begun: Vec<String>,
    /// Keys whose uploads were given up.
    aborted: Vec<String>,
    /// Keys for which no content arrives.
    lost: BTreeSet<String>,
    parts: usize,
}

/// One bucket.
#[derive(Clone, Debug, Default)]
pub(super) struct Shelf {
    state: Arc<watch::Sender<State>>,
}

impl Shelf {
    /// Serves it. Returns its endpoint, too.
    pub(super) async fn start() -> (Self, String) {
        let shelf = Self::default();
        let serving = shelf.clone();
        let router = axum::Router::new().fallback(move |request: Request| serving.clone().answer(request));
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let endpoint = format!("http://{}", listener.local_addr().unwrap());
        tokio::spawn(async move { axum::serve(listener, router).await });
        (shelf, endpoint)
    }

    /// Keeps each later write to this key from arriving.
    pub(super) fn lose(&self, key: &str) {
        self.state.send_modify(|state| {
            state.lost.insert(key.to_owned());
        });
    }

    /// Lets the writes to this key arrive.
    pub(super) fn find(&self, key: &str) {
        self.state.send_modify(|state| {
            state.lost.remove(key);
        });
    }

    /// The keys that were stored, in order; each as often as it was.
    pub(super) fn order(&self) -> Vec<String> {
        self.state.borrow().order.clone()
    }

    /// How often an upload in parts to the key was begun.
    pub(super) fn begun(&self, key: &str) -> usize {
        let state = self.state.borrow();
        state.begun.iter().filter(|begun| *begun == key).count()
    }

    /// How often an upload to the key was given up.
    pub(super) fn aborted(&self, key: &str) -> usize {
        let state = self.state.borrow();
        state.aborted.iter().filter(|aborted| *aborted == key).count()
    }

    /// Waits until this holds of it.
    pub(super) async fn until(&self, holds: impl Fn(&Self) -> bool) {
        let mut changes = self.state.subscribe();
        let changed = async {
            while !holds(self) {
                changes.changed().await.unwrap();
            }
        };
        tokio::time::timeout(super::PATIENCE, changed)
            .await
            .expect("it never holds");
    }

    async fn answer(self, request: Request) -> Response {
        let (head, body) = request.into_parts();
        let path = head.uri.path().trim_start_matches('/');
        // Below the bucket and the run's prefix.
        let key = path.split_once("/runs/77/").map_or("", |(_, key)| key).to_owned();
        let query = head.uri.query().unwrap_or_default().to_owned();
        let header = |name: &str| {
            let value = head.headers.get(name)?.to_str().ok()?;
            Some(value.trim_matches('"').to_owned())
        };
        if head.method == Method::PUT {
            let mut changes = self.state.subscribe();
            drop(changes.wait_for(|state| !state.lost.contains(&key)).await);
        }
        let body = to_bytes(body, usize::MAX).await.unwrap().to_vec();
        let if_none_match = header("if-none-match");
        let mut response = None;
        self.state.send_modify(|state| {
            response = Some(state.answer(&head.method, &key, &query, if_none_match.as_deref(), body));
        });
        response.unwrap()
    }
}

impl State {
    fn answer(&mut self, method: &Method, key: &str, query: &str, known: Option<&str>, body: Vec<u8>) -> Response {
        match *method {
            Method::GET if query.contains("list-type=2") => self.list(query),
            Method::GET => self.get(key, known),
            Method::PUT if query.contains("partNumber=") => {
                self.parts += 1;
                ([("etag", format!("\"part-{}\"", self.parts))], "").into_response()
            }
            Method::PUT => self.put(key, body),
            Method::POST if query.contains("uploads") => {
                self.begun.push(key.to_owned());
                "<InitiateMultipartUploadResult><UploadId>u</UploadId></InitiateMultipartUploadResult>".into_response()
            }
            Method::POST if query.contains("uploadId=") => {
                self.put(key, Vec::new());
                "<CompleteMultipartUploadResult><ETag>\"joined\"</ETag></CompleteMultipartUploadResult>".into_response()
            }
            Method::POST => "<DeleteResult/>".into_response(),
            Method::DELETE => {
                self.aborted.push(key.to_owned());
                StatusCode::NO_CONTENT.into_response()
            }
            _ => StatusCode::METHOD_NOT_ALLOWED.into_response(),
        }
    }

    fn put(&mut self, key: &str, bytes: Vec<u8>) -> Response {
        self.order.push(key.to_owned());
        let etag = format!("e{}", self.order.len());
        let tag = format!("\"{etag}\"");
        self.objects.insert(key.to_owned(), Stored { bytes, etag });
        ([("etag", tag)], "").into_response()
    }

    fn get(&self, key: &str, known: Option<&str>) -> Response {
        match self.objects.get(key) {
            None => (StatusCode::NOT_FOUND, "<Error><Code>NoSuchKey</Code></Error>").into_response(),
            Some(object) if known == Some(object.etag.as_str()) => StatusCode::NOT_MODIFIED.into_response(),
            Some(object) => {
                let tag = format!("\"{}\"", object.etag);
                ([("etag", tag)], Body::from(object.bytes.clone())).into_response()
            }
        }
    }

    fn list(&self, query: &str) -> Response {
        let prefix = query
            .split('&')
            .find_map(|pair| pair.strip_prefix("prefix="))
            .unwrap_or_default();
        let prefix = prefix.replace("%2F", "/");
        let prefix = prefix.strip_prefix("runs/77/").unwrap_or_default();
        let objects = self.objects.iter().filter(|(key, _)| key.starts_with(prefix));
        let contents: Vec<String> = objects
            .map(|(key, object)| {
                let (size, etag) = (object.bytes.len(), &object.etag);
                format!("<Contents><Key>runs/77/{key}</Key><Size>{size}</Size><ETag>\"{etag}\"</ETag></Contents>")
            })
            .collect();
        format!(
            "<ListBucketResult><IsTruncated>false</IsTruncated>{}</ListBucketResult>",
            contents.concat()
        )
        .into_response()
    }
}
