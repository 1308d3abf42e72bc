//! The password of Amazon's registries: `GetAuthorizationToken`, one call that is signed here. It is the only one that is needed of
//! ECR, whose client would be the largest crate of the program.

use std::collections::HashMap;
use std::sync::{Mutex, MutexGuard};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use aws_credential_types::provider::ProvideCredentials;
use aws_sigv4::http_request::{SignableBody, SignableRequest, SigningSettings, sign};
use aws_sigv4::sign::v4::SigningParams;
use serde_json::Value;
use tokio::time::Instant;

use super::auth::Credentials;
use crate::lock::lock;
use crate::services::aws::Aws;

/// How long a password is kept at most; it usually holds for twelve hours.
const HOLDS: Duration = Duration::from_hours(6);
/// A new one is fetched so long before the old one ends.
const MARGIN: Duration = Duration::from_mins(5);
/// One that is refused, and is younger than this, would be refused again.
const FRESH: Duration = Duration::from_secs(10);
/// Largest answer that is read.
const LARGEST: usize = 64 << 10;
/// Regions whose passwords are kept: participants may choose the region.
const MOST_KEPT: usize = 64;
const TARGET: &str = "AmazonEC2ContainerRegistry_V20150921.GetAuthorizationToken";
const CONTENT: &str = "application/x-amz-json-1.1";

/// The region of a registry of Amazon, and the end of its names there.
#[derive(Clone, Debug, PartialEq, Eq)]
struct AmazonRegistry<'a> {
    region: &'a str,
    domain: &'a str,
}

/// `123456789012.dkr.ecr.us-east-1.amazonaws.com` is in us-east-1.
fn place(registry: &str) -> Option<AmazonRegistry<'_>> {
    let (account, rest) = registry.split_once(".dkr.ecr.")?;
    let (region, domain) = rest.split_once('.')?;
    let is_account = account.len() == 12 && account.bytes().all(|b| b.is_ascii_digit());
    let is_region = region
        .bytes()
        .all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-');
    let is_amazons = matches!(domain, "amazonaws.com" | "amazonaws.com.cn");
    (is_account && is_region && is_amazons).then_some(AmazonRegistry { region, domain })
}

/// A password, from when on it is known, and until when it is used.
#[derive(Clone)]
struct Kept {
    credentials: Credentials,
    since: Instant,
    until: Instant,
}

/// The passwords, by region.
pub(super) struct Ecr {
    aws: Aws,
    http: reqwest::Client,
    kept: Mutex<HashMap<String, Kept>>,
    /// Which registries are Amazon's, and where.
    place: for<'a> fn(&'a str) -> Option<AmazonRegistry<'a>>,
}

impl Ecr {
    pub(super) fn new(aws: Aws, http: reqwest::Client) -> Self {
        Self {
            aws,
            http,
            kept: Mutex::default(),
            place,
        }
    }

    /// Whether a registry is Amazon's.
    pub(super) fn is_ecr(&self, registry: &str) -> bool {
        (self.place)(registry).is_some()
    }

    /// Credentials for a registry; an error shows what AWS has answered, for hosts.
    pub(super) async fn credentials(&self, registry: &str) -> Result<Credentials, String> {
        let place = (self.place)(registry).ok_or("it is not a registry of Amazon")?;
        if let Some(known) = self.known(place.region) {
            return Ok(known);
        }
        let found = self.ask(&place).await?;
        let mut kept = self.kept();
        let now = Instant::now();
        kept.retain(|_, kept| now < kept.until);
        if kept.len() < MOST_KEPT {
            kept.insert(place.region.to_owned(), found.clone());
        }
        Ok(found.credentials)
    }

    /// Drops the password that a registry has refused. False if a new one would be refused as well.
    pub(super) fn refused(&self, registry: &str) -> bool {
        let Some(place) = (self.place)(registry) else {
            return false;
        };
        let mut kept = self.kept();
        let is_old = kept.get(place.region).is_some_and(|kept| kept.since.elapsed() >= FRESH);
        is_old && kept.remove(place.region).is_some()
    }

    fn kept(&self) -> MutexGuard<'_, HashMap<String, Kept>> {
        lock(&self.kept)
    }

    fn known(&self, region: &str) -> Option<Credentials> {
        let kept = self.kept();
        let known = kept.get(region).filter(|known| Instant::now() < known.until)?;
        Some(known.credentials.clone())
    }

    async fn ask(&self, place: &AmazonRegistry<'_>) -> Result<Kept, String> {
        let running = self.aws.meter().begin("ecr", "GetAuthorizationToken");
        let answer = self.send(place).await;
        running.end(if answer.is_ok() { "ok" } else { "refused" });
        answer
    }

    async fn send(&self, place: &AmazonRegistry<'_>) -> Result<Kept, String> {
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
        let (credentials, ends) = password(&body).ok_or_else(|| "ECR's answer has no token".to_owned())?;
        let since = Instant::now();
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let until = since + used_for(ends, now);
        Ok(Kept {
            credentials,
            since,
            until,
        })
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

/// A password, and when it ends, in time since 1970.
fn password(body: &[u8]) -> Option<(Credentials, Option<Duration>)> {
    let body: Value = serde_json::from_slice(body).ok()?;
    let first = body.get("authorizationData")?.get(0)?;
    let ends = first.get("expiresAt").and_then(Value::as_f64);
    let ends = ends.and_then(|seconds| Duration::try_from_secs_f64(seconds).ok());
    Some((Credentials::decode(first.get("authorizationToken")?.as_str()?)?, ends))
}

/// How long a password is used from now on.
fn used_for(ends: Option<Duration>, now: Duration) -> Duration {
    ends.map_or(HOLDS, |ends| ends.saturating_sub(now).saturating_sub(MARGIN).min(HOLDS))
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
        let aws = || Credentials::new("AWS", "p").unwrap();
        let body = br#"{"authorizationData": [{"authorizationToken": "QVdTOnA=", "proxyEndpoint": "https://x"}]}"#;
        assert!(password(body) == Some((aws(), None)));
        let body = br#"{"authorizationData": [{"authorizationToken": "QVdTOnA=", "expiresAt": 1.5}]}"#;
        assert!(password(body) == Some((aws(), Some(Duration::from_millis(1500)))));
        for body in [b"{}".as_slice(), b"[]", br#"{"authorizationData": []}"#] {
            assert!(password(body).is_none());
        }
    }

    #[test]
    fn a_password_is_renewed_before_it_ends() {
        let (now, hours) = (Duration::from_hours(500_000), Duration::from_hours);
        for (ends, expected) in [
            (None, HOLDS),
            (Some(now + hours(12)), HOLDS),
            (Some(now + hours(1)), Duration::from_mins(55)),
            (Some(now + MARGIN), Duration::ZERO),
            (now.checked_sub(hours(1)), Duration::ZERO),
            (Some(Duration::MAX), HOLDS),
        ] {
            assert_eq!(used_for(ends, now), expected, "{ends:?}");
        }
    }
}

#[cfg(test)]
#[path = "ecr_tests.rs"]
mod stand_in;
