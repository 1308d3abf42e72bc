//! Where an uploaded file is read from, against servers on several addresses of this machine: `127.0.0.2` stands for the internet.

use std::net::{IpAddr, Ipv4Addr};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpListener;

use super::*;
use crate::network::Network;

const FILE: &str = r#"{"submitted_image_uri": "registry.example/agent:1"}"#;

fn is_internet(address: IpAddr) -> bool {
    address == Ipv4Addr::new(127, 0, 0, 2)
}

/// A server that gives every request the same answer, and counts them.
struct Server {
    url: String,
    requests: Arc<AtomicUsize>,
}

impl Server {
    async fn start(address: &str, answer: String) -> Self {
        let listener = TcpListener::bind((address, 0)).await.unwrap();
        let url = format!("http://{}", listener.local_addr().unwrap());
        let requests = Arc::new(AtomicUsize::new(0));
        let counted = Arc::clone(&requests);
        tokio::spawn(async move {
            while let Ok((mut stream, _)) = listener.accept().await {
                counted.fetch_add(1, Ordering::SeqCst);
                let mut request = Vec::new();
                while !request.ends_with(b"\r\n\r\n") {
                    request.push(stream.read_u8().await.unwrap());
                }
                stream.write_all(answer.as_bytes()).await.unwrap();
            }
        });
        Self { url, requests }
    }

    async fn with_file(address: &str) -> Self {
        let head = format!(
            "HTTP/1.1 200 OK\r\nconnection: close\r\ncontent-length: {}\r\n\r\n",
            FILE.len()
        );
        Self::start(address, head + FILE).await
    }

    async fn leading_to(address: &str, place: &str) -> Self {
        let head = "HTTP/1.1 302 Found\r\nconnection: close\r\ncontent-length: 0\r\n";
        Self::start(address, format!("{head}location: {place}\r\n\r\n")).await
    }

    fn requests(&self) -> usize {
        self.requests.load(Ordering::SeqCst)
    }
}

async fn read_as(server: &str, url: &str) -> Answer<ImageAnswer> {
    let timeouts = Timeouts::default();
    let network = Network::new(server, timeouts, is_internet).unwrap();
    Files::new(Arc::new(network), timeouts).image(&url.into()).await
}

/// The same for a file that is the submission itself.
async fn content_as(server: &str, url: &str) -> Result<Vec<u8>, InputError> {
    let timeouts = Timeouts::default();
    let network = Network::new(server, timeouts, is_internet).unwrap();
    let chunks = Files::new(Arc::new(network), timeouts).open(&url.into()).await?;
    let chunks: Vec<Bytes> = chunks.try_collect().await?;
    Ok(chunks.concat())
}

fn named() -> Answer<ImageAnswer> {
    Answer::Done(ImageAnswer::Named("registry.example/agent:1".into()))
}

fn refusal(answer: Answer<ImageAnswer>) -> String {
    match answer {
        Answer::Refused(refusal) => refusal.message,
        other => panic!("{other:?}"),
    }
}

#[tokio::test]
async fn a_file_is_read_from_evalais_own_server_wherever_it_is_and_from_the_internet() {
    let evalai = Server::with_file("127.0.0.1").await;
    assert_eq!(
        read_as(&evalai.url, &format!("{}/media/1.json", evalai.url)).await,
        named()
    );
    let storage = Server::with_file("127.0.0.2").await;
    assert_eq!(read_as(&evalai.url, &format!("{}/1.json", storage.url)).await, named());
    let redirecting = Server::leading_to("127.0.0.1", &storage.url).await;
    assert_eq!(
        read_as(&redirecting.url, &format!("{}/media/1.json", redirecting.url)).await,
        named()
    );
}

#[tokio::test]
async fn no_hop_leads_into_a_network_of_the_operators() {
    let inside = Server::with_file("127.0.0.3").await;
    let evalai = Server::leading_to("127.0.0.1", &inside.url).await;
    let storage = Server::leading_to("127.0.0.2", &inside.url).await;
    let twice = Server::leading_to("127.0.0.2", &storage.url).await;
    let by_name = Server::leading_to("127.0.0.2", &inside.url.replace("127.0.0.3", "localhost")).await;
    for first in [&inside, &evalai, &storage, &twice, &by_name] {
        let said = refusal(read_as(&evalai.url, &format!("{}/1.json", first.url)).await);
        assert!(said.contains("which is no address of the internet"), "{said}");
    }
    assert_eq!(inside.requests(), 0, "nothing was sent there");
}

#[tokio::test]
async fn another_port_of_evalais_machine_is_not_evalai() {
    let evalai = Server::with_file("127.0.0.1").await;
    let neighbour = Server::with_file("127.0.0.1").await;
    let said = refusal(read_as(&evalai.url, &format!("{}/1.json", neighbour.url)).await);
    assert!(said.contains("127.0.0.1"), "{said}");
    assert_eq!(neighbour.requests(), 0);
}

#[tokio::test]
async fn redirects_end() {
    let own = Server::leading_to("127.0.0.2", "/again").await;
    let said = refusal(read_as(&own.url, &format!("{}/1.json", own.url)).await);
    assert!(said.contains("more than 5 redirects"), "{said}");
    assert_eq!(own.requests(), 6);
    for (place, expected) in [("file:///etc/passwd", "neither http nor https"), ("http://", "no URL")] {
        let leading = Server::leading_to("127.0.0.2", place).await;
        let said = refusal(read_as(&own.url, &format!("{}/1.json", leading.url)).await);
        assert!(said.contains(expected), "{said}");
    }
    let said = refusal(read_as(&own.url, "ftp://storage/1.json").await);
    assert!(
        said.contains("neither http nor https; check EvalAI's MEDIA_URL"),
        "{said}"
    );
}

#[tokio::test]
async fn a_page_in_the_place_of_the_file_is_nobodys_image() {
    let page = "\n<!DOCTYPE html><html><title>Log in</title></html>";
    let head = format!(
        "HTTP/1.1 200 OK\r\nconnection: close\r\ncontent-length: {}\r\n\r\n",
        page.len()
    );
    let login = Server::start("127.0.0.2", head + page).await;
    let evalai = Server::leading_to("127.0.0.1", &login.url).await;
    let message = refusal(read_as(&evalai.url, &format!("{}/media/1.json", evalai.url)).await);
    assert!(message.contains("a page") && message.contains("MEDIA_URL"), "{message}");
}

#[tokio::test]
async fn a_submitted_file_is_read_from_where_images_are_and_from_nowhere_else() {
    let (storage, inside) = (
        Server::with_file("127.0.0.2").await,
        Server::with_file("127.0.0.3").await,
    );
    let evalai = Server::leading_to("127.0.0.1", &storage.url).await;
    let read = content_as(&evalai.url, &format!("{}/media/1.csv", evalai.url)).await;
    assert_eq!(read, Ok(FILE.as_bytes().to_vec()));
    let leading = Server::leading_to("127.0.0.2", &inside.url).await;
    for first in [&leading, &inside] {
        let url = format!("{}/1.csv?X-Amz-Signature=5ec2e7", first.url);
        let Err(InputError::Refused(why)) = content_as(&evalai.url, &url).await else {
            panic!("it is read from {}", first.url)
        };
        assert!(why.contains("127.0.0.3, which is no address of the internet"), "{why}");
        assert!(!why.contains("5ec2e7"), "{why}");
    }
    assert_eq!(inside.requests(), 0, "nothing was sent there");
}

#[tokio::test]
async fn a_connection_that_is_cut_in_the_middle_of_a_file_is_an_error() {
    let head = "HTTP/1.1 200 OK\r\nconnection: close\r\n";
    for rest in [
        "content-length: 100\r\n\r\na,b\n",
        "transfer-encoding: chunked\r\n\r\n4\r\na,b\n\r\n",
    ] {
        let storage = Server::start("127.0.0.2", format!("{head}{rest}")).await;
        let url = format!("{}/1.csv?X-Amz-Signature=5ec2e7", storage.url);
        let Err(InputError::Silent(why)) = content_as(&storage.url, &url).await else {
            panic!("half of it is a file: {rest:?}")
        };
        assert!(why.contains("broke off") && !why.contains("5ec2e7"), "{why}");
    }
}
