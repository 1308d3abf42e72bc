//! Look-ups by a resolver that a test plays, and a way to AWS by a name that no resolver knows.

use std::net::Ipv4Addr;
use std::sync::atomic::{AtomicUsize, Ordering};

use tokio::io::AsyncReadExt;
use tokio::net::TcpListener;

use super::*;
use crate::services::aws::Aws;

const NAME: &str = "s3.pinned.invalid";

fn ip(text: &str) -> IpAddr {
    text.parse().unwrap()
}

/// A resolver that answers so, and how often it was asked.
fn names(answer: impl Fn(&str) -> std::io::Result<Vec<IpAddr>> + Send + Sync + 'static) -> (Names, Arc<AtomicUsize>) {
    let asked = Arc::new(AtomicUsize::new(0));
    let count = Arc::clone(&asked);
    let names = Names::by(move |name| {
        count.fetch_add(1, Ordering::SeqCst);
        let answer = answer(&name);
        async move { answer }.boxed()
    });
    (names, asked)
}

#[tokio::test(start_paused = true)]
async fn a_name_is_asked_for_once_in_a_while_and_a_failure_too() {
    for answer in [Ok(vec![ip("10.0.0.5")]), Err(std::io::ErrorKind::NotFound)] {
        let given = answer.clone();
        let (names, asked) = names(move |_| given.clone().map_err(Into::into));
        for _ in 0..1000 {
            assert_eq!(names.addresses(NAME).await.is_ok(), answer.is_ok());
        }
        assert_eq!(asked.load(Ordering::SeqCst), 1);
        tokio::time::advance(GOOD_FOR).await;
        let _ = names.addresses(NAME).await;
        assert_eq!(asked.load(Ordering::SeqCst), 2, "the address may have changed");
    }
}

#[tokio::test(start_paused = true)]
async fn a_resolver_that_hangs_is_waited_for_a_few_seconds() {
    let names = Names::by(|_| futures::future::pending().boxed());
    let began = Instant::now();
    assert_eq!(names.addresses(NAME).await, Err("no answer within 5 s".into()));
    assert_eq!(began.elapsed(), LIMIT);
}

#[tokio::test]
async fn of_a_thousand_addresses_a_few_are_used_and_their_order_means_nothing() {
    let all: Vec<IpAddr> = (1..=1000u32)
        .map(|n| Ipv4Addr::from_bits(0x0a00_0000 + n).into())
        .collect();
    let (first, _) = names({
        let all = all.clone();
        move |_| Ok(all.clone())
    });
    let (second, _) = names(move |_| Ok(all.iter().rev().chain(&all).copied().collect()));
    let found = first.addresses(NAME).await.unwrap();
    assert_eq!(found.len(), MOST);
    assert_eq!(second.addresses(NAME).await.unwrap(), found);
}

#[tokio::test]
async fn no_number_of_names_fills_the_memory() {
    let (names, _) = names(|_| Ok(vec![ip("10.0.0.5")]));
    for number in 0..2 * MOST_KEPT {
        names.addresses(&format!("{number}.invalid")).await.unwrap();
    }
    assert_eq!(names.0.known.lock().unwrap().len(), MOST_KEPT);
}

#[tokio::test]
async fn no_address_is_no_answer() {
    let (names, _) = names(|_| Ok(Vec::new()));
    assert_eq!(names.addresses(NAME).await, Err("it has no address".into()));
}

/// A way to AWS by this name alone, whose client speaks to an endpoint of this scheme.
async fn ask(scheme: &str, port: u16, addresses: &[&str]) -> String {
    let addresses = addresses.iter().copied().map(ip).collect();
    let aws = Aws::load_with("logcopy", Addresses::from([(NAME.to_owned(), addresses)])).await;
    let config = aws.config(None).into_builder();
    let keys = aws_credential_types::Credentials::new("test", "test", None, None, "tests");
    let provider = aws_credential_types::provider::SharedCredentialsProvider::new(keys);
    let aws = Aws::from_config(config.credentials_provider(provider).build());
    let endpoint = format!("{scheme}://S3.Pinned.invalid:{port}");
    let answer = aws.s3(None, Some(&endpoint)).list_objects_v2().bucket("b").send().await;
    format!("{:?}", answer.unwrap_err())
}

#[tokio::test]
async fn a_pod_reaches_a_service_by_a_name_that_no_resolver_has() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let port = listener.local_addr().unwrap().port();
    let router = axum::Router::new().fallback(|| async { axum::http::StatusCode::IM_A_TEAPOT });
    tokio::spawn(async move { axum::serve(listener, router).await });
    // Nobody listens at the second one: another try begins with the first.
    let error = ask("http", port, &["127.0.0.1", "127.0.0.2"]).await;
    assert!(error.contains("418"), "{error}");
}

#[tokio::test]
async fn a_name_that_was_not_given_is_asked_of_nobody() {
    let aws = Aws::load_with("logcopy", Addresses::new()).await;
    let sts = aws
        .sts(None)
        .assume_role_with_web_identity()
        .role_arn("arn")
        .role_session_name("s");
    let error = sts.web_identity_token("t").send().await.unwrap_err();
    let error = format!("{error:?}");
    assert!(error.contains("NotGiven(\"sts.us-east-1.amazonaws.com\")"), "{error}");
}

#[tokio::test]
async fn the_certificate_is_asked_for_by_name_and_an_unknown_one_is_refused() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let port = listener.local_addr().unwrap().port();
    let hello = tokio::spawn(async move {
        let (mut client, _) = listener.accept().await.unwrap();
        let mut acceptor = rustls::server::Acceptor::default();
        let mut bytes = [0; 4096];
        loop {
            let read = client.read(&mut bytes).await.unwrap();
            acceptor.read_tls(&mut &bytes[..read]).unwrap();
            if let Some(accepted) = acceptor.accept().unwrap() {
                return accepted.client_hello().server_name().map(str::to_lowercase);
            }
        }
    });
    let error = ask("https", port, &["127.0.0.1"]).await;
    assert!(!error.contains("no address of"), "{error}");
    assert_eq!(hello.await.unwrap().as_deref(), Some(NAME));
}
