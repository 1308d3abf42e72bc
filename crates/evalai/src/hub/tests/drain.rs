//! The end of a process that has a write on its way, with the times of production.

use futures::future;
use http::Method;

use super::tokens::{board, cancelled};
use super::*;
use crate::transport::Transport;
use crate::transport::tests::memory::{self, whole};

/// A server that answers what is read at once, and a write so late; never without a time.
fn server(writes_take: Option<Duration>, wrote: mpsc::UnboundedSender<()>) -> Arc<dyn Transport> {
    memory::server(move |request| {
        if request.method() == Method::PUT {
            wrote.send(()).unwrap();
            return Box::pin(async move {
                match writes_take {
                    Some(time) => tokio::time::sleep(time).await,
                    None => future::pending().await,
                }
                whole(200, "{}")
            });
        }
        let is_row = request.uri().path().contains("/jobs/submission/");
        let row = r#"{"id": 7, "status": "running", "challenge_phase": 1}"#;
        Box::pin(future::ready(whole(200, if is_row { row } else { "[]" })))
    })
}

#[tokio::test(start_paused = true)]
async fn the_next_leader_may_write_at_once_only_if_the_last_write_was_answered() {
    for (writes_take, took) in [(Some(Duration::from_mins(1)), 60), (None, 65)] {
        let (wrote, mut written) = mpsc::unbounded_channel();
        let server = server(writes_take, wrote);
        let (_stop, signal) = Stop::new();
        let hub = Hub::new(Options {
            connect: Arc::new(move |_, _| Ok(Arc::clone(&server))),
            ..Options::unheard(&Tasks::new(signal), || true)
        });
        let board = board("https://evalai.example", "ns", 11, "x");
        hub.serve(&board.leaderboard, &board).unwrap();
        cancelled(&board, &hub);
        written.recv().await.unwrap();
        let began = Instant::now();
        assert_eq!(hub.drain().await, writes_take.is_some());
        assert_eq!(began.elapsed().as_secs(), took);
    }
}
