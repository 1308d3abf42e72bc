//! One Lease behind a mock of the API server's client, with faults that a test names beforehand.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use http::{Request, Response, StatusCode};
use kube::Client;
use kube::client::Body;
use serde_json::{Value, json};
use tower_test::mock::{Handle, SendResponse, pair};

/// Fault of one request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// It is answered as a server would.
    None,
    /// It is done, and answered 504.
    DoneBut504,
    /// It is not done, and never answered.
    Silence,
    /// It is done, and answered 4 s later.
    Late,
    /// Somebody else changes the Lease right before it arrives.
    Meddled,
    /// Refused, 403.
    Forbidden,
}

#[derive(Default)]
pub struct State {
    pub lease: Option<Value>,
    version: u64,
    /// Faults of the next writes, in order; then none.
    pub writes: VecDeque<Fault>,
    /// Faults of the next reads.
    pub reads: VecDeque<Fault>,
    /// Fault of every request from now on, if set.
    pub always: Option<Fault>,
    /// Requests that arrived, `GET`, `POST` or `PUT`.
    pub log: Vec<String>,
    held_back: Vec<SendResponse<Response<Body>>>,
}

/// Clones are the same server.
#[derive(Clone, Default)]
pub struct FakeServer(Arc<Mutex<State>>);

impl FakeServer {
    /// A client of its own for a candidate.
    pub fn client(&self) -> Client {
        let (service, handle) = pair::<Request<Body>, Response<Body>>();
        tokio::spawn(self.clone().serve(handle));
        Client::new(service, "default")
    }

    /// Looks at the server, or changes what it will do.
    pub fn with<T>(&self, act: impl FnOnce(&mut State) -> T) -> T {
        act(&mut self.0.lock().unwrap())
    }

    async fn serve(self, mut handle: Handle<Request<Body>, Response<Body>>) {
        while let Some((request, answer)) = handle.next_request().await {
            let method = request.method().to_string();
            let bytes = request.into_body().collect_bytes().await.unwrap();
            if let Some((response, delay)) = self.with(|state| state.receive(&method, &bytes)) {
                tokio::time::sleep(delay).await;
                answer.send_response(response);
            } else {
                self.with(|state| state.held_back.push(answer));
            }
        }
    }
}

impl State {
    /// None: it is never answered.
    fn receive(&mut self, method: &str, bytes: &[u8]) -> Option<(Response<Body>, Duration)> {
        self.log.push(method.to_owned());
        let queue = if method == "GET" {
            &mut self.reads
        } else {
            &mut self.writes
        };
        let queued = queue.pop_front().unwrap_or(Fault::None);
        let fault = self.always.unwrap_or(queued);
        if fault == Fault::Silence {
            return None;
        }
        let (code, body) = self.handle(method, bytes, fault);
        let response = Response::builder()
            .status(code)
            .body(Body::from(serde_json::to_vec(&body).unwrap()));
        let delay = if fault == Fault::Late {
            Duration::from_secs(4)
        } else {
            Duration::ZERO
        };
        Some((response.unwrap(), delay))
    }

    fn handle(&mut self, method: &str, bytes: &[u8], fault: Fault) -> (StatusCode, Value) {
        match fault {
            Fault::Forbidden => return refusal(StatusCode::FORBIDDEN, "Forbidden"),
            Fault::Meddled => self.meddle(),
            _ => {}
        }
        let done = match method {
            "GET" => self
                .lease
                .clone()
                .map_or_else(|| refusal(StatusCode::NOT_FOUND, "NotFound"), |l| (StatusCode::OK, l)),
            "POST" if self.lease.is_some() => refusal(StatusCode::CONFLICT, "AlreadyExists"),
            "POST" => (StatusCode::CREATED, self.store(serde_json::from_slice(bytes).unwrap())),
            _ => self.replace(serde_json::from_slice(bytes).unwrap()),
        };
        if fault == Fault::DoneBut504 {
            refusal(StatusCode::GATEWAY_TIMEOUT, "Timeout")
        } else {
            done
        }
    }

    fn replace(&mut self, wanted: Value) -> (StatusCode, Value) {
        match &self.lease {
            None => refusal(StatusCode::NOT_FOUND, "NotFound"),
            Some(stored) if stored["metadata"]["resourceVersion"] != wanted["metadata"]["resourceVersion"] => {
                refusal(StatusCode::CONFLICT, "Conflict")
            }
            Some(_) => (StatusCode::OK, self.store(wanted)),
        }
    }

    fn store(&mut self, mut lease: Value) -> Value {
        self.version += 1;
        lease["metadata"]["resourceVersion"] = json!(self.version.to_string());
        self.lease = Some(lease.clone());
        lease
    }

    fn meddle(&mut self) {
        if let Some(mut lease) = self.lease.clone() {
            lease["metadata"]["labels"]["touched"] = json!("yes");
            self.store(lease);
        }
    }

    /// Puts a Lease there, as another process would. Without a holder a person has cleared it.
    pub fn put(&mut self, holder: Option<&str>, term: i32) {
        self.put_since(holder, term, &json!("2026-01-01T00:00:00.000000Z"));
    }

    /// Puts a Lease there that was handed over.
    pub fn put_free(&mut self, term: i32) {
        self.put_since(None, term, &Value::Null);
    }

    fn put_since(&mut self, holder: Option<&str>, term: i32, acquired: &Value) {
        let spec = json!({"holderIdentity": holder, "leaseTransitions": term, "leaseDurationSeconds": 15, "acquireTime": acquired,
            "renewTime": format!("2026-01-01T00:00:{:02}.000000Z", self.version % 60)});
        self.store(json!({"apiVersion": "coordination.k8s.io/v1", "kind": "Lease",
            "metadata": {"name": "operator", "namespace": "ns"}, "spec": spec}));
    }

    /// A field of the Lease's spec.
    pub fn spec(&self, field: &str) -> Value {
        self.lease
            .as_ref()
            .map_or(Value::Null, |lease| lease["spec"][field].clone())
    }
}

fn refusal(code: StatusCode, reason: &str) -> (StatusCode, Value) {
    let status = json!({"kind": "Status", "apiVersion": "v1", "metadata": {}, "status": "Failure", "message": "refused",
        "reason": reason, "code": code.as_u16()});
    (code, status)
}
