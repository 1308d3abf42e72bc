//! Where a Leaderboard's token of EvalAI is kept: in a Kubernetes Secret, or in AWS Secrets Manager.

use std::fmt;

use serde_json::{Map, Value};

use leaderboard_aws::clients::Aws;
use leaderboard_aws::secrets::secret_text;
use leaderboard_evalai::token::{Token, TokenError};

/// Where a token comes from.
#[derive(Clone, PartialEq, Eq)]
pub enum TokenSource {
    /// The text of a key of a Kubernetes Secret, already read.
    Literal(String),
    /// A key of a JSON object in AWS Secrets Manager.
    SecretsManager {
        id: String,
        key: String,
        region: Option<String>,
        endpoint: Option<String>,
    },
}

impl TokenSource {
    /// Reads the token. Only Secrets Manager needs the network.
    pub async fn read(&self, aws: &Aws) -> Result<Token, TokenError> {
        match self {
            Self::Literal(text) => Token::parse(text),
            Self::SecretsManager {
                id,
                key,
                region,
                endpoint,
            } => {
                let text = secret_text(aws, id, region.as_deref(), endpoint.as_deref()).await;
                let text = text.map_err(|why| TokenError::Unreadable { id: id.clone(), why })?;
                Token::parse(&entry(id, key, &text)?)
            }
        }
    }
}

impl fmt::Debug for TokenSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Literal(_) => f.write_str("Literal(…)"),
            Self::SecretsManager { id, key, .. } => write!(f, "SecretsManager({id}, {key})"),
        }
    }
}

/// The text under a key of the entry's JSON object.
fn entry(id: &str, key: &str, text: &str) -> Result<String, TokenError> {
    let fields: Map<String, Value> = serde_json::from_str(text).unwrap_or_default();
    let found = fields.get(key).and_then(Value::as_str).map(str::to_owned);
    found.ok_or_else(|| TokenError::NoKey {
        id: id.into(),
        key: key.into(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_value_is_in_no_debug() {
        let source = TokenSource::Literal("local-host-token".into());
        assert_eq!(format!("{source:?}"), "Literal(…)");
    }

    #[test]
    fn a_key_of_the_entry_is_found_or_named() {
        assert_eq!(
            entry("evalai", "auth_token", r#"{"auth_token": "x", "other": 1}"#),
            Ok("x".into())
        );
        for text in ["", "x", "[]", "{}", r#"{"auth_token": 1}"#] {
            let error = entry("evalai", "auth_token", text).unwrap_err().to_string();
            assert!(error.contains("evalai") && error.contains("auth_token"), "{error}");
        }
    }
}
