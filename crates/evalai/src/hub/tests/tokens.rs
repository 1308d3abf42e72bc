//! The token that a request carries, and the budget that it draws on.

use std::collections::BTreeSet;

use base64::Engine;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};

use super::*;
use crate::types::{Ended, Outline};
use leaderboard_api::evalai_status::Outcome;

/// One request of a server of the test's own.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Seen {
    method: String,
    path: String,
    token: String,
}

/// Answers every request with a row of that submission, or refuses its token.
struct Server {
    url: String,
    seen: mpsc::UnboundedReceiver<Seen>,
}

impl Server {
    async fn new(refused: &'static str) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("http://{}", listener.local_addr().unwrap());
        let (found, seen) = mpsc::unbounded_channel();
        tokio::spawn(async move {
            while let Ok((stream, _)) = listener.accept().await {
                tokio::spawn(answer(stream, refused, found.clone()));
            }
        });
        Self { url, seen }
    }

    /// The next request that is as wanted.
    async fn until(&mut self, wanted: impl Fn(&Seen) -> bool) -> Seen {
        let next = async {
            loop {
                let seen = self.seen.recv().await.unwrap();
                if wanted(&seen) {
                    return seen;
                }
            }
        };
        tokio::time::timeout(Duration::from_mins(1), next).await.unwrap()
    }
}

async fn answer(mut stream: TcpStream, refused: &str, found: mpsc::UnboundedSender<Seen>) {
    let mut text = String::new();
    let mut buffer = [0; 4096];
    while !is_whole(&text) {
        let count = stream.read(&mut buffer).await.unwrap_or_default();
        if count == 0 {
            return;
        }
        text.push_str(&String::from_utf8_lossy(&buffer[..count]));
    }
    let head = text.split("\r\n\r\n").next().unwrap();
    let mut words = head.split(' ').map(str::to_owned);
    let (method, path) = (words.next().unwrap(), words.next().unwrap());
    let token = head
        .lines()
        .find_map(|line| line.strip_prefix("authorization: Bearer "));
    let token = token.unwrap_or_default().to_owned();
    let (status, body) = match &method {
        _ if token == refused => ("401 Unauthorized", r#"{"detail": "Token is blacklisted"}"#),
        _ if path.contains("/jobs/submission/") => {
            ("200 OK", r#"{"id": 7, "status": "running", "challenge_phase": 1}"#)
        }
        method if method == "GET" => ("200 OK", "[]"),
        _ => ("200 OK", "{}"),
    };
    let length = body.len();
    let answer =
        format!("HTTP/1.1 {status}\r\ncontent-type: application/json\r\ncontent-length: {length}\r\n\r\n{body}");
    // A client that is gone has no use for it.
    let _ = stream.write_all(answer.as_bytes()).await;
    let _ = found.send(Seen { method, path, token });
}

fn is_whole(text: &str) -> bool {
    let Some((head, body)) = text.split_once("\r\n\r\n") else {
        return false;
    };
    let length = head.lines().find_map(|line| line.strip_prefix("content-length: "));
    body.len() >= length.map_or(0, |length| length.parse().unwrap())
}

/// A token that claims to be of user 7. Nobody but EvalAI can tell whether it is.
fn token(signature: &str) -> String {
    let part = |text: &str| URL_SAFE_NO_PAD.encode(text);
    format!(
        "{}.{}.{signature}",
        part(r#"{"alg":"HS256"}"#),
        part(r#"{"user_id":7}"#)
    )
}

pub(super) fn board(server: &str, namespace: &str, challenge: i64, token: &str) -> Target {
    let uid = format!("board-{namespace}-{challenge}");
    Target {
        leaderboard: Key {
            namespace: namespace.into(),
            name: uid.clone(),
            uid,
        },
        api_server: server.to_owned(),
        challenge,
        requests_per_minute: 6000,
        ..target(token)
    }
}

fn subject(target: &Target) -> Subject {
    Subject {
        target: Arc::new(target.clone()),
        key: Key {
            namespace: target.leaderboard.namespace.clone(),
            ..key(&format!("submission-7-of-{}", target.challenge))
        },
        pk: 7,
        run: Run {
            attempt: Attempt(1),
            job: "submission-7-1".into(),
            by_hand: false,
            has_job: true,
            ended: None,
            log: LogSpan::default(),
        },
    }
}

pub(super) fn cancelled(target: &Target, hub: &Hub) {
    let publisher = Publisher::of(subject(target)).unwrap();
    let end = DesiredUpdate::Final(Outcome::Cancelled, Arc::new(Outline::default()));
    hub.update(&publisher, end).unwrap();
}

#[tokio::test]
async fn two_tokens_that_claim_one_user_are_sent_for_their_own_challenges_alone() {
    for namespaces in [["one", "one"], ["one", "other"]] {
        let mut server = Server::new("nothing is refused").await;
        let (_stop, signal) = Stop::new();
        let hub = hub(&Tasks::new(signal), || true);
        let tokens = [token("hosts"), token("made-up")];
        let boards = [
            board(&server.url, namespaces[0], 11, &tokens[0]),
            board(&server.url, namespaces[1], 12, &tokens[1]),
        ];
        // Each is handed in again and again, as in each reconcile.
        for _ in 0..3 {
            for board in &boards {
                hub.serve(&board.leaderboard, board).unwrap();
                hub.live(&subject(board), Timestamp::UNIX_EPOCH).unwrap();
            }
        }
        let is_of = |seen: &Seen, challenge: i64| seen.path.contains(&format!("/{challenge}/"));
        let mut paths = boards.each_ref().map(|_| BTreeSet::new());
        while paths.iter().any(|paths: &BTreeSet<String>| paths.len() < 3) {
            let seen = server
                .until(|seen| boards.iter().any(|board| is_of(seen, board.challenge)))
                .await;
            let index = usize::from(is_of(&seen, 12));
            assert_eq!(seen.token, tokens[index], "{seen:?} in {namespaces:?}");
            let path = seen.path.split('?').next();
            paths[index].extend(path.map(str::to_owned));
        }
    }
}

#[tokio::test]
async fn what_waits_goes_on_with_the_new_token_of_its_leaderboard() {
    let (old, new) = (token("old"), token("new"));
    let refused: &'static str = old.clone().leak();
    let mut server = Server::new(refused).await;
    let (_stop, signal) = Stop::new();
    let (changed, mut changes) = mpsc::unbounded_channel();
    let hub = Hub::new(Options {
        changed,
        ..Options::unheard(&Tasks::new(signal), || true)
    });
    let before = board(&server.url, "ns", 11, &old);
    hub.serve(&before.leaderboard, &before).unwrap();
    cancelled(&before, &hub);
    server.until(|seen| seen.token == old).await;
    // Nobody hands the submission's update in again.
    let after = board(&server.url, "ns", 11, &new);
    hub.serve(&after.leaderboard, &after).unwrap();
    let put = server.until(|seen| seen.method == "PUT").await;
    assert_eq!(put.token, new);
    assert_eq!(hub.token_refused(&after.leaderboard), None);
    let key = subject(&after).key;
    while !matches!(hub.view(&key).and_then(|view| view.end), Some(Ended::Published { .. })) {
        changes.recv().await.unwrap();
    }
    // A reconcile that still has the old token changes nothing: the token is the Leaderboard's.
    cancelled(&before, &hub);
    let account = Account::of(&after, after.token.digest());
    assert_eq!(hub.state().account_of(&key, &before), account);
}

#[tokio::test(start_paused = true)]
async fn tokens_of_one_user_share_a_budget_within_their_namespace_only() {
    let (_stop, signal) = Stop::new();
    let hub = hub(&Tasks::new(signal), || true);
    let slow = |target: Target| Target {
        requests_per_minute: 10,
        ..target
    };
    let address = "http://127.0.0.1:9";
    let one = board(address, "ns", 11, &token("one"));
    let two = slow(board(address, "ns", 12, &token("two")));
    let far = board(address, "far", 13, &token("two"));
    for board in [&one, &two, &far] {
        hub.serve(&board.leaderboard, board).unwrap();
    }
    let limit = |board: &Target| hub.usage(&board.leaderboard).unwrap().limit;
    assert_eq!((limit(&one), limit(&two), limit(&far)), (10, 10, 6000));
    assert_eq!(hub.load().limit, 6010);
    assert_eq!(hub.state().tokens.len(), 3);
}
