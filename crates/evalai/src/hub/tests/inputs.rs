//! The files that submissions are: from the row to the content.

use bytes::Bytes;
use futures::StreamExt;
use futures::stream::{self, TryStreamExt};
use http::Response;
use std::sync::atomic::{AtomicUsize, Ordering};

use super::*;
use crate::files::InputError;
use crate::transport::tests::memory::{begun, server, whole};
use crate::transport::{Body, Connect};
use crate::types::Changed;

/// An EvalAI whose rows have an address of its file, another one in each read; the first one has expired, and the third row has none.
fn connect() -> Connect {
    let reads = Arc::new(AtomicUsize::new(0));
    Arc::new(move |_, _| {
        let reads = Arc::clone(&reads);
        Ok(server(move |request| {
            let path = request.uri().path();
            let is_file = path.starts_with("/files/");
            assert!(!is_file || request.headers().is_empty(), "it has a token");
            let answer = answer(path, &reads);
            futures::future::ready(answer).boxed()
        }))
    })
}

fn answer(path: &str, reads: &AtomicUsize) -> Response<Body> {
    match path {
        "/api/jobs/submission/7" => {
            let number = reads.fetch_add(1, Ordering::SeqCst) + 1;
            let url = match number {
                3 => "null".to_owned(),
                _ => format!(r#""https://storage.example/files/{number}""#),
            };
            let row = format!(r#"{{"id": 7, "status": "submitted", "challenge_phase": 1, "input_file": {url}}}"#);
            begun(200, "", stream::iter([Ok(Bytes::from(row))]).boxed())
        }
        "/files/1" => whole(403, "<Code>AccessDenied</Code>"),
        path if path.starts_with("/files/") => whole(200, "a,b\n"),
        _ => whole(200, "[]"),
    }
}

/// The address of submission 7 once something has changed.
async fn address(hub: &Hub, changes: &mut mpsc::UnboundedReceiver<Changed>) -> InputAddress {
    loop {
        changes.recv().await.unwrap();
        if let Some(address) = hub.input_address(&key("7")) {
            return address;
        }
    }
}

#[tokio::test(start_paused = true)]
async fn an_address_that_has_expired_and_a_row_without_one_are_asked_for_anew_at_once() {
    let (_stop, signal) = Stop::new();
    let (changed, mut changes) = mpsc::unbounded_channel();
    let hub = Hub::new(Options {
        connect: connect(),
        changed,
        ..Options::unheard(&Tasks::new(signal), || true)
    });
    let run = Run {
        attempt: Attempt(1),
        job: "submission-7-1".into(),
        by_hand: false,
        has_job: false,
        ended: None,
        log: LogSpan::default(),
    };
    let target = Target {
        requests_per_minute: 6000,
        ..target("x")
    };
    let subject = Subject {
        target: Arc::new(target),
        key: key("7"),
        pk: 7,
        run,
    };
    assert!(hub.input_address(&subject.key).is_none());
    hub.ask(&subject, false).unwrap();
    let old = address(&hub, &mut changes).await;
    hub.live(&subject, Timestamp::UNIX_EPOCH).unwrap();
    let begun = Instant::now();
    assert_eq!(hub.open_input(&old).await.err(), Some(InputError::Gone(403)));
    let is_unknown = || hub.input_address(&subject.key).is_none();
    assert!(is_unknown(), "one address must not count twice");
    let new = address(&hub, &mut changes).await;
    let chunks = hub.open_input(&new).await.unwrap();
    let content: Vec<Bytes> = chunks.try_collect().await.unwrap();
    assert_eq!(content.concat(), b"a,b\n");
    assert!(begun.elapsed() < Duration::from_secs(5), "{:?}", begun.elapsed());

    let error = loop {
        let refreshed = address(&hub, &mut changes).await;
        if let Err(error) = hub.open_input(&refreshed).await {
            break error;
        }
    };
    assert_eq!(error, InputError::NoFile);
    assert!(is_unknown(), "one row must not count twice");
    let named = address(&hub, &mut changes).await;
    assert!(hub.open_input(&named).await.is_ok());

    hub.forget(&subject.key);
    let error = hub.open_input(&old).await.err();
    assert!(matches!(error, Some(InputError::Silent(_))), "{error:?}");
}
