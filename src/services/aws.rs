//! One way to AWS: one HTTP client with one TLS stack, one credential chain, and clients by region and endpoint.
//!
//! Called by everything that talks to AWS. Endpoints with a bare host name get path-style buckets.

use std::time::Duration;

use aws_config::{BehaviorVersion, Region, SdkConfig};
use aws_smithy_http_client::tls::{Provider, rustls_provider::CryptoMode};

use super::meter::Meter;

/// Time an AWS call may take, with its retries.
const OPERATION_TIMEOUT: Duration = Duration::from_mins(1);
/// Time one try may take.
const ATTEMPT_TIMEOUT: Duration = Duration::from_secs(20);

/// Loaded once for a process.
#[derive(Clone, Debug)]
pub struct Aws {
    base: SdkConfig,
    meter: Meter,
}

impl Aws {
    /// Reads region and credentials from where AWS's SDKs look for them.
    pub async fn load() -> Self {
        let http = aws_smithy_http_client::Builder::new()
            .tls_provider(Provider::Rustls(CryptoMode::Ring))
            .build_https();
        let timeouts = aws_config::timeout::TimeoutConfig::builder()
            .connect_timeout(Duration::from_secs(5))
            .operation_attempt_timeout(ATTEMPT_TIMEOUT)
            .operation_timeout(OPERATION_TIMEOUT)
            .build();
        let base = aws_config::defaults(BehaviorVersion::latest())
            .http_client(http)
            .timeout_config(timeouts)
            .load()
            .await;
        Self::from_config(base)
    }

    /// From a ready configuration, for tests and for assumed roles.
    pub fn from_config(base: SdkConfig) -> Self {
        Self {
            base,
            meter: Meter::default(),
        }
    }

    /// The same way, whose calls are counted.
    #[must_use]
    pub fn counted_by(self, meter: Meter) -> Self {
        Self { meter, ..self }
    }

    /// Who counts the calls.
    pub fn meter(&self) -> &Meter {
        &self.meter
    }

    /// The region that was found, if any.
    pub fn region(&self) -> Option<String> {
        self.base.region().map(ToString::to_string)
    }

    /// The configuration for a region and an endpoint, where given.
    pub fn config(&self, region: Option<&str>, endpoint: Option<&str>) -> SdkConfig {
        let mut builder = self.base.clone().into_builder();
        if let Some(region) = region {
            builder = builder.region(Region::new(region.to_owned()));
        } else if self.base.region().is_none() {
            builder = builder.region(Region::new("us-east-1"));
        }
        if let Some(endpoint) = endpoint {
            builder = builder.endpoint_url(endpoint);
        }
        builder.build()
    }

    /// A client of S3. An endpoint of one's own gets path-style addresses: its buckets have no host names.
    pub fn s3(&self, region: Option<&str>, endpoint: Option<&str>) -> aws_sdk_s3::Client {
        let config = aws_sdk_s3::config::Builder::from(&self.config(region, endpoint))
            .force_path_style(endpoint.is_some())
            .build();
        aws_sdk_s3::Client::from_conf(config)
    }

    /// A client of SQS. Long polls outlive the usual limit of one try.
    pub fn sqs(&self, region: Option<&str>, endpoint: Option<&str>) -> aws_sdk_sqs::Client {
        let timeouts = aws_config::timeout::TimeoutConfig::builder()
            .connect_timeout(Duration::from_secs(5))
            .operation_attempt_timeout(Duration::from_secs(35))
            .operation_timeout(OPERATION_TIMEOUT)
            .build();
        let config = aws_sdk_sqs::config::Builder::from(&self.config(region, endpoint))
            .timeout_config(timeouts)
            .build();
        aws_sdk_sqs::Client::from_conf(config)
    }

    /// A client of DynamoDB.
    pub fn dynamodb(&self, region: Option<&str>, endpoint: Option<&str>) -> aws_sdk_dynamodb::Client {
        aws_sdk_dynamodb::Client::new(&self.config(region, endpoint))
    }

    /// A client of CloudWatch Logs.
    pub fn logs(&self, region: Option<&str>, endpoint: Option<&str>) -> aws_sdk_cloudwatchlogs::Client {
        aws_sdk_cloudwatchlogs::Client::new(&self.config(region, endpoint))
    }

    /// A client of Secrets Manager.
    pub fn secrets(&self, region: Option<&str>, endpoint: Option<&str>) -> aws_sdk_secretsmanager::Client {
        aws_sdk_secretsmanager::Client::new(&self.config(region, endpoint))
    }

    /// A client of STS.
    pub fn sts(&self, region: Option<&str>, endpoint: Option<&str>) -> aws_sdk_sts::Client {
        aws_sdk_sts::Client::new(&self.config(region, endpoint))
    }
}
