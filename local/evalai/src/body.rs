//! Reads a request's body into named fields, as Django REST framework's `request.data`: JSON, a URL-encoded form or a
//! multipart form. Used by the handlers; knows the HTTP shapes and nothing of submissions.

use std::collections::BTreeMap;

use axum::body::{Body, Bytes};
use axum::extract::{DefaultBodyLimit, FromRequest, Multipart};
use axum::http::{Request, header};
use serde_json::{Map, Value};

use crate::errors;
use crate::python;
use crate::reply::Reply;

/// A body's fields.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Form {
    /// Values by name; forms have strings only.
    pub fields: Map<String, Value>,
    /// Uploaded files by name.
    pub files: BTreeMap<String, Vec<u8>>,
}

impl Form {
    /// A text; absent is empty. Anything else than a string raises in the server, hence the 500.
    pub fn text(&self, name: &str) -> Result<String, Reply> {
        match self.fields.get(name) {
            None => Ok(String::new()),
            Some(Value::String(text)) => Ok(text.clone()),
            Some(_) => Err(Reply::server_error()),
        }
    }

    /// A value as it was sent; absent is null.
    pub fn value(&self, name: &str) -> &Value {
        self.fields.get(name).unwrap_or(&Value::Null)
    }
}

/// Reads a body of the given content type.
pub async fn parse(content_type: Option<&str>, body: Bytes) -> Result<Form, Reply> {
    let full_type = content_type.unwrap_or_default();
    let media_type = full_type
        .split(';')
        .next()
        .unwrap_or_default()
        .trim()
        .to_ascii_lowercase();
    match media_type.as_str() {
        _ if body.is_empty() => Ok(Form::default()),
        "application/json" => json(&body),
        "application/x-www-form-urlencoded" => Ok(Form {
            fields: pairs(&body),
            files: BTreeMap::new(),
        }),
        "multipart/form-data" => multipart(full_type, body).await,
        _ => Err(Reply::error(&errors::UNSUPPORTED_MEDIA_TYPE, &[full_type])),
    }
}

fn json(body: &[u8]) -> Result<Form, Reply> {
    let text = std::str::from_utf8(body).map_err(|error| Reply::error(&errors::JSON_PARSE, &[&error.to_string()]))?;
    match serde_json::from_str(text) {
        Ok(Value::Object(fields)) => Ok(Form {
            fields,
            files: BTreeMap::new(),
        }),
        Ok(_) => Err(Reply::server_error()),
        // Python reads a lone surrogate and fails when the text is encoded again.
        Err(error) if error.to_string().contains("surrogate") || error.to_string().contains("end of hex escape") => {
            Err(Reply::server_error())
        }
        Err(error) => Err(Reply::error(&errors::JSON_PARSE, &[&python::json_error(text, &error)])),
    }
}

fn pairs(body: &[u8]) -> Map<String, Value> {
    form_urlencoded::parse(body)
        .map(|(name, value)| (name.into_owned(), Value::from(value.into_owned())))
        .collect()
}

async fn multipart(content_type: &str, body: Bytes) -> Result<Form, Reply> {
    let broken = |error: &dyn std::fmt::Display| Reply::error(&errors::MULTIPART_PARSE, &[&error.to_string()]);
    let mut request = Request::new(Body::from(body));
    let value = content_type.parse().map_err(|error| broken(&error))?;
    request.headers_mut().insert(header::CONTENT_TYPE, value);
    DefaultBodyLimit::disable().apply(&mut request);
    let mut parts = Multipart::from_request(request, &())
        .await
        .map_err(|error| broken(&error.body_text()))?;
    let mut form = Form::default();
    while let Some(part) = parts.next_field().await.map_err(|error| broken(&error.body_text()))? {
        let name = part.name().unwrap_or_default().to_owned();
        let is_file = part.file_name().is_some();
        let bytes = part.bytes().await.map_err(|error| broken(&error.body_text()))?;
        if is_file {
            form.files.insert(name, bytes.to_vec());
        } else {
            form.fields
                .insert(name, Value::from(String::from_utf8_lossy(&bytes).into_owned()));
        }
    }
    Ok(form)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[tokio::test]
    async fn three_kinds_of_body_give_the_same_fields() {
        let multipart = "--b\r\nContent-Disposition: form-data; name=\"submission\"\r\n\r\n7\r\n\
            --b\r\nContent-Disposition: form-data; name=\"input_file\"; filename=\"a.json\"\r\n\r\n{}\r\n--b--\r\n";
        let bodies = [
            ("application/json; charset=utf-8", r#"{"submission": "7"}"#),
            ("application/x-www-form-urlencoded", "submission=7"),
            ("multipart/form-data; boundary=b", multipart),
        ];
        for (content_type, body) in bodies {
            let form = parse(Some(content_type), Bytes::from(body)).await.unwrap();
            assert_eq!(
                Value::Object(form.fields.clone()),
                json!({"submission": "7"}),
                "{content_type}"
            );
            assert_eq!(form.files.len(), usize::from(content_type.starts_with("multipart")));
        }
    }

    #[tokio::test]
    async fn bad_bodies_are_refused_as_the_server_refuses_them() {
        for (content_type, body, status) in [
            (Some("application/json"), "{", 400),
            (Some("application/json"), "[]", 500),
            (Some("application/json"), r#"{"stdout": "\ud800"}"#, 500),
            (Some("application/json"), r#"{"a": NaN}"#, 400),
            (Some("multipart/form-data"), "x", 400),
            (Some("text/plain"), "x", 415),
            (None, "x", 415),
        ] {
            let reply = parse(content_type, Bytes::from(body)).await.unwrap_err();
            assert_eq!(reply.status, status, "{content_type:?} {body}");
        }
    }
}
