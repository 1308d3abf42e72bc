//! A Leaderboard's token of EvalAI in AWS Secrets Manager.

use serde_json::{Map, Value};

use leaderboard_api::SecretsManagerKey;
use leaderboard_aws::clients::Aws;
use leaderboard_aws::secrets::secret_text;
use leaderboard_evalai::token::{Token, TokenError};

/// Reads the token under a key of a JSON object in AWS Secrets Manager.
pub async fn of_entry(aws: &Aws, place: &SecretsManagerKey) -> Result<Token, TokenError> {
    let (id, region, endpoint) = (&place.id, place.region.as_deref(), place.endpoint.as_deref());
    let text = secret_text(aws, id, region, endpoint).await;
    let text = text.map_err(|why| TokenError::Unreadable { id: id.clone(), why })?;
    Token::parse(&entry(id, &place.key, &text)?)
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
