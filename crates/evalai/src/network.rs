//! The [`Transport`] over TCP: the only file of this crate that connects, and that knows reqwest.
//!
//! EvalAI's own server is connected to wherever it is. Every other address was named by a stranger, and has to be one of the internet.
//! A name is looked up once, and what was found is checked and connected to, so that a second look-up cannot lead elsewhere. Where a proxy
//! is set and used, it is the proxy that connects, and its rules that hold.

use std::net::SocketAddr;
use std::sync::Arc;

use bytes::Bytes;
use futures::future::{BoxFuture, FutureExt};
use futures::stream::{self, StreamExt};
use http::{Request, Response};
use reqwest::dns::{Addrs, Name, Resolve, Resolving};
use reqwest::redirect::Policy;
use reqwest::{Client, ClientBuilder, RequestBuilder};
use url::{Origin, Url};

use super::answer::Silence;
use super::reach::{NotPublic, Reach, check, reached};
use super::transport::{Body, ClientError, Failure, Timeouts, Transport, unsendable};
use leaderboard_api::ranges;
use leaderboard_api::text::causes;

/// Variables with the address of a proxy, in capital letters.
const PROXIES: [&str; 3] = ["HTTPS_PROXY", "HTTP_PROXY", "ALL_PROXY"];

/// Connections to one server of EvalAI, and to the internet.
pub struct Network {
    server: Option<Origin>,
    /// For EvalAI's own server.
    own: Client,
    /// For every other one.
    other: Client,
    reach: Reach,
}

impl Network {
    /// The transport to a server of EvalAI, which is named by its root.
    pub fn connect(api_server: &str, timeouts: Timeouts) -> Result<Arc<dyn Transport>, ClientError> {
        Ok(Arc::new(Self::new(api_server, timeouts, ranges::is_public)?))
    }

    pub(super) fn new(api_server: &str, timeouts: Timeouts, reach: Reach) -> Result<Self, ClientError> {
        let proxies = proxies(|name| std::env::var(name).ok());
        let resolver = Arc::new(Resolver { reach, proxies });
        Ok(Self {
            server: Url::parse(api_server).ok().map(|url| url.origin()),
            own: made(builder(timeouts))?,
            other: made(builder(timeouts).dns_resolver(resolver))?,
            reach,
        })
    }

    /// A request with the client that may send it; an error if none may.
    fn request(&self, request: Request<Bytes>) -> Result<RequestBuilder, Failure> {
        let (parts, body) = request.into_parts();
        let url = Url::parse(&parts.uri.to_string()).map_err(|error| Failure::Silent(unsendable(&error)))?;
        let client = if self.server.as_ref() == Some(&url.origin()) {
            &self.own
        } else {
            check(self.reach, &url).map_err(Failure::NotPublic)?;
            &self.other
        };
        Ok(client.request(parts.method, url).headers(parts.headers).body(body))
    }
}

impl Transport for Network {
    fn send(&self, request: Request<Bytes>) -> BoxFuture<'static, Result<Response<Body>, Failure>> {
        let request = self.request(request);
        async move { request?.send().await.map(streamed).map_err(failure) }.boxed()
    }
}

fn builder(timeouts: Timeouts) -> ClientBuilder {
    // A program that has installed one already keeps it.
    let _ = rustls::crypto::ring::default_provider().install_default();
    Client::builder()
        .connect_timeout(timeouts.connect)
        .user_agent(concat!("leaderboard-operator/", env!("CARGO_PKG_VERSION")))
        .redirect(Policy::none())
        .retry(reqwest::retry::never())
        // A server closes idle connections when it likes. A write that is sent on one in that moment has no answer, and
        // may have been served: nothing is written for over a minute. At some 54 requests a minute nothing is kept open.
        .pool_max_idle_per_host(0)
}

fn made(builder: ClientBuilder) -> Result<Client, ClientError> {
    builder
        .build()
        .map_err(|e| ClientError(leaderboard_api::text::chain(&e)))
}

fn streamed(mut response: reqwest::Response) -> Response<Body> {
    let (status, headers) = (response.status(), std::mem::take(response.headers_mut()));
    let chunks = stream::try_unfold(response, |mut response| async move {
        let chunk = response.chunk().await.map_err(silence);
        chunk.map(|chunk| chunk.map(|chunk| (chunk, response)))
    });
    let mut answer = Response::new(chunks.boxed());
    *answer.status_mut() = status;
    *answer.headers_mut() = headers;
    answer
}

fn failure(error: reqwest::Error) -> Failure {
    let refused = causes(&error).find_map(|cause| cause.downcast_ref::<NotPublic>());
    match refused.cloned() {
        Some(refused) => Failure::NotPublic(refused),
        None => Failure::Silent(silence(error)),
    }
}

fn silence(error: reqwest::Error) -> Silence {
    let error = error.without_url();
    let what = match () {
        () if error.is_timeout() => "EvalAI did not answer in time",
        () if error.is_connect() => "EvalAI could not be reached",
        () => "EvalAI's answer broke off",
    };
    Silence {
        sent: !error.is_connect() && !error.is_builder() && !is_canceled(&error),
        why: format!("{what} ({})", leaderboard_api::text::chain(&error)),
    }
}

/// True if the connection was closed before a byte of the request was sent on it.
fn is_canceled(error: &(dyn std::error::Error + 'static)) -> bool {
    causes(error).any(|cause| {
        cause
            .downcast_ref::<hyper::Error>()
            .is_some_and(hyper::Error::is_canceled)
    })
}

struct Resolver {
    reach: Reach,
    proxies: Vec<String>,
}

impl Resolve for Resolver {
    fn resolve(&self, name: Name) -> Resolving {
        let is_proxy = self
            .proxies
            .iter()
            .any(|proxy| proxy.eq_ignore_ascii_case(name.as_str()));
        let reach = self.reach;
        Box::pin(async move {
            let found: Vec<SocketAddr> = tokio::net::lookup_host((name.as_str(), 0)).await?.collect();
            let usable = if is_proxy {
                found
            } else {
                reached(reach, name.as_str(), found)?
            };
            let usable: Addrs = Box::new(usable.into_iter());
            Ok(usable)
        })
    }
}

/// The hosts of the proxies that the environment sets.
fn proxies(variable: impl Fn(&str) -> Option<String>) -> Vec<String> {
    let set = PROXIES
        .iter()
        .flat_map(|name| [variable(name), variable(&name.to_lowercase())]);
    let host = |text: String| {
        let url = if text.contains("://") {
            text
        } else {
            format!("http://{text}")
        };
        Url::parse(&url).ok()?.host_str().map(str::to_owned)
    };
    set.flatten().filter_map(host).collect()
}

#[cfg(test)]
mod tests;
