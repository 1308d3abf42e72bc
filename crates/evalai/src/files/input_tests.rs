//! Uploaded files as they are: what is a whole file, and what is none. Time is the test's own.

use futures::future::{self, FutureExt};
use http::header::HeaderValue;
use tokio::time::sleep;

use super::*;
use crate::transport::tests::memory::{begun, server, whole};

const URL: &str = "https://storage.example/x.csv?X-Amz-Signature=5ec2e7";

async fn opened(answers: impl Fn() -> Response<Body> + Send + Sync + 'static) -> Result<InputStream, InputError> {
    opened_at(URL, answers).await
}

async fn opened_at(
    url: &str,
    answers: impl Fn() -> Response<Body> + Send + Sync + 'static,
) -> Result<InputStream, InputError> {
    let server = server(move |_| future::ready(answers()).boxed());
    Files::new(server, Timeouts::default()).open(&url.into()).await
}

/// All of a file.
async fn read_whole(answers: impl Fn() -> Response<Body> + Send + Sync + 'static) -> Result<Vec<u8>, InputError> {
    let chunks: Vec<Bytes> = opened(answers).await?.try_collect().await?;
    Ok(chunks.concat())
}

fn of_length(length: &'static str, mut answer: Response<Body>) -> Response<Body> {
    let length = HeaderValue::from_static(length);
    answer.headers_mut().insert(CONTENT_LENGTH, length);
    answer
}

#[tokio::test]
async fn whatever_is_at_the_address_is_the_file_however_large_it_is() {
    for content in ["a,b\n1,2\n", "<!DOCTYPE html><html>a submission</html>", "{", ""] {
        let read = read_whole(move || whole(200, content)).await;
        assert_eq!(read, Ok(content.as_bytes().to_vec()));
    }
    assert_eq!(
        read_whole(|| of_length("4", whole(200, "1234"))).await,
        Ok(b"1234".to_vec())
    );
    let megabyte = Bytes::from(vec![7; 1 << 20]);
    let expected = megabyte.repeat(5);
    let chunks = move || stream::iter(vec![Ok(megabyte.clone()); 5]).boxed();
    assert_eq!(read_whole(move || begun(200, "", chunks())).await, Ok(expected));
}

#[tokio::test]
async fn a_page_in_the_place_of_a_file_is_refused_unless_a_page_was_uploaded() {
    for (path, kind, is_refused) in [
        ("x.csv?to=x.html", "text/html", true),
        ("x.csv", "Text/HTML; charset=utf-8", true),
        ("x", "text/html", true),
        ("x.csv", "text/csv", false),
        ("x.csv", "application/octet-stream", false),
        ("x.html?X-Amz-Signature=5ec2e7", "text/html", false),
        ("x.HTM", "text/html; charset=utf-8", false),
    ] {
        let answer = move || {
            let mut answer = whole(200, "<html>Log in</html>");
            answer
                .headers_mut()
                .insert(CONTENT_TYPE, HeaderValue::from_static(kind));
            answer
        };
        let error = opened_at(&format!("https://storage.example/{path}"), answer)
            .await
            .err();
        let why =
            "the address of the uploaded file answers with a page and not with the file; check EvalAI's MEDIA_URL";
        let refused = InputError::Refused(why.to_owned());
        assert_eq!(error, is_refused.then_some(refused), "{path} {kind}");
    }
}

#[tokio::test]
async fn an_answer_without_a_file_is_judged_by_its_status() {
    let silent = |why: &str| InputError::Silent(why.to_owned());
    let of = |code: u16| format!("the address of the uploaded file answers {code}");
    for code in [400, 401, 403, 404, 410] {
        let error = opened(move || whole(code, "x")).await.err();
        assert_eq!(error, Some(InputError::Gone(code)));
    }
    for code in [408, 429, 500, 502, 503, 504] {
        let error = opened(move || whole(code, "x")).await.err();
        assert_eq!(error, Some(silent(&of(code))));
    }
    for code in [204, 206, 304, 406, 418] {
        let error = opened(move || whole(code, "x")).await.err();
        let why = format!("{}; check EvalAI's MEDIA_URL", of(code));
        assert_eq!(error, Some(InputError::Refused(why)));
    }
}

#[tokio::test]
async fn a_file_that_breaks_off_is_no_short_file() {
    let cut = || Silence {
        sent: true,
        why: "EvalAI's answer broke off".to_owned(),
    };
    let ended = |length| format!("the uploaded file ended after 4 of {length} bytes");
    let silent = |why: String| Err(InputError::Silent(why));
    let broken = move || begun(200, "1234", stream::iter([Err(cut())]).boxed());
    assert_eq!(read_whole(broken).await, silent(cut().why));
    for length in ["5", "10737418240", "2"] {
        let short = move || of_length(length, whole(200, "1234"));
        assert_eq!(read_whole(short).await, silent(ended(length)));
        let chunks = opened(short).await.unwrap();
        let found: Vec<bool> = chunks.map(|chunk| chunk.is_ok()).collect().await;
        assert_eq!(found, [true, false], "nothing follows the error");
    }
}

#[tokio::test(start_paused = true)]
async fn each_chunk_is_waited_for_as_long_as_the_answer() {
    let late = |begin: &str| format!("EvalAI did not answer in time ({begin}: operation timed out)");
    let asked = Instant::now();
    let never = Files::new(server(|_| future::pending().boxed()), Timeouts::default());
    let error = never.open(&URL.into()).await.err();
    assert_eq!(error, Some(InputError::Silent(late("error sending request"))));
    assert_eq!(asked.elapsed().as_secs(), 30);

    let asked = Instant::now();
    let stalled = read_whole(|| begun(200, "12", stream::pending().boxed())).await;
    assert_eq!(stalled, Err(InputError::Silent(late("reading the uploaded file"))));
    assert_eq!(asked.elapsed().as_secs(), 30);

    let asked = Instant::now();
    let slow = || {
        let chunks = stream::iter(0..10).then(|_| async {
            sleep(Duration::from_secs(29)).await;
            Ok(Bytes::from("x"))
        });
        begun(200, "", chunks.boxed())
    };
    assert_eq!(
        read_whole(slow).await,
        Ok(b"xxxxxxxxxx".to_vec()),
        "its reader limits the whole"
    );
    assert_eq!(asked.elapsed().as_secs(), 290);
}

#[test]
fn no_address_and_no_error_shows_what_lets_others_read_the_file() {
    let key = Key {
        namespace: "ns".into(),
        name: "submission-7".into(),
        uid: "7".into(),
    };
    let url = Some(FileUrl::from(URL));
    let shown = format!("{:?}", InputAddress { key, url });
    assert!(shown.contains("submission-7") && !shown.contains("5ec2e7"), "{shown}");
    let gone = InputError::Gone(404).to_string();
    assert_eq!(
        gone,
        "the address of the uploaded file answers 404; check that EvalAI still serves the file"
    );
}
