//! Which of two servers a client of each service asks.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

#[allow(
    deprecated,
    reason = "the one way to a profile that needs no file and no variable of the process"
)]
use aws_config::profile::profile_file::{ProfileFileKind, ProfileFiles};
use aws_credential_types::Credentials;

use super::*;

/// A server that counts what it gets, and answers nothing of use.
struct Server {
    url: String,
    requests: Arc<AtomicUsize>,
}

impl Server {
    async fn start() -> Self {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("http://{}", listener.local_addr().unwrap());
        let requests = Arc::new(AtomicUsize::new(0));
        let counter = Arc::clone(&requests);
        let router = axum::Router::new().fallback(move || async move {
            counter.fetch_add(1, Ordering::SeqCst);
            axum::http::StatusCode::BAD_REQUEST
        });
        tokio::spawn(async move { axum::serve(listener, router).await });
        Self { url, requests }
    }

    fn take(&self) -> usize {
        self.requests.swap(0, Ordering::SeqCst)
    }
}

fn loader() -> aws_config::ConfigLoader {
    aws_config::defaults(BehaviorVersion::latest())
        .http_client(aws_smithy_http_client::Builder::new().build_http())
        .region(Region::new("us-east-1"))
        .credentials_provider(Credentials::new("test", "test", None, None, "tests"))
}

/// Asks each service once.
async fn ask_all(aws: &Aws, endpoint: Option<&str>) -> [&'static str; 5] {
    // Their reading of the answer does not matter here.
    let _ = aws.s3(None, endpoint).list_objects_v2().bucket("b").send().await;
    let _ = aws
        .sqs(None, endpoint)
        .receive_message()
        .queue_url("http://q/1")
        .send()
        .await;
    let _ = aws
        .dynamodb(None, endpoint)
        .describe_table()
        .table_name("t")
        .send()
        .await;
    let logs = aws.logs(None, endpoint);
    let _ = logs
        .create_log_stream()
        .log_group_name("g")
        .log_stream_name("s")
        .send()
        .await;
    let _ = aws
        .secrets(None, endpoint)
        .get_secret_value()
        .secret_id("i")
        .send()
        .await;
    ["s3", "sqs", "dynamodb", "logs", "secretsmanager"]
}

#[tokio::test]
async fn an_endpoint_of_ones_own_goes_before_one_of_the_machine() {
    let (own, machine) = (Server::start().await, Server::start().await);
    // A profile stands for `AWS_ENDPOINT_URL`: the SDK takes both from the same place, and a test can't set variables.
    #[allow(deprecated, reason = "as above")]
    let profile = ProfileFiles::builder()
        .with_contents(
            ProfileFileKind::Config,
            format!("[default]\nendpoint_url = {}\n", machine.url),
        )
        .build();
    let aws = Aws::from_config(loader().profile_files(profile).load().await);
    let asked = ask_all(&aws, Some(&own.url)).await;
    assert_eq!((own.take(), machine.take()), (asked.len(), 0), "{asked:?}");
}

#[tokio::test]
async fn without_an_endpoint_of_ones_own_the_machines_counts() {
    let machine = Server::start().await;
    let aws = Aws::from_config(loader().endpoint_url(&machine.url).load().await);
    let asked = ask_all(&aws, None).await;
    assert_eq!(machine.take(), asked.len(), "{asked:?}");
    let _ = aws.sts(None).get_caller_identity().send().await;
    assert_eq!(machine.take(), 1, "STS has no endpoint in the API");
}

#[test]
fn an_endpoint_of_the_environment_holds_no_credentials() {
    let checked = |name: &str, value: &str| check_endpoints([(name.into(), value.into())]);
    for plain in ["http://10.77.0.1:4566", "https://s3.example.org/path", ""] {
        assert_eq!(checked("AWS_ENDPOINT_URL", plain), Ok(()), "{plain}");
    }
    for unfit in [
        "http://user:secret@s3:9000",
        "https://s3.example.org/?key=secret",
        "https://s3.example.org/#secret",
    ] {
        assert_eq!(checked("AWS_CONTAINER_CREDENTIALS_FULL_URI", unfit), Ok(()));
        for name in ["AWS_ENDPOINT_URL", "AWS_ENDPOINT_URL_S3"] {
            let fault = checked(name, unfit).unwrap_err().to_string();
            assert!(fault.starts_with(name) && !fault.contains("secret@"), "{fault}");
        }
    }
}
