//! The client against a server of the test's own, that treats connections as servers do.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use jiff::Timestamp;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};

use super::super::request::Purpose;
use super::super::types::Key;
use super::*;
use crate::network::Network;
use leaderboard_api::Attempt;
use leaderboard_api::evalai_status::{Outcome, Progress};
use leaderboard_base::spans::LogSpan;

pub(super) fn over_network(url: &str, token: &str) -> Client {
    let (timeouts, token) = (Timeouts::default(), Token::parse(token).unwrap());
    let network = Network::connect(url, timeouts).unwrap();
    Client::new(network, url, token.into(), timeouts, Meter::default())
}

/// Reads one request, with its body. False at the end of the connection.
async fn read(stream: &mut TcpStream) -> bool {
    let mut seen = Vec::new();
    let mut buffer = [0; 4096];
    loop {
        match stream.read(&mut buffer).await {
            Ok(0) | Err(_) => return false,
            Ok(count) => seen.extend_from_slice(&buffer[..count]),
        }
        let text = String::from_utf8_lossy(&seen).to_ascii_lowercase();
        let Some((head, body)) = text.split_once("\r\n\r\n") else {
            continue;
        };
        let length = head
            .split("content-length: ")
            .nth(1)
            .and_then(|rest| rest.split("\r\n").next());
        if body.len() >= length.map_or(0, |length| length.parse().unwrap()) {
            return true;
        }
    }
}

/// Serves one request a connection, and keeps it open as if for more. The next bytes on it come when it has just been given up.
async fn serve(listener: TcpListener, reused: Arc<AtomicUsize>) {
    while let Ok((mut stream, _)) = listener.accept().await {
        let reused = reused.clone();
        tokio::spawn(async move {
            if read(&mut stream).await {
                let answer = b"HTTP/1.1 200 OK\r\ncontent-type: application/json\r\ncontent-length: 2\r\n\r\n[]";
                stream.write_all(answer).await.unwrap();
            }
            if read(&mut stream).await {
                reused.fetch_add(1, Ordering::SeqCst);
            }
        });
    }
}

fn submission() -> SubmissionRef {
    SubmissionRef {
        key: Key {
            namespace: "carla".into(),
            name: "submission-7".into(),
            uid: "7".into(),
        },
        challenge: 1,
        pk: 7,
        attempt: Attempt(1),
        log: LogSpan::default(),
    }
}

#[tokio::test]
async fn no_request_is_lost_on_a_connection_that_the_server_gives_up() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    let reused = Arc::new(AtomicUsize::new(0));
    tokio::spawn(serve(listener, reused.clone()));
    let client = over_network(&url, "x");
    let list = Request::List {
        challenge: 1,
        purpose: Purpose::Cancel,
        after: Timestamp::UNIX_EPOCH,
    };
    let requests = [
        list.clone(),
        Request::Progress(submission(), Progress::Queued, None),
        list.clone(),
        Request::Progress(submission(), Progress::Running, None),
        Request::Final(submission(), Outcome::Failed, Arc::default()),
        list,
    ];
    for request in requests {
        let answer = client.send(&request).await.answer();
        assert_eq!(answer, Answer::Done(()), "{}", request.op());
    }
    assert_eq!(reused.load(Ordering::SeqCst), 0);
}

#[tokio::test]
async fn a_write_to_a_server_that_is_not_there_was_not_sent() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    drop(listener);
    let client = over_network(&url, "x");
    let write = Request::Progress(submission(), Progress::Queued, None);
    let answer = client.send(&write).await.answer();
    assert!(
        matches!(&answer, Answer::Unanswered(silence) if !silence.sent),
        "{answer:?}"
    );
}
