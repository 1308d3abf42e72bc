//! Registries that serve no image: one that refuses everybody, one that never answers. And an image for other machines only.
//!
//! They listen on loopback, where containerd speaks plain HTTP of itself: the node is this machine.

use std::net::SocketAddr;

use serde_json::{Value, json};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinSet;

use super::scene::Lab;

const MANIFEST: &str = "application/vnd.oci.image.manifest.v1+json";
const INDEX: &str = "application/vnd.oci.image.index.v1+json";
const UNAUTHORIZED: &[u8] = b"HTTP/1.1 401 Unauthorized\r\nContent-Length: 0\r\nConnection: close\r\n\r\n";

/// A running registry; it ends when this is dropped.
pub struct Registry {
    address: SocketAddr,
    _task: JoinSet<()>,
}

impl Registry {
    /// A registry that asks for credentials that no client has.
    pub async fn that_refuses() -> Self {
        Self::start(true).await
    }

    /// One that takes connections and never answers.
    pub async fn that_is_silent() -> Self {
        Self::start(false).await
    }

    async fn start(answers: bool) -> Self {
        let listener = TcpListener::bind(("127.0.0.1", 0)).await.unwrap();
        let address = listener.local_addr().unwrap();
        let mut task = JoinSet::new();
        task.spawn(async move {
            let mut clients = JoinSet::new();
            while let Ok((client, _)) = listener.accept().await {
                clients.spawn(serve(client, answers));
            }
        });
        Self { address, _task: task }
    }

    /// An image that it could have.
    pub fn image(&self) -> String {
        format!("{}/private/agent:1", self.address)
    }
}

async fn serve(mut client: TcpStream, answers: bool) {
    let mut bytes = [0; 4096];
    while let Ok(1..) = client.read(&mut bytes).await {
        if answers {
            _ = client.write_all(UNAUTHORIZED).await;
            return;
        }
    }
}

/// Pushes an image that is marked as for another kind of machine only; hands back its tag's name.
pub async fn image_for_other_machines(lab: &Lab) -> String {
    let url = |tag: &str| format!("http://{}/v2/challenge/agent/manifests/{tag}", lab.registry);
    let http = reqwest::Client::builder().no_proxy().build().unwrap();
    let request = http.get(url("standard")).header("Accept", MANIFEST);
    let answer = request.send().await.unwrap().error_for_status().unwrap();
    let digest = answer.headers()["docker-content-digest"].to_str().unwrap().to_owned();
    let size = answer.bytes().await.unwrap().len();
    let index: Value = json!({
        "schemaVersion": 2,
        "mediaType": INDEX,
        "manifests": [{
            "mediaType": MANIFEST,
            "digest": digest,
            "size": size,
            "platform": {"architecture": "s390x", "os": "linux"},
        }],
    });
    let request = http.put(url("other-machines")).header("Content-Type", INDEX);
    request
        .body(index.to_string())
        .send()
        .await
        .unwrap()
        .error_for_status()
        .unwrap();
    "agent:other-machines".to_owned()
}
