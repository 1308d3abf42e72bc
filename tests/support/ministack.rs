//! A stand-in for AWS on a free loopback port, one for the whole test program. A proxy before it can go away and counts bytes.
//!
//! It ends with the test program, however that ends: a shell holds it until its standard input is closed. Buckets are
//! the tests' own; nothing is shared between them.

use std::fs::File;
use std::net::{Ipv4Addr, SocketAddr, TcpListener};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use aws_config::timeout::TimeoutConfig;
use aws_config::{BehaviorVersion, Region};
use aws_credential_types::Credentials;
use leaderboard_aws::clients::Aws;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::{OnceCell, watch};

const VARIABLE: &str = "LEADERBOARD_MINISTACK";
/// It needs half a second on an idle machine.
const START_LIMIT: Duration = Duration::from_mins(2);
/// Another program, which reports nothing when it is ready: it is asked this often.
const POLL: Duration = Duration::from_millis(50);
/// A free port can be taken by somebody else before the stand-in has it.
const TRIES: usize = 3;
/// Starts the program and ends it when standard input does.
const HOLD: &str = r#""$0" & child=$!; read -r _; kill -KILL "$child"; wait"#;

/// The running stand-in.
pub struct Ministack {
    address: SocketAddr,
    _folder: tempfile::TempDir,
    _holder: Child,
}

/// The stand-in of this test program, started by the first call.
pub async fn server() -> &'static Ministack {
    // A failure is kept too: the other tests would only wait for the same one.
    static SERVER: OnceCell<Result<Ministack, String>> = OnceCell::const_new();
    match SERVER.get_or_init(start).await {
        Ok(server) => server,
        Err(why) => panic!("no stand-in for AWS to test against: {why}"),
    }
}

impl Ministack {
    /// `http://127.0.0.1:<port>`.
    pub fn endpoint(&self) -> String {
        format!("http://{}", self.address)
    }

    /// The way to it, for one test: the connections belong to the test's runtime.
    pub async fn aws(&self) -> Aws {
        aws(&self.endpoint()).await
    }

    /// A new bucket.
    pub async fn bucket(&self) -> String {
        static NUMBER: AtomicU32 = AtomicU32::new(1);
        let name = format!("bucket-{}", NUMBER.fetch_add(1, Ordering::Relaxed));
        let s3 = self.aws().await.s3(None, Some(&self.endpoint()));
        s3.create_bucket().bucket(&name).send().await.unwrap();
        name
    }

    /// A proxy before it.
    pub async fn proxy(&self) -> Proxy {
        Proxy::start(self.address).await
    }
}

/// The way to an endpoint with the stand-in's credentials.
pub async fn aws(endpoint: &str) -> Aws {
    let timeouts = TimeoutConfig::builder()
        .connect_timeout(Duration::from_secs(5))
        .operation_attempt_timeout(Duration::from_mins(1))
        .build();
    let config = aws_config::defaults(BehaviorVersion::latest())
        .http_client(aws_smithy_http_client::Builder::new().build_http())
        .region(Region::new("us-east-1"))
        .credentials_provider(Credentials::new("test", "test", None, None, "tests"))
        .timeout_config(timeouts)
        .endpoint_url(endpoint)
        .load()
        .await;
    Aws::from_config(config)
}

async fn start() -> Result<Ministack, String> {
    let program = std::env::var_os(VARIABLE).ok_or_else(|| {
        format!(
            "run these tests with `make test`, or set {VARIABLE} to the program `ministack` (pip install ministack)"
        )
    })?;
    let mut last = String::new();
    for _ in 0..TRIES {
        match start_once(&program).await {
            Ok(server) => return Ok(server),
            Err(why) => last = why,
        }
    }
    Err(last)
}

async fn start_once(program: &std::ffi::OsStr) -> Result<Ministack, String> {
    let address = free_address().map_err(|error| format!("no free port: {error}"))?;
    let folder = tempfile::tempdir().map_err(|error| error.to_string())?;
    let log = folder.path().join("log");
    let output = File::create(&log).and_then(|file| Ok((file.try_clone()?, file)));
    let (out, err) = output.map_err(|error| error.to_string())?;
    let mut holder = Command::new("sh")
        .args(["-c".as_ref(), HOLD.as_ref(), program])
        .env("BIND_HOST", address.ip().to_string())
        .env("GATEWAY_PORT", address.port().to_string())
        .stdin(Stdio::piped())
        .stdout(out)
        .stderr(err)
        .spawn()
        .map_err(|error| format!("sh does not start: {error}"))?;
    let began = Instant::now();
    while began.elapsed() < START_LIMIT {
        if is_healthy(address).await {
            return Ok(Ministack {
                address,
                _folder: folder,
                _holder: holder,
            });
        }
        let said = std::fs::read_to_string(&log).unwrap_or_default();
        if said.contains("not found") || said.contains("already in use") {
            break;
        }
        tokio::time::sleep(POLL).await;
    }
    drop(holder.stdin.take());
    let _ = holder.wait();
    let said = std::fs::read_to_string(&log).unwrap_or_default();
    Err(format!("{} did not become healthy: {said}", program.display()))
}

fn free_address() -> std::io::Result<SocketAddr> {
    TcpListener::bind((Ipv4Addr::LOCALHOST, 0))?.local_addr()
}

async fn is_healthy(address: SocketAddr) -> bool {
    let ask = async {
        let mut stream = TcpStream::connect(address).await?;
        let request = format!("GET /_ministack/health HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
        stream.write_all(request.as_bytes()).await?;
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).await?;
        Ok::<_, std::io::Error>(answer)
    };
    let answer = tokio::time::timeout(Duration::from_secs(5), ask).await;
    matches!(answer, Ok(Ok(answer)) if answer.starts_with(b"HTTP/1.1 200"))
}

/// Counts of a proxy.
#[derive(Clone, Copy, Debug, Default)]
pub struct Counts {
    /// Bytes that clients have sent.
    pub sent: u64,
    /// Requests that clients have sent.
    pub requests: u64,
    /// Connections that were closed at once, since it was away.
    pub refused: u64,
}

/// Forwards connections, unless it is away; counts what clients send.
pub struct Proxy {
    address: SocketAddr,
    away: watch::Sender<bool>,
    counts: Arc<watch::Sender<Counts>>,
    task: tokio::task::JoinHandle<()>,
}

impl Proxy {
    async fn start(to: SocketAddr) -> Self {
        let listener = tokio::net::TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await.unwrap();
        let address = listener.local_addr().unwrap();
        let (away, is_away) = watch::channel(false);
        let counts = Arc::new(watch::Sender::new(Counts::default()));
        let counting = Arc::clone(&counts);
        let task = tokio::spawn(async move {
            while let Ok((client, _)) = listener.accept().await {
                let (mut away, counts) = (is_away.clone(), Arc::clone(&counting));
                if *away.borrow() {
                    counts.send_modify(|counts| counts.refused += 1);
                }
                tokio::spawn(async move {
                    tokio::select! {
                        _ = away.wait_for(|away| *away) => {}
                        () = forward(client, to, &counts) => {}
                    }
                });
            }
        });
        Self {
            address,
            away,
            counts,
            task,
        }
    }

    /// `http://127.0.0.1:<port>`.
    pub fn endpoint(&self) -> String {
        format!("http://{}", self.address)
    }

    /// Breaks all connections and closes new ones at once, or stops doing so.
    pub fn set_away(&self, away: bool) {
        self.away.send_replace(away);
    }

    pub fn counts(&self) -> Counts {
        *self.counts.borrow()
    }

    /// Waits until this holds of what it has seen, without a limit of its own.
    pub async fn until(&self, holds: impl Fn(Counts) -> bool) {
        let mut counts = self.counts.subscribe();
        counts.wait_for(|counts| holds(*counts)).await.unwrap();
    }
}

impl Drop for Proxy {
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// Ends the first line of each request, and nothing that the tests store.
const REQUEST: &[u8] = b" HTTP/1.1\r\n";

async fn forward(mut client: TcpStream, to: SocketAddr, counts: &watch::Sender<Counts>) {
    let Ok(mut server) = TcpStream::connect(to).await else {
        return;
    };
    let (mut from_client, mut to_client) = client.split();
    let (mut from_server, mut to_server) = server.split();
    let requests = async {
        let mut buffer = vec![0; 64 << 10];
        let mut seen: Vec<u8> = Vec::new();
        loop {
            match from_client.read(&mut buffer).await {
                Ok(0) | Err(_) => break,
                Ok(len) => {
                    seen.extend(&buffer[..len]);
                    let lines = seen.windows(REQUEST.len()).filter(|window| *window == REQUEST);
                    let lines = lines.count() as u64;
                    counts.send_modify(|counts| {
                        counts.sent += len as u64;
                        counts.requests += lines;
                    });
                    // The beginning of a line's end that the next read may complete.
                    seen.drain(..seen.len().saturating_sub(REQUEST.len() - 1));
                    if to_server.write_all(&buffer[..len]).await.is_err() {
                        break;
                    }
                }
            }
        }
    };
    let answers = tokio::io::copy(&mut from_server, &mut to_client);
    tokio::select! {
        () = requests => {}
        _ = answers => {}
    }
}
