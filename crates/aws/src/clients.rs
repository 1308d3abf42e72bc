//! One way to AWS: one HTTP client with one TLS stack, one credential chain, and clients by region and endpoint.
//!
//! Called by everything that talks to AWS. An endpoint that a Leaderboard names goes before one of the environment.
//! Endpoints with a bare host name get path-style buckets.

use std::ffi::OsString;
use std::time::Duration;

use aws_config::retry::RetryConfig;
use aws_config::timeout::TimeoutConfig;
use aws_config::{AppName, BehaviorVersion, Region, SdkConfig};
use aws_sdk_s3::config::{RequestChecksumCalculation, ResponseChecksumValidation};
use aws_smithy_http_client::tls::Provider;
use aws_smithy_http_client::tls::rustls_provider::CryptoMode;

use leaderboard_api::names::OPERATOR;
use leaderboard_base::meter::Meter;

/// Where nothing sets the region.
pub const USUAL_REGION: &str = "us-east-1";
/// Time an AWS call may take, with its retries.
const OPERATION_TIMEOUT: Duration = Duration::from_mins(1);
/// Time one try may take.
const ATTEMPT_TIMEOUT: Duration = Duration::from_secs(20);

/// A variable with an endpoint that no log may show.
#[derive(thiserror::Error, Debug, PartialEq, Eq)]
#[error(
    "{0} may hold neither a query nor credentials, since logs show it: AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or a role, sign what is \
     asked there"
)]
pub struct UnfitEndpoint(String);

/// Refuses an endpoint of the environment that is no plain one, as the API does one of a Leaderboard.
pub fn check_endpoints(variables: impl IntoIterator<Item = (OsString, OsString)>) -> Result<(), UnfitEndpoint> {
    let texts = variables.into_iter().map(|(name, value)| {
        let text = |part: OsString| part.to_string_lossy().into_owned();
        (text(name), text(value))
    });
    let mut endpoints = texts.filter(|(name, _)| name.starts_with("AWS_ENDPOINT_URL"));
    match endpoints.find(|(_, value)| value.contains(['?', '#', '@'])) {
        Some((name, _)) => Err(UnfitEndpoint(name)),
        None => Ok(()),
    }
}

/// The configuration of one service with an endpoint, where one is given. It is set here and not in the shared
/// configuration, because of that one the SDK prefers `AWS_ENDPOINT_URL` and the profile's `endpoint_url`.
macro_rules! own {
    ($sdk:ident, $shared:expr, $endpoint:expr) => {{
        let builder = $sdk::config::Builder::from(&$shared);
        match $endpoint {
            Some(endpoint) => builder.endpoint_url(endpoint),
            None => builder,
        }
    }};
}

/// The times that one try may take, and a call with its retries.
pub(crate) fn timeouts(attempt: Duration, operation: Duration) -> TimeoutConfig {
    TimeoutConfig::builder()
        .connect_timeout(Duration::from_secs(5))
        .operation_attempt_timeout(attempt)
        .operation_timeout(operation)
        .build()
}

/// Loaded once for a process.
#[derive(Clone, Debug)]
pub struct Aws {
    base: SdkConfig,
    meter: Meter,
}

impl Aws {
    /// Reads region and credentials from where AWS's SDKs look for them. Each request names the program, which CloudTrail then shows.
    pub async fn load(program: &str) -> Self {
        let https = aws_smithy_http_client::Builder::new().tls_provider(Provider::Rustls(CryptoMode::Ring));
        let mut loader = aws_config::defaults(BehaviorVersion::latest())
            .http_client(https.build_https())
            .timeout_config(timeouts(ATTEMPT_TIMEOUT, OPERATION_TIMEOUT));
        if let Ok(name) = AppName::new(format!("{OPERATOR}-{program}")) {
            loader = loader.app_name(name);
        }
        Self::from_config(loader.load().await)
    }

    /// From a ready configuration, for tests and for assumed roles.
    pub fn from_config(base: SdkConfig) -> Self {
        Self {
            base,
            meter: Meter::default(),
        }
    }

    /// This way, with its calls counted.
    #[must_use]
    pub fn counted_by(self, meter: Meter) -> Self {
        Self { meter, ..self }
    }

    /// Meter of the calls.
    pub fn meter(&self) -> &Meter {
        &self.meter
    }

    /// The region that was found, if any.
    pub fn region(&self) -> Option<String> {
        self.base.region().map(ToString::to_string)
    }

    /// The shared configuration for a region, where one is given. No endpoint: see [`own`].
    pub fn config(&self, region: Option<&str>) -> SdkConfig {
        let mut builder = self.base.clone().into_builder();
        if let Some(region) = region {
            builder = builder.region(Region::new(region.to_owned()));
        } else if self.base.region().is_none() {
            builder = builder.region(Region::new(USUAL_REGION));
        }
        builder.build()
    }

    /// A client of S3. An endpoint of one's own gets path-style addresses: its buckets have no host names.
    pub fn s3(&self, region: Option<&str>, endpoint: Option<&str>) -> aws_sdk_s3::Client {
        let shared = self.config(region);
        let mut config = own!(aws_sdk_s3, shared, endpoint).force_path_style(endpoint.is_some());
        if shared.request_checksum_calculation() == Some(RequestChecksumCalculation::WhenRequired) {
            // A store that takes no checksum is not asked for one either.
            config = config.response_checksum_validation(ResponseChecksumValidation::WhenRequired);
        }
        aws_sdk_s3::Client::from_conf(config.build())
    }

    /// A client of SQS. Long polls outlive the usual limit of one try.
    pub fn sqs(&self, region: Option<&str>, endpoint: Option<&str>) -> aws_sdk_sqs::Client {
        let timeouts = timeouts(Duration::from_secs(35), OPERATION_TIMEOUT);
        let config = own!(aws_sdk_sqs, self.config(region), endpoint).timeout_config(timeouts);
        aws_sdk_sqs::Client::from_conf(config.build())
    }

    /// A client of DynamoDB.
    pub fn dynamodb(&self, region: Option<&str>, endpoint: Option<&str>) -> aws_sdk_dynamodb::Client {
        aws_sdk_dynamodb::Client::from_conf(own!(aws_sdk_dynamodb, self.config(region), endpoint).build())
    }

    /// A client of CloudWatch Logs. A retry after a lost answer would write the same lines twice.
    pub fn logs(&self, region: Option<&str>, endpoint: Option<&str>) -> aws_sdk_cloudwatchlogs::Client {
        let config = own!(aws_sdk_cloudwatchlogs, self.config(region), endpoint);
        aws_sdk_cloudwatchlogs::Client::from_conf(config.retry_config(RetryConfig::disabled()).build())
    }

    /// A client of Secrets Manager.
    pub fn secrets(&self, region: Option<&str>, endpoint: Option<&str>) -> aws_sdk_secretsmanager::Client {
        aws_sdk_secretsmanager::Client::from_conf(own!(aws_sdk_secretsmanager, self.config(region), endpoint).build())
    }

    /// A client of STS. It has no endpoint in the API: the environment's, or the region's.
    pub fn sts(&self, region: Option<&str>) -> aws_sdk_sts::Client {
        aws_sdk_sts::Client::new(&self.config(region))
    }
}

#[cfg(test)]
mod tests;
