//! The program `evalai-stand-in`: `serve` runs the server, the rest acts on a running one as people do in EvalAI.

mod client;

use std::io::IsTerminal as _;
use std::net::SocketAddr;
use std::process::ExitCode;
use std::sync::Arc;

use clap::{Args, Parser, Subcommand};
use evalai_stand_in::sqs::SqsQueues;
use evalai_stand_in::{Config, MemoryQueues, Queues, Seed, serve};
use tokio::net::TcpListener;
use tokio::signal::unix::{SignalKind, signal};

use crate::client::{Client, Failure};

/// A stand-in for EvalAI on one machine.
#[derive(Parser)]
#[command(name = "evalai-stand-in", version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Run the server.
    Serve(Serve),
    /// Submit an image, or a file, for a team.
    Submit(Submit),
    /// Cancel a submission, as the web page does: no message is sent.
    Cancel(One),
    /// Resume a failed submission under its own key.
    Resume(One),
    /// Cancel a submission and run it again under a new key.
    Rerun(One),
    /// Show a submission with its texts.
    Show(One),
    /// List all submissions.
    List(Server),
    /// Show the leaderboards.
    Leaderboard(Server),
}

#[derive(Args)]
struct Serve {
    /// An address to listen on; may be given several times.
    #[arg(
        long,
        env = "EVALAI_STAND_IN_LISTEN",
        value_delimiter = ',',
        default_value = "127.0.0.1:8000"
    )]
    listen: Vec<SocketAddr>,
    /// The SQS endpoint messages go to, over plain HTTP (absent: queues in memory, read over REST only).
    #[arg(long, env = "EVALAI_STAND_IN_SQS_ENDPOINT", value_name = "URL")]
    sqs_endpoint: Option<String>,
    /// The queue of all challenges, by name or URL (absent: as in the seed).
    #[arg(long, env = "EVALAI_STAND_IN_QUEUE_URL", value_name = "NAME|URL")]
    queue_url: Option<String>,
    /// Requests per user and minute; 0 is no limit.
    #[arg(long, env = "EVALAI_STAND_IN_THROTTLE", default_value_t = 60)]
    throttle: usize,
    /// Users, teams and challenges as JSON (absent: the built-in seed).
    #[arg(long, env = "EVALAI_STAND_IN_SEED", value_name = "FILE")]
    seed: Option<String>,
    /// The first submission's key.
    #[arg(long, env = "EVALAI_STAND_IN_FIRST_SUBMISSION", value_name = "PK")]
    first_submission: Option<u64>,
}

/// Which server to act on.
#[derive(Args)]
struct Server {
    /// The stand-in's URL.
    #[arg(long, env = "EVALAI_STAND_IN_URL", default_value = "http://127.0.0.1:8000")]
    server: String,
    /// The refresh token of the person who acts; a host's.
    #[arg(
        long,
        env = "EVALAI_STAND_IN_TOKEN",
        default_value = "local-organizer-token",
        hide_env_values = true
    )]
    token: String,
}

#[derive(Args)]
struct One {
    /// The submission's key.
    pk: u64,
    #[command(flatten)]
    server: Server,
}

#[derive(Args)]
struct Submit {
    /// The image's name.
    #[arg(required_unless_present = "content")]
    image: Option<String>,
    /// A text file that is the submission itself, in place of an image.
    #[arg(long, value_name = "FILE", conflicts_with = "image")]
    content: Option<String>,
    /// The team.
    #[arg(long, default_value = "team-a")]
    team: String,
    /// The phase's key.
    #[arg(long, default_value_t = 1)]
    phase: u64,
    /// How the image comes in: normal, missing-image, file-url or no-file.
    #[arg(long, default_value = "normal")]
    file: String,
    /// The method's name on the leaderboard.
    #[arg(long, default_value = "")]
    name: String,
    #[command(flatten)]
    server: Server,
}

#[tokio::main]
async fn main() -> ExitCode {
    // The client asks for a provider of TLS also where it uses none.
    let _ = rustls::crypto::ring::default_provider().install_default();
    let filter = tracing_subscriber::EnvFilter::try_from_default_env().unwrap_or_else(|_| "info".into());
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_ansi(std::io::stderr().is_terminal())
        .with_writer(std::io::stderr)
        .init();
    let result = match Cli::parse().command {
        Command::Serve(options) => run(options).await,
        Command::Submit(asked) => submit(asked).await,
        Command::Cancel(one) => one.client().cancel(one.pk).await,
        Command::Resume(one) => one.client().again(one.pk, "resume").await,
        Command::Rerun(one) => one.client().again(one.pk, "re-run").await,
        Command::Show(one) => one.client().show(one.pk).await,
        Command::List(server) => Client::new(&server.server, &server.token).list().await,
        Command::Leaderboard(server) => Client::new(&server.server, &server.token).leaderboards().await,
    };
    match result {
        Ok(text) => {
            println!("{text}");
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("evalai-stand-in: {error}");
            ExitCode::FAILURE
        }
    }
}

async fn submit(asked: Submit) -> Result<String, Failure> {
    let content = asked.content.map(|path| {
        let read = std::fs::read_to_string(&path);
        read.map_err(|error| Failure::Start(format!("cannot read {path}: {error}; choose another --content")))
    });
    let content = content.transpose()?;
    let body = serde_json::json!({
        "team": asked.team, "phase": asked.phase, "image": asked.image, "content": content,
        "file": asked.file, "method_name": asked.name,
    });
    let client = Client::new(&asked.server.server, &asked.server.token);
    client.submit(&body).await
}

impl One {
    fn client(&self) -> Client {
        Client::new(&self.server.server, &self.server.token)
    }
}

/// Serves until it is interrupted or terminated.
async fn run(options: Serve) -> Result<String, Failure> {
    let seed = options.seed.as_deref().map_or_else(Seed::built_in, Seed::read);
    let mut seed = seed.map_err(|error| Failure::Start(error.to_string()))?;
    if let Some(queue) = &options.queue_url {
        seed.set_queue(queue);
    }
    seed.first_submission = options.first_submission.unwrap_or(seed.first_submission);
    let queues: Arc<dyn Queues> = match &options.sqs_endpoint {
        Some(endpoint) => Arc::new(SqsQueues::new(endpoint)),
        None => Arc::new(MemoryQueues::default()),
    };
    let mut listeners = Vec::new();
    for address in &options.listen {
        let bound = TcpListener::bind(address).await;
        let reason = |error| format!("cannot listen on {address}: {error}; choose another --listen");
        listeners.push(bound.map_err(|error| Failure::Start(reason(error)))?);
    }
    let signals = (signal(SignalKind::interrupt()), signal(SignalKind::terminate()));
    let (Ok(mut interrupt), Ok(mut terminate)) = signals else {
        return Err(Failure::Start("cannot wait for signals".to_owned()));
    };
    let handle = serve(
        Config {
            seed,
            throttle: options.throttle,
            queues,
        },
        listeners,
    );
    for address in &options.listen {
        tracing::info!("listening on http://{address}");
    }
    tokio::select! {
        _ = interrupt.recv() => {}
        _ = terminate.recv() => {}
    }
    handle.shutdown().await;
    Ok("stopped".to_owned())
}
