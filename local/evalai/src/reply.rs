//! One answer of the server, before it becomes an HTTP response. Every handler returns it; it knows no network.

use axum::body::Body;
use axum::http::{HeaderName, HeaderValue, StatusCode, header};
use axum::response::Response;
use serde_json::Value;

use crate::errors::{self, ErrorText};

/// The answer of a handler; an error is an answer like any other.
pub type Answer = Result<Reply, Reply>;

/// Status, headers and body of one answer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Reply {
    /// HTTP status code.
    pub status: u16,
    /// The value of `Content-Type`.
    pub content_type: &'static str,
    /// Headers other than the content type.
    pub headers: Vec<(&'static str, String)>,
    /// The body's bytes.
    pub body: Vec<u8>,
}

impl Reply {
    /// A JSON answer.
    pub fn json(status: u16, body: &Value) -> Self {
        Self::of(status, "application/json", body.to_string())
    }

    /// A JSON answer with status 200.
    pub fn ok(body: &Value) -> Self {
        Self::json(200, body)
    }

    /// An HTML page.
    pub fn html(status: u16, page: impl Into<Vec<u8>>) -> Self {
        Self::of(status, "text/html; charset=utf-8", page)
    }

    /// A line of the error table with its values.
    pub fn error(error: &ErrorText, values: &[&str]) -> Self {
        let reply = Self::of(error.status, error.content_type(), error.body(values));
        if error.status == 401 && error.shape != errors::Shape::Error {
            return reply.with("www-authenticate", r#"Bearer realm="api""#.to_owned());
        }
        reply
    }

    /// EvalAI's page for an unhandled exception.
    pub fn server_error() -> Self {
        Self::error(&errors::SERVER_ERROR, &[])
    }

    /// Any body.
    pub fn of(status: u16, content_type: &'static str, body: impl Into<Vec<u8>>) -> Self {
        Self {
            status,
            content_type,
            headers: Vec::new(),
            body: body.into(),
        }
    }

    /// Adds a header to the answer.
    #[must_use]
    pub fn with(mut self, name: &'static str, value: String) -> Self {
        self.headers.push((name, value));
        self
    }

    /// The HTTP response. A header that is no header is left out.
    pub fn into_response(self) -> Response {
        let mut response = Response::new(Body::from(self.body));
        *response.status_mut() = StatusCode::from_u16(self.status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
        let headers = response.headers_mut();
        headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(self.content_type));
        for (name, value) in self.headers {
            if let Ok(value) = HeaderValue::from_str(&value) {
                headers.insert(HeaderName::from_static(name), value);
            }
        }
        response
    }
}

impl From<&ErrorText> for Reply {
    fn from(error: &ErrorText) -> Self {
        Self::error(error, &[])
    }
}
