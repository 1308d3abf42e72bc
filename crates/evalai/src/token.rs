//! Tokens of EvalAI: what kind they are, when they end, why there is none.
//!
//! Called by the controller, which reads Secrets and hands a [`Token`] to `hub`. Knows the text of a token and never shows its value.

use std::fmt;

use base64::Engine;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use jiff::{SignedDuration, Timestamp};
use serde_json::{Map, Value};
use sha2::{Digest, Sha256};

/// How long before its end a token's renewal is asked for.
const WARN_BEFORE: SignedDuration = SignedDuration::from_hours(30 * 24);

/// Before a JWT refresh token, as EvalAI's profile page gives it.
const BEARER: &str = "Bearer";
/// Before a key of 40 hexadecimal digits, as EvalAI's login gives it.
const TOKEN: &str = "Token";

/// A token that can be sent. Its value appears in no `Debug` and no message.
#[derive(Clone, PartialEq, Eq)]
pub struct Token {
    scheme: &'static str,
    value: String,
    expires: Option<Timestamp>,
    user: Option<String>,
}

/// Why there is no token.
#[derive(thiserror::Error, Debug, PartialEq, Eq)]
pub enum TokenError {
    /// Nothing but white space.
    #[error("the token is empty; put a host's refresh token there")]
    Empty,
    /// Characters no token has.
    #[error("the token holds spaces, line breaks or other characters that no token has; store it again")]
    Characters,
    /// An access token, which EvalAI refuses.
    #[error("the token is an access token, which EvalAI refuses; use the refresh token of the profile page")]
    Access,
    /// Secrets Manager did not give the entry.
    #[error(
        "the entry {id} of Secrets Manager could not be read ({why}); check its name, region and the permission to read it"
    )]
    Unreadable { id: String, why: String },
    /// The entry holds no such key.
    #[error("the entry {id} of Secrets Manager has no text under the key {key}; check token.secretsManager.key")]
    NoKey { id: String, key: String },
}

impl Token {
    /// Reads a token as people store it: with or without the scheme and white space around it.
    pub fn parse(text: &str) -> Result<Self, TokenError> {
        let text = text.trim();
        let value = match text.split_once(char::is_whitespace) {
            Some((BEARER | TOKEN, value)) => value.trim(),
            _ => text,
        };
        if value.is_empty() || matches!(value, BEARER | TOKEN) {
            return Err(TokenError::Empty);
        }
        if !value.bytes().all(|byte| byte.is_ascii_graphic()) {
            return Err(TokenError::Characters);
        }
        let is_key = value.len() == 40 && value.bytes().all(|byte| byte.is_ascii_hexdigit());
        let claims = claims(value).unwrap_or_default();
        if claims.get("token_type").and_then(Value::as_str) == Some("access") {
            return Err(TokenError::Access);
        }
        let expires = claims
            .get("exp")
            .and_then(Value::as_i64)
            .and_then(|at| Timestamp::from_second(at).ok());
        let user = match claims.get("user_id") {
            Some(Value::Number(id)) => Some(id.to_string()),
            Some(Value::String(id)) => Some(id.clone()),
            _ => None,
        };
        Ok(Self {
            scheme: if is_key { TOKEN } else { BEARER },
            value: value.into(),
            expires,
            user,
        })
    }

    /// The scheme before it in the `Authorization` header.
    pub fn scheme(&self) -> &'static str {
        self.scheme
    }

    /// The value of the `Authorization` header.
    pub(crate) fn header(&self) -> String {
        format!("{} {}", self.scheme, self.value)
    }

    /// When it ends, if it holds that.
    pub fn expires(&self) -> Option<Timestamp> {
        self.expires
    }

    /// True if it ends within [`WARN_BEFORE`], or has ended.
    pub fn ends_soon(&self, now: Timestamp) -> bool {
        self.expires.is_some_and(|at| at.duration_since(now) <= WARN_BEFORE)
    }

    /// Tells it from every other token, without its value.
    pub fn digest(&self) -> [u8; 32] {
        Sha256::digest(self.value.as_bytes()).into()
    }

    /// Its name in logs, without its value.
    pub fn label(&self) -> String {
        let digest = self.digest();
        let start: [u8; 8] = std::array::from_fn(|index| digest[index]);
        format!("token-{:016x}", u64::from_be_bytes(start))
    }

    /// The user with whose requests EvalAI counts it, as the token itself claims: only EvalAI can verify that, so nothing but a budget may
    /// depend on it. One that names no user is counted alone.
    pub fn claimed_user(&self) -> String {
        self.user
            .as_ref()
            .map_or_else(|| self.label(), |user| format!("user-{user}"))
    }
}

impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Token")
            .field("scheme", &self.scheme)
            .field("expires", &self.expires)
            .finish_non_exhaustive()
    }
}

/// The claims of a JWT, unverified: only EvalAI can verify them.
fn claims(value: &str) -> Option<Map<String, Value>> {
    let mut parts = value.split('.');
    let (_, claims, _, None) = (parts.next()?, parts.next()?, parts.next()?, parts.next()) else {
        return None;
    };
    let bytes = URL_SAFE_NO_PAD.decode(claims.trim_end_matches('=')).ok()?;
    serde_json::from_slice(&bytes).ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn jwt(claims: &Value) -> String {
        let part = |value: &Value| URL_SAFE_NO_PAD.encode(value.to_string());
        format!("{}.{}.c2lnbmF0dXJl", part(&json!({"alg": "HS256"})), part(claims))
    }

    #[test]
    fn the_scheme_follows_from_the_value() {
        let key = "0123456789abcdef0123456789ABCDEF01234567";
        for (text, scheme, header) in [
            (key.to_owned(), TOKEN, format!("Token {key}")),
            (format!("Token {key}\n"), TOKEN, format!("Token {key}")),
            (
                "local-host-token".to_owned(),
                BEARER,
                "Bearer local-host-token".to_owned(),
            ),
            (
                " Bearer local-host-token ".to_owned(),
                BEARER,
                "Bearer local-host-token".to_owned(),
            ),
            (key[1..].to_owned(), BEARER, format!("Bearer {}", &key[1..])),
        ] {
            let token = Token::parse(&text).unwrap();
            assert_eq!((token.scheme(), token.header()), (scheme, header), "{text:?}");
        }
    }

    #[test]
    fn what_cannot_be_a_token_is_refused_with_the_next_step() {
        let access = jwt(&json!({"token_type": "access", "exp": 1}));
        for (text, error) in [
            ("  \n", TokenError::Empty),
            ("Bearer ", TokenError::Empty),
            ("two words", TokenError::Characters),
            ("a\nb", TokenError::Characters),
            (access.as_str(), TokenError::Access),
        ] {
            assert_eq!(Token::parse(text), Err(error), "{text:?}");
        }
    }

    #[test]
    fn the_end_of_a_jwt_is_read_without_verifying_it() {
        let end = Timestamp::from_second(2_000_000_000).unwrap();
        let token = Token::parse(&jwt(
            &json!({"token_type": "refresh", "exp": 2_000_000_000, "user_id": 7}),
        ))
        .unwrap();
        assert_eq!(token.expires(), Some(end));
        assert!(!token.ends_soon(end - SignedDuration::from_hours(31 * 24)));
        assert!(token.ends_soon(end - SignedDuration::from_hours(29 * 24)));
        assert!(token.ends_soon(end + SignedDuration::from_hours(1)));
        let plain = Token::parse("local-host-token").unwrap();
        assert_eq!((plain.expires(), plain.ends_soon(end)), (None, false));
    }

    #[test]
    fn tokens_of_one_user_are_two_tokens_with_one_budget() {
        let of = |claims: Value| Token::parse(&jwt(&claims)).unwrap();
        let (one, other) = (
            of(json!({"user_id": 7, "exp": 1})),
            of(json!({"user_id": "7", "exp": 2})),
        );
        assert_eq!(one.claimed_user(), other.claimed_user());
        assert_ne!(one.digest(), other.digest());
        assert_ne!(one.claimed_user(), of(json!({"user_id": 8})).claimed_user());
        let plain = |text: &str| Token::parse(text).unwrap();
        assert_ne!(plain("one").claimed_user(), plain("other").claimed_user());
        assert!(!plain("local-host-token").label().contains("local"));
    }

    #[test]
    fn the_value_is_in_no_debug() {
        let token = Token::parse("local-host-token").unwrap();
        assert_eq!(format!("{token:?}"), r#"Token { scheme: "Bearer", expires: None, .. }"#);
    }
}
