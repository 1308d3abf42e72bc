//! The run's folder in S3.

use super::*;

#[tokio::test]
async fn objects_are_read_written_listed_and_deleted() {
    let pod = Pod::new().await;
    let archive = &pod.archive;
    assert!(archive.prefix_is_empty().await.unwrap());
    assert_eq!(archive.get("a/x", 10).await.unwrap(), None);
    assert_eq!(
        archive.get_if_none_match("a/x", None, 10).await.unwrap(),
        Fetched::Absent
    );
    let etag = archive.put("a/x", b"0123456789".to_vec()).await.unwrap();
    let Fetched::Found(object) = archive.get_if_none_match("a/x", None, 10).await.unwrap() else {
        panic!("it is not found");
    };
    assert_eq!((object.bytes.as_slice(), &object.etag), (&b"0123456789"[..], &etag));
    let again = archive.get_if_none_match("a/x", etag.as_deref(), 10).await.unwrap();
    assert_eq!(again, Fetched::NotModified);
    let error = archive.get("a/x", 9).await.unwrap_err();
    assert!(matches!(error.cause, Cause::TooLarge(9)), "{error}");

    for i in 0..25 {
        archive.put(&format!("b/{i:02}"), Vec::new()).await.unwrap();
    }
    let some = archive.list("b/", 10).await.unwrap();
    assert_eq!((some.objects.len(), some.complete), (10, false));
    let all = archive.list("", 1000).await.unwrap();
    assert_eq!((all.objects.len(), all.complete), (26, true));
    assert_eq!((all.objects[0].key.as_str(), all.objects[0].size), ("a/x", 10));
    let keys: Vec<String> = all.objects.into_iter().map(|object| object.key).collect();
    archive.delete(&keys).await.unwrap();
    archive.delete(&["never/there".to_owned()]).await.unwrap();
    assert!(archive.prefix_is_empty().await.unwrap());
}

#[tokio::test]
async fn errors_show_what_to_do() {
    let endpoint = server().await.endpoint();
    let client = server().await.aws().await.s3(None, Some(&endpoint));
    let archive = Archive::new(client, "no-such-bucket", "77/");
    let error = archive.put("x", Vec::new()).await.unwrap_err();
    assert!(matches!(error.cause, Cause::NoBucket), "{error}");
    let text = error.to_string();
    assert!(
        text.starts_with("storing s3://no-such-bucket/77/x: the bucket does not exist. Create"),
        "{text}"
    );
    assert!(
        archive.get("x", 10).await.is_err(),
        "a missing bucket is not a missing object"
    );
}

/// S3 as it is for credentials that may list one prefix only, with nothing stored.
async fn tight_s3() -> (String, JoinHandle<()>) {
    const DENIED: &str = "<Error><Code>AccessDenied</Code><Message>Access Denied</Message></Error>";
    const EMPTY: &str = "<ListBucketResult><KeyCount>0</KeyCount><IsTruncated>false</IsTruncated></ListBucketResult>";
    let answer = |request: axum::extract::Request| async move {
        let query = request.uri().query().unwrap_or_default();
        if query.contains("list-type=2") && query.contains("prefix=runs%2F77%2F") {
            (http::StatusCode::OK, EMPTY)
        } else {
            (http::StatusCode::FORBIDDEN, DENIED)
        }
    };
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let endpoint = format!("http://{}", listener.local_addr().unwrap());
    let router = axum::Router::new().fallback(answer);
    let server = tokio::spawn(async move { axum::serve(listener, router).await.unwrap() });
    (endpoint, server)
}

#[tokio::test]
async fn a_missing_object_differs_from_a_forbidden_one() {
    let (endpoint, server) = tight_s3().await;
    let client = || async { ministack::aws(&endpoint).await.s3(None, Some(&endpoint)) };
    let ours = Archive::new(client().await, "bucket", "runs/77/");
    assert_eq!(ours.get(REPORT_KEY, 10).await.unwrap(), None);
    let foreign = Archive::new(client().await, "bucket", "runs/78/");
    let error = foreign.get(REPORT_KEY, 10).await.unwrap_err();
    assert!(matches!(error.cause, Cause::Denied(_)), "{error}");
    assert!(error.to_string().contains("s3:ListBucket"), "{error}");
    server.abort();
}

#[tokio::test]
async fn an_object_is_replaced_whatever_was_known_of_it() {
    let pod = Pod::new().await;
    let archive = &pod.archive;
    let first = archive.replace("a", "1".into(), None).await.unwrap();
    // Longer names that begin the same are other objects.
    archive.put("a.b", b"other".to_vec()).await.unwrap();
    archive.put("a", b"another's".to_vec()).await.unwrap();
    for (text, known) in [("2", first.as_deref()), ("3", first.as_deref()), ("4", None)] {
        archive.replace("a", text.into(), known).await.unwrap();
        assert_eq!(pod.stored("a").await.unwrap(), text.as_bytes());
    }
    archive.delete(&["a".to_owned()]).await.unwrap();
    archive.replace("a", "5".into(), first.as_deref()).await.unwrap();
    assert_eq!(pod.stored("a").await.unwrap(), b"5");
    assert_eq!(pod.stored("a.b").await.unwrap(), b"other");
}

#[tokio::test]
async fn an_s3_without_conditions_stores_all_the_same() {
    const REFUSED: &str = "<Error><Code>NotImplemented</Code></Error>";
    let answer = |request: axum::extract::Request| async move {
        let has_condition = |name| request.headers().contains_key(name);
        if has_condition("if-match") || has_condition("if-none-match") {
            (http::StatusCode::NOT_IMPLEMENTED, [("etag", "")], REFUSED)
        } else {
            (http::StatusCode::OK, [("etag", "\"x\"")], "")
        }
    };
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let endpoint = format!("http://{}", listener.local_addr().unwrap());
    let router = axum::Router::new().fallback(answer);
    let server = tokio::spawn(async move { axum::serve(listener, router).await.unwrap() });
    let archive = Archive::new(
        ministack::aws(&endpoint).await.s3(None, Some(&endpoint)),
        "bucket",
        "77/",
    );
    for known in [None, Some("\"w\"")] {
        let etag = archive.replace("a", "1".into(), known).await.unwrap();
        assert_eq!(etag.as_deref(), Some("\"x\""));
    }
    server.abort();
}

/// Kind of encryption, key and class of a stored object.
async fn kept_as(pod: &Pod, key: &str) -> (String, String, String) {
    let s3 = pod.aws.s3(None, Some(&server().await.endpoint()));
    let bucket = &pod.setting.run.plan.storage.s3.bucket;
    let head = s3
        .head_object()
        .bucket(bucket)
        .key(format!("runs/77/{key}"))
        .send()
        .await
        .unwrap();
    let text = |value: Option<&str>| value.unwrap_or_default().to_owned();
    (
        text(
            head.server_side_encryption()
                .map(aws_sdk_s3::types::ServerSideEncryption::as_str),
        ),
        text(head.ssekms_key_id()),
        text(head.storage_class().map(aws_sdk_s3::types::StorageClass::as_str)),
    )
}

#[tokio::test]
async fn every_object_is_kept_as_the_leaderboard_sets() {
    const KEY: &str = "arn:aws:kms:us-east-1:000000000000:key/0a1b";
    let pod = Pod::new().await;
    let mut storage = pod.setting.run.plan.storage.s3.clone();
    storage.endpoint = Some(server().await.endpoint());
    let run_id = &pod.setting.run.plan.run_id;
    pod.put("file", &vec![7; 6 * MIB]);
    let file = Arc::new(File::open(pod.path("file")).unwrap());
    storage.kms_key_arn = Some(KEY.to_owned());
    storage.storage_class = Some(StorageClass::StandardIa);
    let archive = Archive::of_run(&pod.aws, &storage, run_id);
    archive.put("whole", b"1".to_vec()).await.unwrap();
    archive.replace("replaced", "1".into(), None).await.unwrap();
    archive.upload("parts", &file, None, 6 << 20, None).await.unwrap();
    for key in ["whole", "replaced", "parts"] {
        let wanted = ["aws:kms", KEY, "STANDARD_IA"].map(str::to_owned).into();
        assert_eq!(kept_as(&pod, key).await, wanted, "{key}");
    }
    // Without a word of the Leaderboard's the bucket decides.
    pod.archive.put("as the bucket says", b"1".to_vec()).await.unwrap();
    assert_eq!(kept_as(&pod, "as the bucket says").await.1, "");
}
