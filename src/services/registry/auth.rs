//! Who we are towards a registry: a pull secret's name and password, and the question for a token that a registry asks back. Pure.

use std::fmt;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde_json::Value;

/// Name and password. They appear in no `Debug` and no message.
#[derive(Clone, PartialEq, Eq)]
pub struct Credentials {
    user: String,
    password: String,
}

impl fmt::Debug for Credentials {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Credentials(…)")
    }
}

impl Credentials {
    pub(super) fn new(user: &str, password: &str) -> Option<Self> {
        let is_given = !user.is_empty() && !password.is_empty();
        is_given.then(|| Self {
            user: user.into(),
            password: password.into(),
        })
    }

    /// `user:password` in base64, as a pull secret and ECR have it.
    pub(super) fn decode(text: &str) -> Option<Self> {
        let text = String::from_utf8(STANDARD.decode(text.trim()).ok()?).ok()?;
        let (user, password) = text.split_once(':')?;
        Self::new(user, password)
    }

    /// What a pull secret (`.dockerconfigjson`) has for a registry.
    pub fn of_secret(secret: &[u8], registry: &str) -> Option<Self> {
        let secret: Value = serde_json::from_slice(secret).ok()?;
        let entries = secret.get("auths")?.as_object()?;
        let (_, entry) = entries.iter().find(|(key, _)| host(key) == host(registry))?;
        let text = |name: &str| entry.get(name).and_then(Value::as_str);
        match (text("username"), text("password")) {
            (Some(user), Some(password)) => Self::new(user, password),
            _ => Self::decode(text("auth")?),
        }
    }

    /// The value of an `Authorization` header.
    pub(super) fn header(&self) -> String {
        format!("Basic {}", STANDARD.encode(format!("{}:{}", self.user, self.password)))
    }
}

/// The registry that a key of a pull secret is for: `https://index.docker.io/v1/` is `docker.io`.
fn host(key: &str) -> &str {
    let key = key.split_once("://").map_or(key, |(_, rest)| rest);
    match key.split('/').next().unwrap_or_default() {
        "index.docker.io" | "registry-1.docker.io" => "docker.io",
        host => host,
    }
}

/// What a registry asks for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Challenge {
    /// Name and password with each request.
    Basic,
    /// A token from this address.
    Bearer { realm: String, service: Option<String> },
}

/// Reads a `WWW-Authenticate` header.
pub(super) fn challenge(header: &str) -> Option<Challenge> {
    let (scheme, rest) = header.trim().split_once(' ').unwrap_or((header.trim(), ""));
    if scheme.eq_ignore_ascii_case("basic") {
        return Some(Challenge::Basic);
    }
    if !scheme.eq_ignore_ascii_case("bearer") {
        return None;
    }
    Some(Challenge::Bearer {
        realm: parameter(rest, "realm")?,
        service: parameter(rest, "service"),
    })
}

/// `name="value"` of a list of them.
fn parameter(list: &str, wanted: &str) -> Option<String> {
    let mut rest = list.trim_start_matches([',', ' ']);
    while let Some((name, after)) = rest.split_once("=\"") {
        let (value, next) = after.split_once('"')?;
        if name.trim().eq_ignore_ascii_case(wanted) {
            return Some(value.to_owned());
        }
        rest = next.trim_start_matches([',', ' ']);
    }
    None
}

/// The token in an answer of a realm.
pub(super) fn token(body: &[u8]) -> Option<String> {
    let body: Value = serde_json::from_slice(body).ok()?;
    let token = body.get("token").or_else(|| body.get("access_token"))?.as_str()?;
    let is_sendable = !token.is_empty() && token.bytes().all(|byte| byte.is_ascii_graphic());
    is_sendable.then(|| token.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn a_pull_secret_is_read_for_its_registry_alone() {
        let secret = json!({"auths": {
            "r.example": {"username": "u", "password": "p"},
            "https://index.docker.io/v1/": {"auth": STANDARD.encode("hub:secret:x")},
            "broken.example": {"auth": "%%%"},
            "empty.example": {"username": "", "password": ""},
        }});
        let secret = secret.to_string();
        let of = |registry: &str| Credentials::of_secret(secret.as_bytes(), registry);
        assert_eq!(of("r.example"), Credentials::new("u", "p"));
        assert_eq!(of("docker.io"), Credentials::new("hub", "secret:x"));
        for none in ["r.example:443", "xr.example", "broken.example", "empty.example", ""] {
            assert_eq!(of(none), None, "{none}");
        }
        assert_eq!(Credentials::of_secret(b"[]", "r.example"), None);
        assert_eq!(format!("{:?}", of("r.example").unwrap()), "Credentials(…)");
    }

    #[test]
    fn what_a_registry_asks_for_is_read() {
        let bearer = |realm: &str, service: Option<&str>| {
            Some(Challenge::Bearer {
                realm: realm.into(),
                service: service.map(Into::into),
            })
        };
        for (header, wanted) in [
            ("Basic realm=\"x\"", Some(Challenge::Basic)),
            ("basic", Some(Challenge::Basic)),
            (
                "Bearer realm=\"https://auth.example/token\",service=\"r.example\",scope=\"a:b,c:d\"",
                bearer("https://auth.example/token", Some("r.example")),
            ),
            ("Bearer scope=\"x\", realm=\"https://a\"", bearer("https://a", None)),
            ("Bearer", None),
            ("Bearer realm=\"https://a", None),
            ("Negotiate", None),
            ("", None),
        ] {
            assert_eq!(challenge(header), wanted, "{header}");
        }
    }

    #[test]
    fn a_token_that_cannot_be_sent_is_none() {
        let of = |value: Value| token(value.to_string().as_bytes());
        assert_eq!(of(json!({"token": "t"})), Some("t".into()));
        assert_eq!(of(json!({"access_token": "t"})), Some("t".into()));
        for none in [
            json!({}),
            json!({"token": 1}),
            json!({"token": "a\r\nb"}),
            json!({"token": ""}),
        ] {
            assert_eq!(of(none.clone()), None, "{none}");
        }
    }
}
