//! A [`Transport`] whose server is a function.

use futures::future::FutureExt;
use futures::stream::{self, StreamExt};

use super::super::*;

struct Memory<F>(F);

impl<F> Transport for Memory<F>
where
    F: Fn(Request<Bytes>) -> BoxFuture<'static, Response<Body>> + Send + Sync,
{
    fn send(&self, request: Request<Bytes>) -> BoxFuture<'static, Result<Response<Body>, Failure>> {
        (self.0)(request).map(Ok).boxed()
    }
}

/// A server that gives each request the answer of this function.
pub(crate) fn server<F>(answer: F) -> Arc<dyn Transport>
where
    F: Fn(Request<Bytes>) -> BoxFuture<'static, Response<Body>> + Send + Sync + 'static,
{
    Arc::new(Memory(answer))
}

pub(crate) fn whole(status: u16, body: &'static str) -> Response<Body> {
    begun(status, body, stream::empty().boxed())
}

/// An answer whose body begins so.
pub(crate) fn begun(status: u16, body: &'static str, rest: Body) -> Response<Body> {
    let chunks = stream::iter([Ok(Bytes::from(body))]).chain(rest);
    Response::builder().status(status).body(chunks.boxed()).unwrap()
}
