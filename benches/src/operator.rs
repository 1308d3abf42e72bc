//! The operator as a process: started, asked for its state, killed.

use std::path::Path;
use std::time::{Duration, Instant};

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::time::{sleep, timeout};

use crate::api;
use crate::bench::Outcome;
use crate::servers::{Program, Servers, free_ports};

const START_LIMIT: Duration = Duration::from_mins(3);
const POLL: Duration = Duration::from_millis(5);
/// Ready is who stays ready for so long: the first answers may come before a check is registered.
const STAYS: Duration = Duration::from_millis(200);

/// The running operator.
pub struct Operator {
    program: Program,
    port: u16,
    started: Instant,
}

impl Operator {
    pub fn start(binary: &Path, servers: &Servers) -> Outcome<Self> {
        let [port] = free_ports()?;
        let http = format!("127.0.0.1:{port}");
        let arguments = [
            "controller",
            "--namespace",
            api::NAMESPACE,
            "--http",
            &http,
            "--lease-namespace",
            api::NAMESPACE,
        ]
        .into_iter()
        .chain(["--image", "registry.example/leaderboard-operator:bench"]);
        let arguments: Vec<String> = arguments.map(str::to_owned).collect();
        let variables = [
            ("KUBECONFIG", servers.kubeconfig().display().to_string()),
            ("RUST_LOG", "info".to_owned()),
            ("AWS_ACCESS_KEY_ID", "bench".to_owned()),
            ("AWS_SECRET_ACCESS_KEY", "bench".to_owned()),
            ("AWS_REGION", "us-east-1".to_owned()),
            ("AWS_EC2_METADATA_DISABLED", "true".to_owned()),
            // As the image sets them.
            ("MALLOC_ARENA_MAX", "1".to_owned()),
            ("MALLOC_TRIM_THRESHOLD_", "131072".to_owned()),
        ];
        let started = Instant::now();
        let program = Program::start_with("operator", binary, &arguments, servers.folder.path(), &variables)?;
        Ok(Self { program, port, started })
    }

    /// Waits until it is ready; seconds since its start.
    pub async fn ready(&mut self) -> Outcome<f64> {
        let end = self.started + START_LIMIT;
        let mut since = None;
        loop {
            if let Some(why) = self.program.ended() {
                return Err(why.into());
            }
            let now = Instant::now();
            if now > end {
                return Err(format!("the operator is not ready after {} s", START_LIMIT.as_secs()).into());
            }
            match self.get("/readyz").await {
                Ok(answer) if answer.starts_with("HTTP/1.1 200") || answer.starts_with("HTTP/1.0 200") => {
                    let since = *since.get_or_insert(now);
                    if now.duration_since(since) >= STAYS {
                        return Ok(since.duration_since(self.started).as_secs_f64());
                    }
                }
                _ => since = None,
            }
            sleep(POLL).await;
        }
    }

    /// Seconds since its start.
    pub fn age(&self) -> f64 {
        self.started.elapsed().as_secs_f64()
    }

    /// Reconciles of Submissions since its start.
    pub async fn reconciles(&self) -> Outcome<f64> {
        let text = self.get("/metrics").await?;
        Ok(sum(&text, "leaderboard_reconciles_total{", "kind=\"Submission\""))
    }

    pub fn pid(&self) -> Outcome<u32> {
        self.program.pid()
    }

    pub async fn kill(&mut self) -> Outcome<()> {
        self.program.kill().await
    }

    pub fn ended(&mut self) -> Option<String> {
        self.program.ended()
    }

    async fn get(&self, path: &str) -> Outcome<String> {
        let asked = async {
            let mut stream = TcpStream::connect(("127.0.0.1", self.port)).await?;
            let request = format!("GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n");
            stream.write_all(request.as_bytes()).await?;
            let mut answer = Vec::new();
            stream.read_to_end(&mut answer).await?;
            Ok(String::from_utf8_lossy(&answer).into_owned())
        };
        timeout(Duration::from_secs(5), asked).await?
    }
}

/// Sum of the lines of a metric that name a label's value.
fn sum(text: &str, metric: &str, value: &str) -> f64 {
    let lines = text
        .lines()
        .filter(|line| line.starts_with(metric) && line.contains(value));
    lines
        .filter_map(|line| line.rsplit(' ').next()?.parse::<f64>().ok())
        .sum()
}

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "the expected numbers are exact")]
mod tests {
    use super::*;

    #[test]
    fn only_the_metric_of_the_kind_is_summed() {
        let text = "# HELP x\nx_total{kind=\"Submission\",outcome=\"ok\"} 3\nx_total{kind=\"Submission\",outcome=\"error\"} 2\n\
            x_total{kind=\"Leaderboard\",outcome=\"ok\"} 9\ny_total{kind=\"Submission\"} 9\n";
        assert_eq!(sum(text, "x_total{", "Submission"), 5.0);
    }
}
