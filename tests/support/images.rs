//! A registry on loopback that holds what a test puts there, and remembers what it was asked.

use std::collections::HashMap;
use std::fmt::Write;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};

use axum::Router;
use axum::extract::{Request, State};
use axum::http::StatusCode;
use axum::http::header::{AUTHORIZATION, LOCATION, WWW_AUTHENTICATE};
use axum::response::{IntoResponse, Response};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use tokio::net::TcpListener;
use tokio::task::JoinSet;

/// What a path is answered with.
#[derive(Clone)]
enum Content {
    Bytes(Vec<u8>),
    Redirect(String),
    Status(u16),
}

#[derive(Default)]
struct Stored {
    content: HashMap<String, Content>,
    /// The header with which it asks for credentials, and the one that it takes.
    guard: Option<(String, String)>,
    seen: Vec<(String, Option<String>)>,
}

/// A running registry; it ends when this is dropped.
pub struct ImageRegistry {
    address: SocketAddr,
    stored: Arc<Mutex<Stored>>,
    _task: JoinSet<()>,
}

impl ImageRegistry {
    pub async fn start() -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let stored = Arc::new(Mutex::new(Stored::default()));
        let router = Router::new().fallback(answer).with_state(Arc::clone(&stored));
        let mut task = JoinSet::new();
        task.spawn(async move {
            axum::serve(listener, router).await.unwrap();
        });
        Self {
            address,
            stored,
            _task: task,
        }
    }

    /// Its host and port.
    pub fn host(&self) -> String {
        self.address.to_string()
    }

    /// Answers this path below `/v2/team/` with these bytes; hands their digest back.
    pub fn put(&self, path: &str, bytes: Vec<u8>) -> String {
        let digest = digest(&bytes);
        self.insert(path, Content::Bytes(bytes));
        digest
    }

    /// A document under its own digest.
    pub fn store(&self, kind: &str, document: &Value) -> Value {
        let bytes = document.to_string().into_bytes();
        let (size, digest) = (bytes.len(), digest(&bytes));
        self.put(&format!("{kind}/{digest}"), bytes);
        json!({"mediaType": "x", "digest": digest, "size": size})
    }

    /// An image with this config and a layer of this size, under a tag; hands the digest of its manifest back.
    pub fn push(&self, tag: &str, config: &Value, layer: u64) -> String {
        let manifest = self.manifest(config, layer);
        self.put(&format!("manifests/{tag}"), manifest.to_string().into_bytes())
    }

    pub fn manifest(&self, config: &Value, layer: u64) -> Value {
        let layer = json!({"mediaType": "x", "digest": digest(b"layer"), "size": layer});
        json!({"schemaVersion": 2, "config": self.store("blobs", config), "layers": [layer]})
    }

    pub fn redirect(&self, path: &str, to: &str) {
        self.insert(path, Content::Redirect(to.into()));
    }

    pub fn fail(&self, path: &str, status: u16) {
        self.insert(path, Content::Status(status));
    }

    /// Asks with this header for credentials, and takes this one.
    pub fn guard(&self, challenge: &str, taken: &str) {
        self.stored.lock().unwrap().guard = Some((challenge.into(), taken.into()));
    }

    /// Paths that were asked for, and the credentials that came with them.
    pub fn seen(&self) -> Vec<(String, Option<String>)> {
        self.stored.lock().unwrap().seen.clone()
    }

    fn insert(&self, path: &str, content: Content) {
        let mut stored = self.stored.lock().unwrap();
        stored.content.insert(format!("/v2/team/{path}"), content);
    }
}

/// What runs on our machines.
pub fn config() -> Value {
    json!({"os": "linux", "architecture": "amd64", "config": {}})
}

pub fn digest(bytes: &[u8]) -> String {
    let mut digest = String::from("sha256:");
    for byte in Sha256::digest(bytes) {
        write!(digest, "{byte:02x}").unwrap();
    }
    digest
}

async fn answer(State(stored): State<Arc<Mutex<Stored>>>, request: Request) -> Response {
    let mut stored = stored.lock().unwrap();
    let path = request.uri().path().to_owned();
    let given = request.headers().get(AUTHORIZATION);
    let given = given.map(|value| value.to_str().unwrap().to_owned());
    stored.seen.push((request.uri().to_string(), given.clone()));
    if path == "/token" {
        return json!({"token": "one-token"}).to_string().into_response();
    }
    if let Some((challenge, taken)) = &stored.guard
        && given.as_ref() != Some(taken)
    {
        return (StatusCode::UNAUTHORIZED, [(WWW_AUTHENTICATE, challenge.clone())]).into_response();
    }
    match stored.content.get(&path) {
        Some(Content::Bytes(bytes)) => bytes.clone().into_response(),
        Some(Content::Redirect(to)) => (StatusCode::TEMPORARY_REDIRECT, [(LOCATION, to.clone())]).into_response(),
        Some(Content::Status(status)) => StatusCode::from_u16(*status).unwrap().into_response(),
        None => StatusCode::NOT_FOUND.into_response(),
    }
}
