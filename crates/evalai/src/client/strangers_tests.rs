//! The client against a server that means it ill, or stands in EvalAI's place: where it is not led, and how much it reads.

use std::sync::{Arc, Mutex};

use jiff::Timestamp;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpListener;

use super::super::request::Purpose;
use super::tests::over_network;
use super::*;

/// A server that gives each connection the same beginning of an answer, then the filling until the other side hangs up.
struct Server {
    url: String,
    /// The head of each request.
    heads: Arc<Mutex<Vec<String>>>,
}

impl Server {
    async fn start(beginning: String, filling: &'static [u8]) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("http://{}", listener.local_addr().unwrap());
        let heads = Arc::<Mutex<Vec<String>>>::default();
        let seen = heads.clone();
        tokio::spawn(async move {
            while let Ok((mut stream, _)) = listener.accept().await {
                let mut head = Vec::new();
                while !head.ends_with(b"\r\n\r\n") {
                    let Ok(byte) = stream.read_u8().await else { break };
                    head.push(byte);
                }
                seen.lock()
                    .unwrap()
                    .push(String::from_utf8_lossy(&head).to_ascii_lowercase());
                if stream.write_all(beginning.as_bytes()).await.is_err() || filling.is_empty() {
                    continue;
                }
                while stream.write_all(filling).await.is_ok() {}
            }
        });
        Self { url, heads }
    }

    async fn answering(status: &str, headers: &str, body: &str) -> Self {
        let length = body.len();
        let head = format!("HTTP/1.1 {status}\r\ncontent-length: {length}\r\nconnection: close\r\n{headers}\r\n");
        Self::start(format!("{head}{body}"), b"").await
    }

    fn heads(&self) -> Vec<String> {
        self.heads.lock().unwrap().clone()
    }
}

fn list() -> Request {
    Request::List {
        challenge: 1,
        purpose: Purpose::Cancel,
        after: Timestamp::UNIX_EPOCH,
    }
}

async fn send(server: &Server, request: &Request) -> Reply {
    over_network(&server.url, "the-token").send(request).await
}

#[tokio::test]
async fn a_redirect_of_the_api_takes_the_token_nowhere() {
    let elsewhere = Server::answering("200 OK", "", "[]").await;
    let location = format!("location: {}/\r\n", elsewhere.url);
    for status in ["301 Moved", "302 Found", "307 Temporary", "308 Permanent"] {
        let server = Server::answering(status, &location, "").await;
        let answer = send(&server, &list()).await.answer();
        assert!(
            matches!(&answer, Answer::Refused(refusal) if refusal.message.contains("redirect")),
            "{answer:?}"
        );
        assert!(server.heads()[0].contains("the-token"), "{:?}", server.heads());
    }
    assert_eq!(elsewhere.heads(), Vec::<String>::new());
}

#[tokio::test]
async fn an_answer_without_an_end_is_read_up_to_a_limit() {
    let head = "HTTP/1.1 200 OK\r\ncontent-type: application/json\r\nconnection: close\r\n\r\n[";
    let server = Server::start(head.to_owned(), &[b' '; 1 << 14]).await;
    let answer = send(&server, &list()).await.answer();
    assert!(
        matches!(&answer, Answer::Refused(refusal) if refusal.message.contains("more than is read")),
        "{answer:?}"
    );
}

#[tokio::test]
async fn a_row_that_its_participant_has_filled_is_not_read() {
    let names = r#""a","#.repeat(1 << 19);
    let row = format!(r#"{{"id":7,"status":"running","job_name":[{names}"submission-7-1"]}}"#);
    let server = Server::answering("200 OK", "", &row).await;
    let answer = send(&server, &Request::MessageRow(7)).await.answer();
    assert!(
        matches!(&answer, Answer::Refused(refusal) if refusal.message.contains("more than is read")),
        "{answer:?}"
    );
}
