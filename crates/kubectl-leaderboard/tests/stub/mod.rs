//! An API server on a loopback port whose answers are given: nothing is stored.

pub mod cluster;

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::PathBuf;
use std::thread;

use serde_json::{Value, json};

/// Answers a method and a path with its query with a status code and a text.
pub type Answers = fn(&str, &str) -> (u16, String);

/// The server, and the kubeconfig of a person who uses it.
pub struct Stub {
    pub address: String,
    pub kubeconfig: PathBuf,
}

impl Stub {
    pub fn start(answers: Answers) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = format!("http://{}", listener.local_addr().unwrap());
        thread::spawn(move || {
            for stream in listener.incoming().flatten() {
                thread::spawn(move || serve(&stream, answers));
            }
        });
        Self::at(address)
    }

    /// A kubeconfig for whatever is at this address.
    pub fn at(address: String) -> Self {
        let config = json!({
            "apiVersion": "v1", "kind": "Config", "current-context": "stub",
            "clusters": [{"name": "stub", "cluster": {"server": address}}], "users": [{"name": "host", "user": {}}],
            "contexts": [{"name": "stub", "context": {"cluster": "stub", "user": "host", "namespace": "carla"}}],
        });
        let port = address.rsplit(':').next().unwrap();
        let name = format!("leaderboard-stub-{}-{port}", std::process::id());
        let kubeconfig = std::env::temp_dir().join(name);
        std::fs::write(&kubeconfig, config.to_string()).unwrap();
        Self { address, kubeconfig }
    }
}

impl Drop for Stub {
    fn drop(&mut self) {
        // The test is over, so the file has no reader any more.
        let _ = std::fs::remove_file(&self.kubeconfig);
    }
}

/// Answers the requests of a connection until its end.
fn serve(mut stream: &TcpStream, answers: Answers) -> Option<()> {
    let mut reader = BufReader::new(stream);
    loop {
        let mut request = String::new();
        reader.read_line(&mut request).ok().filter(|read| *read > 0)?;
        let mut length = 0;
        loop {
            let mut header = String::new();
            reader.read_line(&mut header).ok()?;
            let header = header.trim().to_ascii_lowercase();
            if header.is_empty() {
                break;
            }
            if let Some(value) = header.strip_prefix("content-length:") {
                length = value.trim().parse().ok()?;
            }
        }
        reader.by_ref().take(length).read_to_end(&mut Vec::new()).ok()?;
        let mut words = request.split_whitespace();
        let (code, text) = answers(words.next()?, words.next()?);
        let head = format!(
            "HTTP/1.1 {code} -\r\ncontent-type: application/json\r\ncontent-length: {}\r\n\r\n",
            text.len()
        );
        stream.write_all(format!("{head}{text}").as_bytes()).ok()?;
    }
}

/// Objects as a list.
pub fn list(kind: &str, items: &[Value]) -> (u16, String) {
    let version = if kind == "Pod" {
        "v1"
    } else {
        "leaderboard.carla.org/v1alpha1"
    };
    let list = json!({"apiVersion": version, "kind": format!("{kind}List"), "metadata": {}, "items": items});
    (200, list.to_string())
}

/// A refusal.
pub fn refusal(code: u16, reason: &str, message: &str) -> (u16, String) {
    let status = json!({"apiVersion": "v1", "kind": "Status", "metadata": {}, "status": "Failure", "code": code, "reason": reason,
                        "message": message});
    (code, status.to_string())
}
