//! The password of Amazon's registries: `GetAuthorizationToken`, one call that is signed here. It is the only one that is needed of
//! ECR, whose client would be the largest crate of the program.

use std::collections::HashMap;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, SystemTime};

use aws_credential_types::provider::ProvideCredentials;
use aws_sigv4::http_request::{SignableBody, SignableRequest, SigningSettings, sign};
use aws_sigv4::sign::v4::SigningParams;
use serde_json::Value;
use tokio::time::Instant;

use super::auth::Credentials;
use crate::services::aws::Aws;

/// A password holds for twelve hours.
const HOLDS: Duration = Duration::from_hours(6);
/// Largest answer that is read.
const LARGEST: usize = 64 << 10;
/// Regions whose passwords are kept: participants may choose the region.
const MOST_KEPT: usize = 64;
const TARGET: &str = "AmazonEC2ContainerRegistry_V20150921.GetAuthorizationToken";
const CONTENT: &str = "application/x-amz-json-1.1";

/// The region of a registry of Amazon, and the end of its names there.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Place<'a> {
    region: &'a str,
    domain: &'a str,
}

/// `123456789012.dkr.ecr.us-east-1.amazonaws.com` is in us-east-1.
fn place(registry: &str) -> Option<Place<'_>> {
    let (account, rest) = registry.split_once(".dkr.ecr.")?;
    let (region, domain) = rest.split_once('.')?;
    let is_account = account.len() == 12 && account.bytes().all(|b| b.is_ascii_digit());
    let is_region = region
        .bytes()
        .all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-');
    let is_amazons = matches!(domain, "amazonaws.com" | "amazonaws.com.cn");
    (is_account && is_region && is_amazons).then_some(Place { region, domain })
}

/// Whether a registry is Amazon's.
pub(super) fn is_ecr(registry: &str) -> bool {
    place(registry).is_some()
}

/// The passwords, by region.
pub(super) struct Ecr {
    aws: Aws,
    http: reqwest::Client,
    kept: Mutex<HashMap<String, (Credentials, Instant)>>,
}

impl Ecr {
    pub(super) fn new(aws: Aws, http: reqwest::Client) -> Self {
        Self {
            aws,
            http,
            kept: Mutex::default(),
        }
    }

    /// Credentials for a registry; an error says what AWS has answered, for hosts.
    pub(super) async fn credentials(&self, registry: &str) -> Result<Credentials, String> {
        let place = place(registry).ok_or("it is not a registry of Amazon")?;
        if let Some(known) = self.known(place.region) {
            return Ok(known);
        }
        let found = self.ask(&place).await?;
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        kept.retain(|_, (_, at)| at.elapsed() < HOLDS);
        if kept.len() < MOST_KEPT {
            kept.insert(place.region.to_owned(), (found.clone(), Instant::now()));
        }
        Ok(found)
    }

    fn known(&self, region: &str) -> Option<Credentials> {
        let kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        let (known, at) = kept.get(region)?;
        (at.elapsed() < HOLDS).then(|| known.clone())
    }

    async fn ask(&self, place: &Place<'_>) -> Result<Credentials, String> {
        let running = self.aws.meter().begin("ecr", "GetAuthorizationToken");
        let answer = self.send(place).await;
        running.end(if answer.is_ok() { "ok" } else { "refused" });
        answer
    }

    async fn send(&self, place: &Place<'_>) -> Result<Credentials, String> {
        let config = self.aws.config(Some(place.region));
        let usual = || format!("https://api.ecr.{}.{}/", place.region, place.domain);
        let url = config.endpoint_url().map_or_else(usual, ToOwned::to_owned);
        let headers = self.signed(&url, place.region).await?;
        let mut request = self.http.post(&url).body("{}");
        for (name, value) in headers {
            request = request.header(name, value);
        }
        let answer = request
            .send()
            .await
            .map_err(|_| "ECR could not be reached".to_owned())?;
        let status = answer.status();
        if !status.is_success() {
            let step = "give the operator ecr:GetAuthorizationToken, ecr:BatchGetImage and ecr:GetDownloadUrlForLayer";
            return Err(format!("ECR gives no token ({status}); {step}"));
        }
        let body = super::body(answer, LARGEST).await?;
        password(&body).ok_or_else(|| "ECR's answer has no token".to_owned())
    }

    /// The headers of the request, its signature among them.
    async fn signed(&self, url: &str, region: &str) -> Result<Vec<(String, String)>, String> {
        let config = self.aws.config(Some(region));
        let none = || "the operator has no AWS credentials".to_owned();
        let provider = config.credentials_provider().ok_or_else(none)?;
        let identity = provider.provide_credentials().await.map_err(|_| none())?.into();
        let params = SigningParams::builder()
            .identity(&identity)
            .region(region)
            .name("ecr")
            .time(SystemTime::now())
            .settings(SigningSettings::default())
            .build();
        let unsigned = || "the request to ECR could not be signed".to_owned();
        let params = params.map_err(|_| unsigned())?.into();
        let program = config.app_name().map_or_else(String::new, |name| format!("app/{name}"));
        let own = [
            ("content-type", CONTENT),
            ("x-amz-target", TARGET),
            ("x-amz-user-agent", &program),
        ];
        let request = SignableRequest::new("POST", url, own.into_iter(), SignableBody::Bytes(b"{}"));
        let signed = request.and_then(|request| sign(request, &params));
        let (instructions, _) = signed.map_err(|_| unsigned())?.into_parts();
        let added = instructions
            .headers()
            .map(|(name, value)| (name.to_owned(), value.to_owned()));
        let own = own.map(|(name, value)| (name.to_owned(), value.to_owned()));
        Ok(own.into_iter().chain(added).collect())
    }
}

fn password(body: &[u8]) -> Option<Credentials> {
    let body: Value = serde_json::from_slice(body).ok()?;
    let first = body.get("authorizationData")?.get(0)?;
    Credentials::decode(first.get("authorizationToken")?.as_str()?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_amazons_own_names_are_its_registries() {
        for (registry, region) in [
            ("123456789012.dkr.ecr.us-east-1.amazonaws.com", Some("us-east-1")),
            ("123456789012.dkr.ecr.cn-north-1.amazonaws.com.cn", Some("cn-north-1")),
            ("123456789012.dkr.ecr.us-east-1.amazonaws.com.evil.example", None),
            ("123456789012.dkr.ecr.us-east-1.amazonaws.com:443", None),
            ("12345678901.dkr.ecr.us-east-1.amazonaws.com", None),
            ("x.123456789012.dkr.ecr.us-east-1.amazonaws.com", None),
            ("123456789012.dkr.ecr.us.east.amazonaws.com", None),
            ("r.example", None),
        ] {
            assert_eq!(place(registry).map(|place| place.region), region, "{registry}");
        }
    }

    #[test]
    fn a_password_is_found_in_ecrs_answer() {
        let body = br#"{"authorizationData": [{"authorizationToken": "QVdTOnA=", "proxyEndpoint": "https://x"}]}"#;
        assert_eq!(password(body), Credentials::new("AWS", "p"));
        for body in [b"{}".as_slice(), b"[]", br#"{"authorizationData": []}"#] {
            assert_eq!(password(body), None);
        }
    }
}
