//! A store that knows no checksums. It answers 501 to each request that has one. It also refuses the way in which the SDK adds a checksum
//! behind the content.

use aws_sdk_s3::config::RequestChecksumCalculation;
use axum::response::IntoResponse;
use http::{HeaderMap, StatusCode};

use super::*;
use crate::support::throttle::hand_on;

const REFUSED: &str =
    "<Error><Code>NotImplemented</Code><Message>A header implies what is not implemented</Message></Error>";

fn has_checksum(headers: &HeaderMap) -> bool {
    let named = headers.keys().map(http::HeaderName::as_str);
    let mut named =
        named.filter(|name| *name == "x-amz-trailer" || name.starts_with("x-amz-") && name.contains("checksum"));
    let encoding = headers.get("content-encoding").and_then(|value| value.to_str().ok());
    named.next().is_some() || encoding.is_some_and(|encoding| encoding.contains("aws-chunked"))
}

/// A Pod with a bucket of such a store, which sends checksums or none.
async fn pod(when: RequestChecksumCalculation) -> (Pod, JoinHandle<()>) {
    let to = server().await.endpoint();
    // Another test may have done it already.
    let _ = rustls::crypto::ring::default_provider().install_default();
    let client = reqwest::Client::builder().no_proxy().build().unwrap();
    let answer = move |request: axum::extract::Request| {
        let (to, client) = (to.clone(), client.clone());
        async move {
            if has_checksum(request.headers()) {
                return (StatusCode::NOT_IMPLEMENTED, REFUSED).into_response();
            }
            hand_on(&client, &to, request).await
        }
    };
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let endpoint = format!("http://{}", listener.local_addr().unwrap());
    let router = axum::Router::new().fallback(answer);
    let store = tokio::spawn(async move { axum::serve(listener, router).await.unwrap() });

    let bucket = server().await.bucket().await;
    let mut pod = Pod::on(&endpoint, &bucket, run(&bucket)).await;
    let config = pod.aws.config(None).into_builder();
    pod.aws = Aws::from_config(config.request_checksum_calculation(when).build());
    pod.archive = Archive::new(pod.aws.s3(None, Some(&endpoint)), &bucket, "runs/77/");
    (pod, store)
}

#[tokio::test]
async fn a_store_without_checksums_keeps_small_files_and_files_in_parts_and_gives_them_back() {
    let (pod, store) = pod(RequestChecksumCalculation::WhenRequired).await;
    pod.prepare().await.unwrap();
    let large = noise(21 * MIB, 1);
    pod.put("large", &large[..20 * MIB]);
    let mut etag = None;
    for size in [20 * MIB, 21 * MIB] {
        pod.put("large", &large[..size]);
        let file = Arc::new(File::open(pod.path("large")).unwrap());
        let kept = etag.as_deref().map(|etag| Kept {
            etag,
            size: (20 * MIB) as u64,
        });
        // The second one copies what is stored.
        let stored = pod.archive.upload("large", &file, kept, size as u64, None).await;
        etag = stored.unwrap();
        assert!(pod.stored("large").await.unwrap() == large[..size], "{size}");
    }
    pod.archive.put("small", b"1".to_vec()).await.unwrap();
    pod.archive.replace("small", "2".into(), None).await.unwrap();
    assert_eq!(pod.stored("small").await.unwrap(), b"2");
    let keys = ["large", "small", "never there"].map(str::to_owned);
    pod.archive.delete(&keys).await.unwrap();
    let left = pod.keys().await;
    assert!(!left.iter().any(|key| keys.contains(key)), "{left:?}");
    store.abort();
}

#[tokio::test]
async fn a_store_that_refuses_checksums_is_answered_with_the_setting_that_sends_none() {
    let (pod, store) = pod(RequestChecksumCalculation::WhenSupported).await;
    let error = pod.archive.put("small", b"1".to_vec()).await.unwrap_err().to_string();
    for part in [
        "status 501, NotImplemented",
        "AWS_REQUEST_CHECKSUM_CALCULATION=when_required",
    ] {
        assert!(error.contains(part), "{error}");
    }
    let verdict = pod.prepare().await.unwrap_err().verdict();
    assert!(verdict.message.contains("when_required"), "{}", verdict.message);
    store.abort();
}
