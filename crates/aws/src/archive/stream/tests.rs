//! What a bucket gets of a stream, and what it keeps of one that fails.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

use aws_config::{BehaviorVersion, Region};
use aws_credential_types::Credentials;
use aws_sdk_s3::config::RequestChecksumCalculation;
use axum::body::to_bytes;
use axum::extract::Request;
use axum::http::{Method, StatusCode};
use axum::response::{IntoResponse, Response};
use futures::StreamExt;
use futures::stream;

use super::*;
use crate::clients::Aws;

/// Bytes of one piece of a stream: a part never ends with one.
const PIECE: usize = (1 << 20) - 7;
/// Bytes of a part that is not the last.
const WHOLE: usize = 8 << 20;

type Piece = Result<Bytes, &'static str>;

/// A bucket with one object.
#[derive(Debug, Default)]
struct Bucket {
    /// What was asked for, in order.
    asked: Vec<&'static str>,
    parts: Vec<Vec<u8>>,
    object: Option<Vec<u8>>,
    /// What it refuses.
    refused: &'static str,
    /// Bytes that the stream had given when each part was there.
    given: Vec<usize>,
}

#[derive(Clone, Default)]
struct Server {
    bucket: Arc<Mutex<Bucket>>,
    /// Bytes that the stream has given.
    given: Arc<AtomicUsize>,
}

impl Server {
    async fn start(refused: &'static str) -> (Self, Archive) {
        let server = Self::default();
        server.bucket.lock().unwrap().refused = refused;
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("http://{}", listener.local_addr().unwrap());
        let serving = server.clone();
        let router = axum::Router::new().fallback(move |request: Request| serving.clone().answer(request));
        tokio::spawn(async move { axum::serve(listener, router).await });
        let loader = aws_config::defaults(BehaviorVersion::latest())
            .http_client(aws_smithy_http_client::Builder::new().build_http())
            .region(Region::new("us-east-1"))
            .credentials_provider(Credentials::new("test", "test", None, None, "tests"));
        let config = Box::pin(loader.load()).await;
        // A body is then the content alone.
        let when = RequestChecksumCalculation::WhenRequired;
        let config = config.into_builder().request_checksum_calculation(when).build();
        let client = Aws::from_config(config).s3(None, Some(&url));
        (server, Archive::new(client, "bucket", "runs/77/"))
    }

    async fn answer(self, request: Request) -> Response {
        let (head, body) = request.into_parts();
        let bytes = to_bytes(body, usize::MAX).await.unwrap().to_vec();
        assert_eq!(head.uri.path(), "/bucket/runs/77/input/file");
        let what = operation(&head.method, head.uri.query().unwrap_or_default());
        let given = self.given.load(Ordering::SeqCst);
        self.bucket.lock().unwrap().answer(what, bytes, given)
    }

    /// A stream of these pieces, which counts what it gives.
    fn stream(&self, pieces: Vec<Piece>) -> impl Stream<Item = Piece> {
        let given = Arc::clone(&self.given);
        stream::iter(pieces).inspect(move |piece| {
            let length = piece.as_ref().map_or(0, Bytes::len);
            given.fetch_add(length, Ordering::SeqCst);
        })
    }
}

impl Bucket {
    fn answer(&mut self, what: &'static str, bytes: Vec<u8>, given: usize) -> Response {
        self.asked.push(what);
        if self.refused == what {
            return (StatusCode::FORBIDDEN, "<Error><Code>AccessDenied</Code></Error>").into_response();
        }
        match what {
            "begin" => {
                "<InitiateMultipartUploadResult><UploadId>u</UploadId></InitiateMultipartUploadResult>".into_response()
            }
            "part" => {
                self.parts.push(bytes);
                self.given.push(given);
                ([("etag", "\"part\"")], "").into_response()
            }
            "join" => {
                self.object = Some(self.parts.concat());
                "<CompleteMultipartUploadResult><ETag>\"joined\"</ETag></CompleteMultipartUploadResult>".into_response()
            }
            "put" => {
                self.object = Some(bytes);
                ([("etag", "\"whole\"")], "").into_response()
            }
            _ => StatusCode::NO_CONTENT.into_response(),
        }
    }
}

fn operation(method: &Method, query: &str) -> &'static str {
    match *method {
        Method::PUT if query.contains("partNumber=") => "part",
        Method::PUT => "put",
        Method::POST if query.contains("uploadId=") => "join",
        Method::POST => "begin",
        Method::DELETE if query.contains("uploadId=u") => "abort",
        _ => "another",
    }
}

fn content(size: usize) -> Vec<u8> {
    (0..size).map(|at| u8::try_from(at % 251).unwrap()).collect()
}

fn pieces(content: &[u8]) -> Vec<Piece> {
    let pieces = content.chunks(PIECE);
    pieces.map(|piece| Ok(Bytes::copy_from_slice(piece))).collect()
}

#[tokio::test]
async fn a_stream_is_stored_in_parts_as_it_comes_and_a_small_one_whole() {
    for (size, asked) in [
        (0, vec!["put"]),
        (3, vec!["put"]),
        (WHOLE, vec!["put"]),
        (WHOLE + 1, vec!["begin", "part", "part", "join"]),
        (2 * WHOLE, vec!["begin", "part", "part", "join"]),
        (2 * WHOLE + WHOLE / 2, vec!["begin", "part", "part", "part", "join"]),
    ] {
        let (server, archive) = Server::start("").await;
        let content = content(size);
        let stream = server.stream(pieces(&content));
        let stored = archive.put_stream("input/file", stream, size as u64).await.unwrap();
        let expected = SubmittedFile {
            sha256: hex::encode(Sha256::digest(&content)),
            size: i64::try_from(size).unwrap(),
        };
        assert_eq!(stored, expected);
        let bucket = server.bucket.lock().unwrap();
        assert_eq!(bucket.asked, asked, "{size}");
        assert!(bucket.object.as_ref() == Some(&content), "{size}: another content");
        let whole = bucket.parts.split_last().map_or(&[][..], |(_, whole)| whole);
        assert!(whole.iter().all(|part| part.len() == WHOLE), "{size}");
        for (number, given) in (1..).zip(&bucket.given) {
            assert!(
                *given <= number * WHOLE + PIECE,
                "{size}: part {number} waits for {given} bytes"
            );
        }
    }
}

#[tokio::test]
async fn what_fails_leaves_no_upload_and_no_object() {
    const BROKEN: &str = "the server is gone";
    let whole = |size| pieces(&content(size));
    let broken = |size| [whole(size), vec![Err(BROKEN)]].concat();
    let most = 4 * WHOLE;
    for (pieces, limit, refused, asked, why) in [
        (whole(3), most, "put", vec!["put"], "archive"),
        (whole(WHOLE + 1), most, "begin", vec!["begin"], "archive"),
        (
            whole(2 * WHOLE),
            most,
            "part",
            vec!["begin", "part", "abort"],
            "archive",
        ),
        (
            whole(2 * WHOLE),
            most,
            "join",
            vec!["begin", "part", "part", "join", "abort"],
            "archive",
        ),
        (broken(3), most, "", vec![], BROKEN),
        (broken(WHOLE + 3), most, "", vec!["begin", "part", "abort"], BROKEN),
        (whole(10), 9, "", vec![], "too large"),
        (
            whole(3 * WHOLE),
            WHOLE + WHOLE / 2,
            "",
            vec!["begin", "part", "abort"],
            "too large",
        ),
    ] {
        let (server, archive) = Server::start(refused).await;
        let stream = server.stream(pieces);
        let error = archive
            .put_stream("input/file", stream, limit as u64)
            .await
            .unwrap_err();
        let found = match error {
            StreamError::TooLarge(bytes) if bytes == limit as u64 => "too large",
            StreamError::Broken(why) => why,
            StreamError::Archive(_) => "archive",
            StreamError::TooLarge(_) => "another limit",
        };
        let bucket = server.bucket.lock().unwrap();
        assert_eq!((&bucket.asked, found), (&asked, why), "{refused}");
        assert_eq!(bucket.object, None, "{refused}");
    }
}

#[tokio::test]
async fn an_object_that_no_upload_can_hold_is_refused_before_anything_is_read() {
    let (server, archive) = Server::start("").await;
    let stream = server.stream(vec![Ok(Bytes::from_static(b"x"))]);
    let stored = archive.put_stream("input/file", stream, u64::MAX / 2).await;
    assert!(matches!(stored, Err(StreamError::Archive(_))), "{stored:?}");
    assert_eq!(server.given.load(Ordering::SeqCst), 0);
    assert!(server.bucket.lock().unwrap().asked.is_empty());
}
