use std::net::SocketAddr;
use std::time::Duration;

use futures::stream::{self, BoxStream};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::time::timeout;

use super::*;
use crate::page::connections::Bounded;
use crate::page::hub::{Source, VIEWERS};

/// Longest wait of a test.
const LIMIT: Duration = Duration::from_secs(30);
const FILES: [&str; 8] = [
    "/",
    "/page.css",
    "/page.js",
    "/sections.js",
    "/detail.js",
    "/timeline.js",
    "/elements.js",
    "/icon.svg",
];

/// A view that never changes, of so many bytes.
struct Still(usize);

impl Source for Still {
    fn changes(&self) -> BoxStream<'static, ()> {
        stream::pending().boxed()
    }

    fn view(&self) -> Vec<u8> {
        vec![b'x'; self.0]
    }

    fn detail(&self, namespace: &str, name: &str) -> Option<Vec<u8>> {
        (name != "none").then(|| format!("{{\"of\":\"{namespace}/{name}\"}}").into_bytes())
    }
}

/// A page with a view of so many bytes. It ends when the sender goes.
async fn page(bytes: usize) -> (SocketAddr, watch::Sender<bool>) {
    let (sender, stop) = Stop::new();
    let hub = Hub::new();
    let source = Arc::new(Still(bytes));
    tokio::spawn(hub.clone().run(source.clone()));
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let router = router(hub, source, stop);
    tokio::spawn(async move { axum::serve(Bounded::new(listener), router).await });
    (address, sender)
}

async fn open(address: SocketAddr, request: &str) -> TcpStream {
    let mut stream = TcpStream::connect(address).await.unwrap();
    stream.write_all(request.as_bytes()).await.unwrap();
    stream
}

/// A whole answer of a request with these header lines.
async fn answer(address: SocketAddr, line: &str, headers: &str) -> String {
    let request = format!("{line} HTTP/1.1\r\nConnection: close\r\n{headers}\r\n");
    let mut answer = String::new();
    let mut stream = open(address, &request).await;
    timeout(LIMIT, stream.read_to_string(&mut answer))
        .await
        .unwrap()
        .unwrap();
    answer
}

/// Reads a stream until it has brought a text.
async fn until(stream: &mut TcpStream, text: &str) -> String {
    let mut read = Vec::new();
    while !String::from_utf8_lossy(&read).contains(text) {
        let more = timeout(LIMIT, stream.read_buf(&mut read)).await;
        assert!(more.unwrap().unwrap() > 0, "{}", String::from_utf8_lossy(&read));
    }
    String::from_utf8(read).unwrap()
}

#[tokio::test]
async fn every_file_comes_with_the_policy_of_its_content() {
    let (address, _sender) = page(1).await;
    for path in FILES {
        let found = answer(address, &format!("GET {path}"), "Host: 127.0.0.1:4711\r\n").await;
        assert!(found.starts_with("HTTP/1.1 200"), "{path}: {found:.100}");
        for header in [
            "content-security-policy: default-src 'none'; script-src 'self'",
            "frame-ancestors 'none'",
            "require-trusted-types-for 'script'; trusted-types 'none'",
            "x-content-type-options: nosniff",
            "cache-control: no-store",
            "cross-origin-resource-policy: same-origin",
        ] {
            assert!(found.contains(header), "{path} lacks {header}");
        }
        assert!(!found.to_lowercase().contains("set-cookie"), "{path}");
    }
}

#[tokio::test]
async fn a_name_that_leads_to_loopback_is_refused() {
    let (address, _sender) = page(1).await;
    for (host, code) in [
        ("Host: 127.0.0.1\r\n", "200"),
        ("Host: localhost:8081\r\n", "200"),
        ("Host: [::1]:8081\r\n", "200"),
        ("Host: rebinding.example\r\n", "403"),
        ("Host: rebinding.example:8081\r\n", "403"),
        ("Host: 127.0.0.1.rebinding.example\r\n", "403"),
        ("Host: localhost.:80\r\n", "403"),
        ("Host: 127.0.0.1:80:81\r\n", "403"),
        ("Host: 127.0.0.1\r\nHost: rebinding.example\r\n", "403"),
        ("", "403"),
    ] {
        let found = answer(address, "GET /page.js", host).await;
        let refused_earlier = code == "403" && found.starts_with("HTTP/1.1 400");
        assert!(
            refused_earlier || found.starts_with(&format!("HTTP/1.1 {code}")),
            "{host:?}: {found:.60}"
        );
        assert!(code == "200" || !found.contains("EventSource"), "{host:?}");
    }
}

#[tokio::test]
async fn another_sites_script_reads_nothing_and_a_link_may_lead_here() {
    let (address, _sender) = page(1).await;
    for (path, site, code) in [
        ("/events", "cross-site", 403),
        ("/events", "same-site", 403),
        ("/submissions/a/b", "cross-site", 403),
        ("/page.js", "cross-site", 403),
        ("/page.js", "same-origin", 200),
        ("/", "cross-site", 200),
        ("/", "none", 200),
    ] {
        let headers = format!("Host: localhost\r\nSec-Fetch-Site: {site}\r\n");
        let found = answer(address, &format!("GET {path}"), &headers).await;
        assert!(
            found.starts_with(&format!("HTTP/1.1 {code}")),
            "{path} {site}: {found:.60}"
        );
        assert!(!found.to_lowercase().contains("access-control-allow"), "{found}");
    }
}

#[tokio::test]
async fn a_submission_is_read_by_its_name() {
    let (address, _sender) = page(1).await;
    let found = answer(address, "GET /submissions/demo/submission-7", "Host: localhost\r\n").await;
    assert!(
        found.starts_with("HTTP/1.1 200") && found.contains("content-type: application/json"),
        "{found}"
    );
    assert!(found.ends_with("{\"of\":\"demo/submission-7\"}"), "{found}");
    let found = answer(address, "GET /submissions/demo/none", "Host: localhost\r\n").await;
    assert!(found.starts_with("HTTP/1.1 404"), "{found}");
}

#[tokio::test]
async fn nothing_can_be_written() {
    let (address, _sender) = page(1).await;
    for method in ["POST", "PUT", "PATCH", "DELETE", "OPTIONS"] {
        for path in ["/", "/events", "/submissions/a/b"] {
            let found = answer(
                address,
                &format!("{method} {path}"),
                "Host: localhost\r\nContent-Length: 0\r\n",
            )
            .await;
            assert!(found.starts_with("HTTP/1.1 405"), "{method} {path}: {found:.60}");
        }
    }
    let found = answer(address, "GET /../../etc/passwd", "Host: localhost\r\n").await;
    assert!(found.starts_with("HTTP/1.1 404"), "{found:.60}");
}

#[tokio::test]
async fn the_viewer_after_the_last_place_is_asked_to_come_again() {
    let (address, sender) = page(3).await;
    let request = "GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n";
    let mut viewers = Vec::new();
    for _ in 0..VIEWERS {
        let mut viewer = open(address, request).await;
        let found = until(&mut viewer, "xxx").await;
        assert!(found.contains("content-type: text/event-stream"), "{found}");
        viewers.push(viewer);
    }
    let found = answer(address, "GET /events", "Host: localhost\r\n").await;
    assert!(found.contains("retry: 15000\nevent: full\n"), "{found}");
    let page = answer(address, "GET /page.js", "Host: localhost\r\n").await;
    assert!(page.starts_with("HTTP/1.1 200"), "the files are still served");
    drop(viewers.pop());
    // The place is free once the server has seen the end of the connection.
    let again = async {
        loop {
            let mut viewer = open(address, request).await;
            if !until(&mut viewer, "\n\n").await.contains("event: full") {
                return;
            }
            tokio::task::yield_now().await;
        }
    };
    timeout(LIMIT, again).await.unwrap();
    sender.send(true).unwrap();
    // The end of a chunked answer.
    until(&mut viewers[0], "0\r\n\r\n").await;
}

/// A view that no buffer of the system takes in whole, and a viewer that reads none of it.
#[tokio::test(start_paused = true)]
async fn a_viewer_that_reads_nothing_loses_its_place() {
    let (address, _sender) = page(64 << 20).await;
    let from = tokio::time::Instant::now();
    let mut deaf = open(address, "GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n").await;
    let mut idle = TcpStream::connect(address).await.unwrap();
    let mut left = Vec::new();
    // One that has sent nothing is closed, too.
    let _ = idle.read_to_end(&mut left).await;
    assert!(left.is_empty() && from.elapsed() >= super::super::connections::STILL);
    // The read ends with the bytes in the system's buffers, long before the end of the view.
    let _ = deaf.read_to_end(&mut left).await;
    assert!(left.len() < 64 << 20, "{}", left.len());
}
