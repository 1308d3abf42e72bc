//! The client against a server of the test's own, that treats connections as servers do.

use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::task::{Context, Poll, Waker};

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};

use super::super::http::is_canceled;
use super::super::request::Purpose;
use super::super::types::Key;
use super::*;
use leaderboard_api::Attempt;
use leaderboard_api::evalai_status::{Outcome, Progress};
use leaderboard_base::spans::LogSpan;

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
    let client = Client::new(&url, Timeouts::default()).unwrap();
    let token = Token::parse("x").unwrap();
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
        let answer = client.send(&token, &request).await.answer();
        assert_eq!(answer, Answer::Done(()), "{}", request.name());
    }
    assert_eq!(reused.load(Ordering::SeqCst), 0);
}

#[tokio::test]
async fn a_write_to_a_server_that_is_not_there_was_not_sent() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    drop(listener);
    let client = Client::new(&url, Timeouts::default()).unwrap();
    let write = Request::Progress(submission(), Progress::Queued, None);
    let answer = client.send(&Token::parse("x").unwrap(), &write).await.answer();
    assert!(
        matches!(&answer, Answer::Unanswered(silence) if !silence.sent),
        "{answer:?}"
    );
}

/// A connection that the other side closes: at once, or when it has read something.
#[derive(Default)]
struct Closing {
    reads_first: bool,
    has_read: bool,
    waker: Option<Waker>,
}

impl hyper::rt::Read for Closing {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        _: hyper::rt::ReadBufCursor<'_>,
    ) -> Poll<io::Result<()>> {
        if self.has_read || !self.reads_first {
            return Poll::Ready(Ok(()));
        }
        self.waker = Some(context.waker().clone());
        Poll::Pending
    }
}

impl hyper::rt::Write for Closing {
    fn poll_write(mut self: Pin<&mut Self>, _: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        self.has_read = true;
        if let Some(waker) = self.waker.take() {
            waker.wake();
        }
        Poll::Ready(Ok(bytes.len()))
    }

    fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }

    fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }
}

#[tokio::test]
async fn a_request_whose_connection_was_closed_before_its_first_byte_was_not_sent() {
    #[derive(thiserror::Error, Debug)]
    #[error("it did not work")]
    struct Wrapped(#[source] hyper::Error);

    let handshake = |reads_first| {
        let peer = Closing {
            reads_first,
            ..Closing::default()
        };
        hyper::client::conn::http1::handshake::<_, String>(peer)
    };
    for reads_first in [false, true] {
        let (mut sender, connection) = handshake(reads_first).await.unwrap();
        let request = sender.send_request(hyper::Request::new(String::new()));
        let (answer, _) = tokio::join!(request, connection);
        assert_eq!(is_canceled(&Wrapped(answer.unwrap_err())), !reads_first);
    }
}
