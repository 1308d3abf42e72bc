//! EvalAI's token in Secrets Manager, against the AWS stand-in.

use super::bridge::StandIn;
use leaderboard_api::SecretsManagerKey;
use leaderboard_evalai::token::TokenError;
use leaderboard_operator::leaderboards::token::of_entry;

impl StandIn {
    fn token(&self, name: &str, key: &str) -> SecretsManagerKey {
        SecretsManagerKey {
            id: self.name(name),
            key: key.to_owned(),
            region: None,
            endpoint: Some(self.endpoint.clone()),
        }
    }

    async fn store(&self, name: &str, text: &str) {
        let client = self.aws.secrets(None, Some(&self.endpoint));
        let request = client.create_secret().name(self.name(name)).secret_string(text);
        request.send().await.unwrap();
    }
}

#[tokio::test]
async fn it_is_read_from_a_key_of_the_entry() {
    let stand_in = StandIn::start().await;
    let key = "0123456789abcdef0123456789abcdef01234567";
    let text = format!(r#"{{"auth_token": "Token {key}\n", "api_server": "https://eval.ai", "challenge_pk": 2098}}"#);
    stand_in.store("evalai", &text).await;
    let token = of_entry(&stand_in.aws, &stand_in.token("evalai", "auth_token"))
        .await
        .unwrap();
    assert_eq!((token.scheme(), token.expires()), ("Token", None));
}

#[tokio::test]
async fn why_there_is_none_is_an_error_without_what_is_stored() {
    let stand_in = StandIn::start().await;
    stand_in.store("keyless", r#"{"other": "very-secret"}"#).await;
    stand_in.store("plain", "very-secret").await;
    stand_in.store("empty", r#"{"auth_token": " "}"#).await;
    for (name, text) in [
        ("missing", "check its name, region and the permission to read it"),
        ("keyless", "check token.secretsManager.key"),
        ("plain", "check token.secretsManager.key"),
        ("empty", "put a host's refresh token there"),
    ] {
        let error: TokenError = of_entry(&stand_in.aws, &stand_in.token(name, "auth_token"))
            .await
            .unwrap_err();
        let error = error.to_string();
        assert!(
            error.contains(text) && !error.contains("very-secret"),
            "{name}: {error}"
        );
    }
}

#[tokio::test]
async fn a_new_value_of_the_entry_is_another_token() {
    let stand_in = StandIn::start().await;
    stand_in.store("evalai", r#"{"auth_token": "one"}"#).await;
    let place = stand_in.token("evalai", "auth_token");
    let old = of_entry(&stand_in.aws, &place).await.unwrap();
    let client = stand_in.aws.secrets(None, Some(&stand_in.endpoint));
    let put = client.put_secret_value().secret_id(stand_in.name("evalai"));
    put.secret_string(r#"{"auth_token": "two"}"#).send().await.unwrap();
    let new = of_entry(&stand_in.aws, &place).await.unwrap();
    assert!(old != new && old.digest() != new.digest());
}
