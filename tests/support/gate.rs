//! A gate between the operator and a server that a test can shut. S3 or the API server is away, SQS takes no deletion, or DynamoDB gives
//! no right to write.
//!
//! Bytes pass through it unread, but for the search for a word. It knows one answer of HTTP.

use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt, copy, sink};
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::timeout;

/// The traffic that passes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Mode {
    Open,
    /// Connections are taken and nothing is answered.
    Shut,
    /// Connections break on which the client sends this word.
    Without(&'static str),
    /// Requests that hold this word are refused, as AWS refuses who has no right to them.
    Denied(&'static str),
}

/// AWS's answer to a client without the right.
const NO_RIGHT: &str =
    r#"{"__type":"com.amazon.coral.service#AccessDeniedException","Message":"not authorized to perform this action"}"#;

/// A running gate; it ends when this is dropped.
pub struct Gate {
    /// Its address for clients.
    pub url: String,
    mode: watch::Sender<Mode>,
    kept_back: watch::Receiver<u32>,
    _task: JoinSet<()>,
}

impl Gate {
    /// Opens a gate at a free port of `host` to a server such as `http://10.0.0.1:4566`. TLS goes through it as it is.
    pub async fn open(host: &str, server: &str) -> Self {
        let listener = TcpListener::bind((host, 0)).await.unwrap();
        let url = format!("http://{}", listener.local_addr().unwrap());
        let (mode, seen) = watch::channel(Mode::Open);
        let (count, kept_back) = watch::channel(0);
        let server = server.split_once("://").map_or(server, |(_, server)| server).to_owned();
        let mut task = JoinSet::new();
        task.spawn(accept(listener, server, seen, count));
        Self {
            url,
            mode,
            kept_back,
            _task: task,
        }
    }

    /// Nothing passes any more, in either direction.
    pub fn shut(&self) {
        self.mode.send_replace(Mode::Shut);
    }

    /// Requests that hold this word never arrive.
    pub fn keep_back(&self, word: &'static str) {
        self.mode.send_replace(Mode::Without(word));
    }

    /// Requests that hold this word are answered that there is no right to them.
    pub fn deny(&self, word: &'static str) {
        self.mode.send_replace(Mode::Denied(word));
    }

    /// Everything passes again.
    pub fn reopen(&self) {
        self.mode.send_replace(Mode::Open);
    }

    /// Waits until so many more requests were kept back.
    pub async fn await_kept_back(&self, count: u32, limit: Duration) {
        let mut kept_back = self.kept_back.clone();
        let before = *kept_back.borrow();
        let reached = timeout(limit, kept_back.wait_for(|kept| *kept >= before + count)).await;
        assert!(
            reached.is_ok(),
            "only {} requests were kept back",
            *self.kept_back.borrow() - before
        );
    }
}

async fn accept(listener: TcpListener, server: String, mode: watch::Receiver<Mode>, kept_back: watch::Sender<u32>) {
    let mut connections = JoinSet::new();
    loop {
        tokio::select! {
            accepted = listener.accept() => {
                let Ok((client, _)) = accepted else { continue };
                connections.spawn(pass(client, server.clone(), mode.clone(), kept_back.clone()));
            }
            Some(_) = connections.join_next() => {}
        }
    }
}

async fn pass(client: TcpStream, server: String, mut mode: watch::Receiver<Mode>, kept_back: watch::Sender<u32>) {
    let words = mode.clone();
    let through = async {
        let Ok(server) = TcpStream::connect(server).await else {
            return;
        };
        let ((mut from_client, mut to_client), (mut from_server, to_server)) =
            (client.into_split(), server.into_split());
        let denied = tokio::select! {
            denied = forward(&mut from_client, to_server, &words, &kept_back) => denied,
            _ = copy(&mut from_server, &mut to_client) => false,
        };
        if denied {
            refuse(from_client, to_client).await;
        }
    };
    tokio::select! {
        () = through => {}
        // A connection under way hangs until the gate opens, and is then broken off.
        () = async { _ = mode.wait_for(|mode| *mode == Mode::Shut).await; } => {
            _ = mode.wait_for(|mode| *mode != Mode::Shut).await;
        }
    }
}

/// Until the connection ends, or has to: whether the client is still owed the answer that it has no right.
async fn forward(
    from: &mut OwnedReadHalf,
    mut to: OwnedWriteHalf,
    mode: &watch::Receiver<Mode>,
    kept_back: &watch::Sender<u32>,
) -> bool {
    let mut bytes = vec![0; 64 << 10];
    while let Ok(count @ 1..) = from.read(&mut bytes).await {
        let mode = *mode.borrow();
        if let Mode::Without(word) | Mode::Denied(word) = mode
            && bytes[..count]
                .windows(word.len())
                .any(|window| window == word.as_bytes())
        {
            kept_back.send_modify(|count| *count += 1);
            return matches!(mode, Mode::Denied(_));
        }
        if to.write_all(&bytes[..count]).await.is_err() {
            return false;
        }
    }
    false
}

/// Answers, and hears the client out: a connection that is closed on a request under way would break the answer off too.
async fn refuse(mut from: OwnedReadHalf, mut to: OwnedWriteHalf) {
    let answer = format!(
        "HTTP/1.1 400 Bad Request\r\nContent-Type: application/x-amz-json-1.0\r\nContent-Length: {}\r\nConnection: close\r\n\r\n{NO_RIGHT}",
        NO_RIGHT.len()
    );
    if to.write_all(answer.as_bytes()).await.is_ok() && to.shutdown().await.is_ok() {
        _ = copy(&mut from, &mut sink()).await;
    }
}
