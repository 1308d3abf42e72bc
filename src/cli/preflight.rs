//! Subcommand `preflight`: reports what an installed operator lacks. `helm test` runs it as the controller's service account.

use std::env;
use std::net::{IpAddr, SocketAddr};
use std::process::ExitCode;
use std::time::Duration;

use clap::Args;
use kube::Client;
use tokio::time::{Instant, sleep};

use super::rights::Rights;
use super::serve::{self, End};
use crate::kubernetes::Namespaces;
use crate::kubernetes::preflight::{access_missing, kinds_missing};
use crate::observability::logging::Format;
use crate::runtime::KINDS;
use leaderboard_api::client_errors;

/// Exit codes, for the help.
pub(super) const EXIT_CODES: &str =
    "Exit code 0: nothing is missing. 1: something is. 2: arguments or RUST_LOG are refused.";
/// Between two looks.
const PAUSE: Duration = Duration::from_secs(2);
/// For one answer of a program.
const ANSWER_LIMIT: Duration = Duration::from_secs(5);

#[derive(Args, Debug)]
pub(super) struct Preflight {
    /// A namespace to serve; may be given several times, or with commas. All namespaces if there is none.
    #[arg(long = "namespace", env = "LEADERBOARD_NAMESPACES", value_delimiter = ',')]
    namespaces: Vec<String>,
    /// Rights to ask for, as JSON: rules of RBAC in the lists `served` (each namespace to serve), `cluster`, and `own` (this Pod's namespace).
    #[arg(long, env = "LEADERBOARD_RIGHTS", default_value = "{}")]
    rights: Rights,
    /// This Pod's namespace.
    #[arg(long, env = "POD_NAMESPACE", default_value = "default")]
    own_namespace: String,
    /// A Service of this Pod's namespace whose programs have to be ready; may be given several times.
    #[arg(long = "ready", value_name = "SERVICE")]
    services: Vec<String>,
    /// How many seconds what is missing may take to come.
    #[arg(long, default_value_t = 60, value_name = "SECONDS")]
    patience: u64,
}

impl Preflight {
    pub(super) fn run(self) -> ExitCode {
        serve::start("preflight", Format::Auto, || self.check())
    }

    /// Looks until nothing is missing, or for as long as it may take.
    async fn check(self) -> End {
        let config = serve::cluster("preflight").await?;
        let client = Client::try_from(config).map_err(|error| client_errors::kube(&error))?;
        let builder = reqwest::Client::builder().no_proxy().timeout(ANSWER_LIMIT);
        let http = builder.build()?;
        let until = Instant::now() + Duration::from_secs(self.patience);
        loop {
            let missing = self.missing(&client, &http).await;
            if missing.is_empty() {
                let ready = match self.services.join(", ") {
                    none if none.is_empty() => "not asked".to_owned(),
                    names => names,
                };
                println!("the kinds are served, the rights are granted, and ready: {ready}");
                return Ok(());
            }
            if Instant::now() >= until {
                return Err(missing.join("; ").into());
            }
            sleep(PAUSE).await;
        }
    }

    /// A sentence for each thing that is missing.
    async fn missing(&self, client: &Client, http: &reqwest::Client) -> Vec<String> {
        let namespaces = Namespaces::of(self.namespaces.iter().cloned());
        let needs = self.rights.needs(&namespaces, &self.own_namespace);
        let mut missing: Vec<String> = kinds_missing(client, &KINDS).await.into_iter().collect();
        missing.extend(access_missing(client, &needs).await);
        for service in &self.services {
            let unready = match address(service, |name| env::var(name).ok()) {
                Ok(address) => unready(http, address).await,
                Err(unknown) => Some(unknown),
            };
            missing.extend(unready.map(|why| format!("{service}: {why}")));
        }
        missing
    }
}

/// Why the programs behind an address are not ready. None: they are.
async fn unready(http: &reqwest::Client, address: SocketAddr) -> Option<String> {
    let url = format!("http://{address}/readyz");
    match http.get(&url).send().await {
        Ok(answer) if answer.status().is_success() => None,
        Ok(answer) => {
            let status = answer.status();
            let page = answer.text().await.unwrap_or_default();
            Some(format!("{url} answers {status}: {}", page.trim().replace('\n', "; ")))
        }
        // A Service without a ready Pod refuses, or does not answer.
        Err(error) => Some(format!(
            "no replica is ready: {}; see the log of its Pods",
            leaderboard_api::text::chain(&error)
        )),
    }
}

/// Where a Service is, by the variables that the kubelet gives every Pod of its namespace: they need no DNS.
fn address(service: &str, variable: impl Fn(&str) -> Option<String>) -> Result<SocketAddr, String> {
    let prefix = service.to_uppercase().replace('-', "_");
    let of = |part| variable(&format!("{prefix}_SERVICE_{part}"));
    let host = of("HOST").and_then(|text| text.parse::<IpAddr>().ok());
    let port = of("PORT").and_then(|text| text.parse::<u16>().ok());
    host.zip(port).map(SocketAddr::from).ok_or_else(|| {
        format!(
            "this Pod has no address of it in {prefix}_SERVICE_HOST and {prefix}_SERVICE_PORT; is the Service there?"
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::observability::Observability;
    use crate::observability::health::HealthServer;
    use leaderboard_base::shutdown::Stop;

    #[tokio::test]
    async fn a_program_reports_itself_what_it_lacks() {
        let _ = rustls::crypto::ring::default_provider().install_default();
        let http = reqwest::Client::builder().no_proxy().build().unwrap();
        let (_sender, stop) = Stop::new();
        let telemetry = Observability::new(stop);
        let server = HealthServer::start(([127, 0, 0, 1], 0).into(), telemetry.clone())
            .await
            .unwrap();
        let address = server.address();
        let why = unready(&http, address).await.unwrap();
        assert!(
            why.contains("/readyz answers 500") && why.contains("not all checks are registered"),
            "{why}"
        );
        telemetry.readiness.registered();
        assert_eq!(unready(&http, address).await, None);
        server.close().await;
        let why = unready(&http, address).await.unwrap();
        assert!(why.starts_with("no replica is ready: "), "{why}");
    }

    #[test]
    fn the_kubelets_variables_lead_to_a_service() {
        let of = |host: &'static str, port: &'static str| {
            address("operator-controller", move |name| match name {
                "OPERATOR_CONTROLLER_SERVICE_HOST" => Some(host.to_owned()),
                "OPERATOR_CONTROLLER_SERVICE_PORT" => Some(port.to_owned()),
                _ => None,
            })
        };
        assert_eq!(of("10.0.0.7", "8080").unwrap().to_string(), "10.0.0.7:8080");
        assert_eq!(of("fd00::7", "80").unwrap().to_string(), "[fd00::7]:80");
        // A headless Service, and a port that is none.
        for (host, port) in [("None", "8080"), ("10.0.0.7", "tcp://10.0.0.7")] {
            assert!(of(host, port).unwrap_err().contains("OPERATOR_CONTROLLER_SERVICE_HOST"));
        }
        assert!(address("gone", |_| None).unwrap_err().contains("GONE_SERVICE_HOST"));
    }
}
