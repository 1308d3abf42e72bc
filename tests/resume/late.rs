//! Requests that S3 carries out after the logcopy that sent them is gone.

use std::net::Ipv4Addr;
use std::time::Duration;

use fastrand::Rng;
use leaderboard_api::LeaderboardVersion;
use leaderboard_contract::report::REPORT_KEY;
use tokio::io::{AsyncReadExt, AsyncWriteExt, copy};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::task::JoinSet;

use super::kubelet::{Kubelet, Name};
use super::results::{Results, report, results};
use super::submission::Submission;
use crate::ministack::server;

const LIMIT: Duration = Duration::from_mins(2);
/// One of each kind: from the volume, made from the checkpoints, and the report.
const HELD: [&str; 3] = ["agent/agent1/agent_results.json", "evalai/results.json", REPORT_KEY];

/// Each time logcopy is killed while S3 has its request and has not carried it out. The next logcopy stores newer results, and
/// only then the older requests are carried out.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_older_request_that_is_served_late_replaces_nothing() {
    let bucket = server().await.bucket().await;
    let undisturbed = Submission::new(&bucket, LeaderboardVersion::V2, &mut Rng::new()).await;
    let mut kubelet = Kubelet::new(&undisturbed);
    kubelet.make_pod();
    let expected = to_the_end(&undisturbed, &mut kubelet).await;

    let mut delay = Delay::start().await;
    let submission = Submission::on(&delay.endpoint, &bucket, LeaderboardVersion::V2, &mut Rng::new()).await;
    let mut kubelet = Kubelet::new(&submission);
    kubelet.make_pod();
    for key in HELD {
        delay.hold(key);
        let held = async {
            loop {
                tokio::select! {
                    (name, status) = kubelet.ended() => assert!(!kubelet.handle(name, status), "it ends without {key}"),
                    () = delay.has_held() => return,
                }
            }
        };
        let in_time = tokio::time::timeout(LIMIT, held).await;
        assert!(in_time.is_ok(), "{key} is not stored\n{}", kubelet.story());
        assert!(kubelet.kill(Name::Logcopy).await);
    }
    let before = to_the_end(&submission, &mut kubelet).await;
    delay.let_through(HELD.len()).await;

    let after = results(&submission.archive).await;
    for (key, text) in &expected {
        assert_eq!(&before[key], text, "{key} before");
        assert_eq!(&after[key], text, "{key} after the late requests");
    }
    let last = report(&submission.archive).await.unwrap();
    assert!(last.is_final && last.eligible, "{last:?}");
}

/// Runs the Pod to its end. Returns what is stored.
async fn to_the_end(submission: &Submission, kubelet: &mut Kubelet<'_>) -> Results {
    let end = async {
        loop {
            let (name, status) = kubelet.ended().await;
            if kubelet.handle(name, status) {
                return;
            }
        }
    };
    let in_time = tokio::time::timeout(LIMIT, end).await;
    assert!(in_time.is_ok(), "it does not end\n{}", kubelet.story());
    assert!(kubelet.end_logcopy().await.success());
    results(&submission.archive).await
}

/// A way to S3 on which a request can be held back, whole, whatever becomes of its client.
struct Delay {
    endpoint: String,
    next: watch::Sender<Option<&'static str>>,
    passes: watch::Sender<bool>,
    served: watch::Receiver<usize>,
    _task: JoinSet<()>,
}

/// State that its connections share.
#[derive(Clone)]
struct Shared {
    server: String,
    next: watch::Sender<Option<&'static str>>,
    passes: watch::Receiver<bool>,
    served: watch::Sender<usize>,
}

impl Delay {
    async fn start() -> Self {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await.unwrap();
        let endpoint = format!("http://{}", listener.local_addr().unwrap());
        let (next, _) = watch::channel(None);
        let (passes, may_pass) = watch::channel(false);
        let (serve, served) = watch::channel(0);
        let shared = Shared {
            server: server().await.endpoint().trim_start_matches("http://").to_owned(),
            next: next.clone(),
            passes: may_pass,
            served: serve,
        };
        let mut task = JoinSet::new();
        task.spawn(async move {
            let mut connections = JoinSet::new();
            while let Ok((client, _)) = listener.accept().await {
                connections.spawn(pass(client, shared.clone()));
            }
        });
        Self {
            endpoint,
            next,
            passes,
            served,
            _task: task,
        }
    }

    /// The next request that stores this object is held.
    fn hold(&self, key: &'static str) {
        self.next.send_replace(Some(key));
    }

    async fn has_held(&self) {
        self.next.subscribe().wait_for(Option::is_none).await.unwrap();
    }

    /// S3 carries out the held requests.
    async fn let_through(&mut self, count: usize) {
        self.passes.send_replace(true);
        let served = self.served.wait_for(|served| *served == count);
        tokio::time::timeout(LIMIT, served).await.unwrap().unwrap();
    }
}

async fn pass(client: TcpStream, mut shared: Shared) {
    let server = TcpStream::connect(&shared.server).await.unwrap();
    let (mut from_client, mut to_client) = client.into_split();
    let (mut from_server, mut to_server) = server.into_split();
    let answers = tokio::spawn(async move { copy(&mut from_server, &mut to_client).await });
    let mut bytes = vec![0; 64 << 10];
    // A client sends its next request after the answer only, so each begins with a read of its own.
    while let Ok(count @ 1..) = from_client.read(&mut bytes).await {
        let mut request = bytes[..count].to_vec();
        let held = shared.next.borrow().filter(|key| stores(&request, key));
        if held.is_some() {
            while !is_whole(&request) {
                let count = from_client.read(&mut bytes).await.unwrap();
                assert!(count > 0, "the client has gone before it has sent all");
                request.extend(&bytes[..count]);
            }
            shared.next.send_replace(None);
            shared.passes.wait_for(|passes| *passes).await.unwrap();
        }
        if held.is_some() {
            let mut server = TcpStream::connect(&shared.server).await.unwrap();
            server.write_all(&request).await.unwrap();
            assert!(server.read(&mut bytes).await.unwrap() > 0, "no answer");
            shared.served.send_modify(|served| *served += 1);
            break;
        }
        if to_server.write_all(&request).await.is_err() {
            break;
        }
    }
    answers.abort();
}

fn stores(request: &[u8], key: &str) -> bool {
    let text = String::from_utf8_lossy(request);
    let line = text.lines().next().unwrap_or_default();
    line.starts_with("PUT /") && line.contains(&format!("/{key}?"))
}

fn is_whole(request: &[u8]) -> bool {
    let text = String::from_utf8_lossy(request);
    let Some((head, _)) = text.split_once("\r\n\r\n") else {
        return false;
    };
    let length = head.lines().find_map(|line| {
        let (name, value) = line.split_once(':')?;
        name.eq_ignore_ascii_case("content-length")
            .then(|| value.trim().parse::<usize>().unwrap())
    });
    request.len() >= head.len() + 4 + length.unwrap()
}
