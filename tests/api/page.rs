//! The page of controllers that run: what changes in the API server arrives at who looks, from a standby as from the leader.
#![cfg(test)]

use std::net::SocketAddr;
use std::time::Duration;

use leaderboard_operator::page::Page;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::time::timeout;

use super::world::World;

const LIMIT: Duration = Duration::from_mins(1);

/// Somebody who looks.
struct Viewer {
    stream: TcpStream,
    read: Vec<u8>,
}

impl Viewer {
    async fn of(address: SocketAddr) -> Self {
        let mut stream = TcpStream::connect(address).await.unwrap();
        let request = b"GET /events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n";
        stream.write_all(request).await.unwrap();
        Self {
            stream,
            read: Vec::new(),
        }
    }

    /// Reads until a view has come with this text.
    async fn sees(&mut self, text: &str) {
        let read = async {
            while !self.read.windows(text.len()).any(|part| part == text.as_bytes()) {
                assert!(
                    self.stream.read_buf(&mut self.read).await.unwrap() > 0,
                    "the stream has ended"
                );
            }
        };
        let is_there = timeout(LIMIT, read).await;
        assert!(
            is_there.is_ok(),
            "{text} has not come: {}",
            String::from_utf8_lossy(&self.read)
        );
    }
}

/// The whole answer of a page to one request.
async fn answer(address: SocketAddr, path: &str) -> String {
    let mut stream = TcpStream::connect(address).await.unwrap();
    let request = format!("GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = String::new();
    timeout(LIMIT, stream.read_to_string(&mut answer))
        .await
        .unwrap()
        .unwrap();
    answer
}

#[tokio::test]
async fn a_change_arrives_at_who_looks_from_leader_and_standby() {
    let world = World::new().await;
    let pages = [
        Page::bind(0, "first").await.unwrap(),
        Page::bind(0, "second").await.unwrap(),
    ];
    let addresses = pages.each_ref().map(Page::address);
    assert!(addresses.iter().all(|address| address.ip().is_loopback()));
    let _replicas = pages.map(|page| world.replica("operator", "operator:1", Some(page)));
    let mut viewers = [Viewer::of(addresses[0]).await, Viewer::of(addresses[1]).await];
    world.leaderboard("board", 1, "Hosts").await;
    for viewer in &mut viewers {
        viewer.sees("\"name\":\"board\"").await;
    }
    let (_, name) = world.submit("board", 1).await;
    for viewer in &mut viewers {
        viewer.sees(&format!("\"name\":\"{name}\"")).await;
    }
    let of_submission = format!("/submissions/{}/{name}", world.namespace);
    let found = answer(addresses[1], &of_submission).await;
    assert!(
        found.contains(&format!("\"name\":\"{name}\"")) && found.contains("\"conditions\":["),
        "{found}"
    );
    let found = answer(addresses[1], &format!("{of_submission}-other")).await;
    assert!(found.starts_with("HTTP/1.1 404"), "{found}");
    // Whichever of them leads, the other one shows what it does.
    let leads = "\"leads\":true";
    let [first, second] = &mut viewers;
    tokio::select! {
        () = first.sees(leads) => {}
        () = second.sees(leads) => {}
    }
    for viewer in &mut viewers {
        viewer.sees("\"trouble\":null").await;
    }
}
