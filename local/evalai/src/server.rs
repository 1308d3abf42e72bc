//! Puts HTTP around the state: listeners, the order in which the server checks a request, the log, faults on purpose.
//! Started by the binary and by tests; what a request means is in `handlers` and [`crate::control`].
//!
//! A request runs in a task of its own: as behind the real server's proxy, the work goes on when its client is gone.

use std::fmt;
use std::net::SocketAddr;
use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;

use axum::body::{Body, Bytes, to_bytes};
use axum::http::{HeaderMap, Request, header};
use axum::response::Response;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::TokioIo;
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinSet;

use crate::app::{App, Config, now, throttled};
use crate::faults::{Failure, Fault, Knobs, When};
use crate::handlers::{self, Call};
use crate::idle::Idle;
use crate::log::{Entry, RequestLog};
use crate::reply::{Answer, Reply};
use crate::routes::{self, Found};
use crate::state::State;
use crate::{control, errors, media, pages};

/// The largest body EvalAI's nginx lets through.
const BODY_LIMIT: usize = 200 << 20;
/// A running stand-in. Dropped, it goes on until the runtime ends.
pub struct Handle {
    app: Arc<App>,
    addresses: Vec<SocketAddr>,
    listeners: JoinSet<()>,
}

impl Handle {
    /// `http://` and the first address it listens on.
    pub fn url(&self) -> String {
        self.addresses
            .first()
            .map(|address| format!("http://{address}"))
            .unwrap_or_default()
    }

    /// A copy of everything it holds.
    pub fn state(&self) -> State {
        self.app.state().clone()
    }

    /// Reads or changes what it holds, in place, between requests.
    pub fn with_state<R>(&self, act: impl FnOnce(&mut State) -> R) -> R {
        let result = act(&mut self.app.state());
        self.app.changed();
        result
    }

    /// Replaces all knobs.
    pub fn set_knobs(&self, knobs: Knobs) {
        *self.app.knobs() = knobs;
        self.app.changed();
    }

    /// Copies of the logged requests, oldest first.
    pub fn requests(&self) -> Vec<Entry> {
        self.app.log().entries().cloned().collect()
    }

    /// Waits until `ready` holds, without a limit of its own. It is asked at once, and again whenever a request has
    /// begun or ended; it must not call the handle.
    pub async fn wait_until(&self, mut ready: impl FnMut(&State, &RequestLog) -> bool) {
        self.app.until(|| ready(&self.app.state(), &self.app.log())).await;
    }

    /// Closes listeners and connections, and waits for them.
    pub async fn shutdown(mut self) {
        self.app.stop.send_replace(true);
        while self.listeners.join_next().await.is_some() {}
    }
}

/// Serves on listeners that are bound already. Must be called within a tokio runtime.
pub fn serve(config: Config, listeners: Vec<TcpListener>) -> Handle {
    let app = Arc::new(App::new(config));
    let addresses = listeners
        .iter()
        .filter_map(|listener| listener.local_addr().ok())
        .collect();
    let mut tasks = JoinSet::new();
    for listener in listeners {
        tasks.spawn(accept(Arc::clone(&app), listener));
    }
    Handle {
        app,
        addresses,
        listeners: tasks,
    }
}

/// Takes connections until the end; they end with it.
async fn accept(app: Arc<App>, listener: TcpListener) {
    let mut stop = app.stop.subscribe();
    let mut connections = JoinSet::new();
    loop {
        tokio::select! {
            _ = stop.wait_for(|stop| *stop) => return,
            Some(_) = connections.join_next() => {}
            accepted = listener.accept() => match accepted {
                Ok((stream, _)) => { connections.spawn(converse(Arc::clone(&app), stream)); }
                Err(error) => tracing::warn!(%error, "a connection could not be accepted"),
            },
        }
    }
}

/// Answers the requests of a connection until its client closes it, or it has been idle for too long.
async fn converse(app: Arc<App>, stream: TcpStream) {
    let idle = Arc::new(Idle::new());
    let service = service_fn(|request| {
        let (app, idle) = (Arc::clone(&app), Arc::clone(&idle));
        async move {
            let reused_after = idle.begin();
            let answer = respond(app, request, reused_after).await;
            idle.end();
            answer
        }
    });
    let mut connection = pin!(http1::Builder::new().serve_connection(TokioIo::new(stream), service));
    let keep_alive = || Duration::from_millis(app.knobs().keep_alive_ms);
    let ended = tokio::select! {
        ended = connection.as_mut() => ended,
        () = idle.over(keep_alive, app.changes.subscribe()) => {
            connection.as_mut().graceful_shutdown();
            connection.await
        }
    };
    if let Err(error) = ended {
        tracing::debug!(%error, "a connection ended early");
    }
}

/// The connection is closed without an answer, or in the middle of one.
#[derive(Debug)]
pub(crate) struct Closed;

impl fmt::Display for Closed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("closed on purpose")
    }
}

impl std::error::Error for Closed {}

/// The way in which a request ends.
pub(crate) enum Outcome {
    Reply(Reply),
    /// An answer with status 200 that is made while it is sent.
    Stream(Response<Body>),
    Close,
    Hang,
}

/// One request with its body read.
struct Asked {
    method: String,
    path: String,
    query: Option<String>,
    headers: HeaderMap,
    body: Bytes,
    /// How long its connection was idle before; none on a new one.
    reused_after: Option<Duration>,
}

async fn respond(
    app: Arc<App>,
    request: Request<Incoming>,
    reused_after: Option<Duration>,
) -> Result<Response<Body>, Closed> {
    let (head, body) = request.into_parts();
    let Ok(body) = to_bytes(Body::new(body), BODY_LIMIT).await else {
        return Ok(Reply::error(&errors::BODY_TOO_LARGE, &[]).into_response());
    };
    let asked = Asked {
        method: head.method.as_str().to_owned(),
        path: head.uri.path().to_owned(),
        query: head.uri.query().map(str::to_owned),
        headers: head.headers,
        body,
        reused_after,
    };
    let mut stop = app.stop.subscribe();
    match tokio::spawn(process(app, asked))
        .await
        .unwrap_or_else(|_| Outcome::Reply(Reply::server_error()))
    {
        Outcome::Reply(reply) => Ok(reply.into_response()),
        Outcome::Stream(response) => Ok(response),
        Outcome::Close => Err(Closed),
        Outcome::Hang => {
            let _ = stop.wait_for(|stop| *stop).await;
            Err(Closed)
        }
    }
}

async fn process(app: Arc<App>, asked: Asked) -> Outcome {
    if let Some(path) = asked.path.strip_prefix("/_stand-in/") {
        let query = query(asked.query.as_deref());
        let reply = control::answer(&app, &asked.method, path, &query, &asked.body).await;
        app.changed();
        return Outcome::Reply(reply);
    }
    if asked.path == "/" {
        return Outcome::Reply(Reply::html(200, pages::overview(&app.state())));
    }
    let token = header(&asked.headers, header::AUTHORIZATION);
    let token = token.and_then(|value| value.split_once(' ').map_or(Some(value), |(_, token)| Some(token)));
    let path = asked
        .query
        .as_ref()
        .map_or_else(|| asked.path.clone(), |query| format!("{}?{query}", asked.path));
    let id = app.log().begin(now(), &asked.method, &path, token, &asked.body);
    app.changed();
    let fault = app.knobs().take(&asked.method, &asked.path, asked.reused_after);
    let outcome = match &fault {
        Some(fault) if fault.when == When::Before => fail(fault),
        _ => {
            let outcome = work(&app, asked).await;
            fault.as_ref().map_or(outcome, fail)
        }
    };
    let status = match &outcome {
        Outcome::Reply(reply) => Some(reply.status),
        Outcome::Stream(response) => Some(response.status().as_u16()),
        Outcome::Close | Outcome::Hang => None,
    };
    let fault = fault.map(|fault| serde_json::json!(fault.answer).to_string().replace('"', ""));
    app.log().end(id, status, now(), fault);
    app.changed();
    outcome
}

fn fail(fault: &Fault) -> Outcome {
    let status = match fault.answer {
        Failure::Hang => return Outcome::Hang,
        Failure::Close => return Outcome::Close,
        Failure::Html500 => 500,
        Failure::Status(status) => status,
    };
    Outcome::Reply(match status {
        500 => Reply::server_error(),
        429 => throttled(56),
        502..=504 => Reply::html(status, pages::gateway_error(status)),
        _ => Reply::json(status, &serde_json::json!({"detail": "A fault on purpose."})),
    })
}

async fn work(app: &Arc<App>, asked: Asked) -> Outcome {
    if let Some(path) = asked.path.strip_prefix("/media/") {
        return media::serve(&app.state(), path, &query(asked.query.as_deref()));
    }
    Outcome::Reply(api(app, asked).await.unwrap_or_else(|error| error))
}

/// The order of the real server: path, signing in, e-mail, throttle, method, and only then the body.
async fn api(app: &Arc<App>, asked: Asked) -> Answer {
    let endpoint = match routes::find(&asked.path) {
        Found::Endpoint(endpoint) => endpoint,
        Found::Redirect(path) => {
            let location = asked
                .query
                .map_or_else(|| path.clone(), |query| format!("{path}?{query}"));
            return Ok(Reply::html(301, "").with("location", location));
        }
        Found::Nothing => return Err((&errors::PAGE_NOT_FOUND).into()),
    };
    let user = app
        .state()
        .authenticate(header(&asked.headers, header::AUTHORIZATION))?
        .cloned();
    match &user {
        None if !endpoint.is_public() => return Err((&errors::NO_CREDENTIALS).into()),
        Some(user) if !user.verified && endpoint.wants_email() => return Err((&errors::UNVERIFIED_EMAIL).into()),
        Some(_) if !endpoint.counts() => {}
        _ => app.check_throttle(user.as_ref().map(|user| user.id))?,
    }
    if !endpoint.methods().contains(&asked.method.as_str()) {
        return Err(Reply::error(&errors::METHOD_NOT_ALLOWED, &[&asked.method]));
    }
    let host = header(&asked.headers, header::HOST).unwrap_or("localhost");
    let call = Call {
        app: Arc::clone(app),
        user,
        path: asked.path,
        base: format!("http://{host}"),
        query: query(asked.query.as_deref()),
        content_type: header(&asked.headers, header::CONTENT_TYPE).map(str::to_owned),
        method: asked.method,
        body: asked.body,
    };
    handlers::answer(call, endpoint).await
}

fn header(headers: &HeaderMap, name: header::HeaderName) -> Option<&str> {
    headers.get(name).and_then(|value| value.to_str().ok())
}

fn query(query: Option<&str>) -> Vec<(String, String)> {
    form_urlencoded::parse(query.unwrap_or_default().as_bytes())
        .into_owned()
        .collect()
}
