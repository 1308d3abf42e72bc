//! How long answers are waited for, and what those show that do not come, or not whole. Time is the test's own.

pub(crate) mod memory;

use std::sync::atomic::{AtomicUsize, Ordering};

use futures::future::{self, FutureExt};
use futures::stream::{self, StreamExt};
use http::header::{HeaderValue, LOCATION};
use tokio::time::sleep;

use self::memory::{begun, server, whole};
use super::*;
use crate::client::Client;
use crate::files::Files;
use crate::request;
use crate::token::Token;
use leaderboard_base::meter::Meter;

fn client(answers: impl Fn() -> BoxFuture<'static, Response<Body>> + Send + Sync + 'static) -> Client {
    let (server, token) = (server(move |_| answers()), Token::parse("x").unwrap());
    let timeouts = Timeouts::default();
    Client::new(
        server,
        "https://evalai.example",
        token.into(),
        timeouts,
        Meter::default(),
    )
}

async fn ask(client: &Client, request: request::Request) -> Answer<()> {
    client.send(&request).await.answer()
}

fn read() -> request::Request {
    request::Request::Phases(1)
}

fn write() -> request::Request {
    request::Request::DeleteMessage("queue".into(), "receipt".into())
}

fn unanswered(why: &str) -> Answer<()> {
    Answer::Unanswered(Silence {
        sent: true,
        why: why.into(),
    })
}

#[tokio::test(start_paused = true)]
async fn an_answer_that_never_comes_is_waited_for_as_long_as_the_server_may_take() {
    let client = client(|| future::pending().boxed());
    for (request, seconds) in [(read(), 30), (write(), 65)] {
        let asked = Instant::now();
        let answer = ask(&client, request).await;
        let late = "EvalAI did not answer in time (error sending request: operation timed out)";
        assert_eq!(answer, unanswered(late));
        assert_eq!(asked.elapsed().as_secs(), seconds);
    }
}

#[tokio::test(start_paused = true)]
async fn a_write_whose_answer_breaks_off_is_done_and_a_read_is_not() {
    let stalled: fn() -> Body = || stream::pending().boxed();
    let cut: fn() -> Body = || {
        let silence = Silence {
            sent: true,
            why: "the answer broke off".into(),
        };
        stream::iter([Err(silence)]).boxed()
    };
    let late = "EvalAI did not answer in time (error decoding response body: operation timed out)";
    for (rest, why, seconds) in [(stalled, late, 30), (cut, "the answer broke off", 0)] {
        let done = client(move || future::ready(begun(200, "[", rest())).boxed());
        let asked = Instant::now();
        assert_eq!(ask(&done, read()).await, unanswered(why));
        assert_eq!(asked.elapsed().as_secs(), seconds);
        assert_eq!(ask(&done, write()).await, Answer::Done(()), "{why}");
        let refused = client(move || future::ready(begun(400, "{", rest())).boxed());
        assert_eq!(
            ask(&refused, write()).await,
            unanswered(why),
            "its text may be another server's"
        );
    }
}

#[tokio::test(start_paused = true)]
async fn an_answer_may_come_in_parts_until_the_last_second() {
    let client = client(|| {
        let rest = async {
            sleep(Duration::from_secs(29)).await;
            Ok(Bytes::from("]"))
        };
        future::ready(begun(200, "[", stream::once(rest).boxed())).boxed()
    });
    assert_eq!(ask(&client, read()).await, Answer::Done(()));
}

#[tokio::test(start_paused = true)]
async fn the_way_to_a_file_is_as_long_as_one_read_with_all_its_redirects() {
    let hops = Arc::new(AtomicUsize::new(0));
    let counted = Arc::clone(&hops);
    let server = server(move |_| {
        counted.fetch_add(1, Ordering::SeqCst);
        async {
            sleep(Duration::from_secs(12)).await;
            let mut answer = whole(302, "");
            let place = HeaderValue::from_static("https://storage.example/1.json");
            answer.headers_mut().insert(LOCATION, place);
            answer
        }
        .boxed()
    });
    let files = Files::new(server, Timeouts::default());
    let asked = Instant::now();
    let answer = files.image(&"https://evalai.example/media/1.json".into()).await;
    assert!(
        matches!(&answer, Answer::Unanswered(silence) if silence.sent),
        "{answer:?}"
    );
    assert_eq!((hops.load(Ordering::SeqCst), asked.elapsed().as_secs()), (3, 30));
}
