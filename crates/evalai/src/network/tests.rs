//! What is read off errors and the environment. `client` and `files` are tested over connections.

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll, Waker};

use super::*;

/// A connection that the other side closes: at once, or when it has read something.
#[derive(Default)]
struct Closing {
    reads_first: bool,
    has_read: bool,
    waker: Option<Waker>,
}

impl hyper::rt::Read for Closing {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        _: hyper::rt::ReadBufCursor<'_>,
    ) -> Poll<io::Result<()>> {
        if self.has_read || !self.reads_first {
            return Poll::Ready(Ok(()));
        }
        self.waker = Some(context.waker().clone());
        Poll::Pending
    }
}

impl hyper::rt::Write for Closing {
    fn poll_write(mut self: Pin<&mut Self>, _: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        self.has_read = true;
        if let Some(waker) = self.waker.take() {
            waker.wake();
        }
        Poll::Ready(Ok(bytes.len()))
    }

    fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }

    fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }
}

#[tokio::test]
async fn a_request_whose_connection_was_closed_before_its_first_byte_was_not_sent() {
    #[derive(thiserror::Error, Debug)]
    #[error("it did not work")]
    struct Wrapped(#[source] hyper::Error);

    let handshake = |reads_first| {
        let peer = Closing {
            reads_first,
            ..Closing::default()
        };
        hyper::client::conn::http1::handshake::<_, String>(peer)
    };
    for reads_first in [false, true] {
        let (mut sender, connection) = handshake(reads_first).await.unwrap();
        let request = sender.send_request(hyper::Request::new(String::new()));
        let (answer, _) = tokio::join!(request, connection);
        assert_eq!(is_canceled(&Wrapped(answer.unwrap_err())), !reads_first);
    }
}

#[test]
fn a_proxy_may_be_anywhere() {
    let set = |name: &str| match name {
        "HTTPS_PROXY" => Some("http://proxy.internal:3128".to_owned()),
        "http_proxy" => Some("10.0.0.2:3128".to_owned()),
        _ => None,
    };
    assert_eq!(proxies(set), ["proxy.internal", "10.0.0.2"]);
}
