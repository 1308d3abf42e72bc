//! Measures whether the NetworkPolicy of this Pod is enforced: an object in the API server proves nothing.
//!
//! Called by `workspace`, before anything of a stranger runs and before S3 is used: what a network plugin cuts when it
//! begins to enforce is then no connection of ours. Knows one address and no Kubernetes.
//!
//! The address is the API server's Service unless the host names another. It is the one address that every Pod knows and
//! that answers on TCP in every cluster, and no submission needs it. Others would mislead: the cluster's DNS is allowed, and
//! a metadata address is silent wherever there is no cloud or where its hop limit keeps Pods out.

use std::fmt;
use std::io;
use std::net::SocketAddr;
use std::time::Duration;

use tokio::net::TcpStream;
use tokio::time::{Instant, sleep, sleep_until, timeout};

use super::run::Isolation;
use crate::api::ranges;

/// Time that one connection may take.
const TRY: Duration = Duration::from_secs(1);
/// Between a connection that was made and the next try.
const PAUSE: Duration = Duration::from_millis(500);
/// Tries in a row that must fail: one may be lost without any policy.
const FAILURES: u32 = 3;

/// What was found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Finding {
    /// What the policy forbids cannot be reached.
    Enforced(SocketAddr),
    /// It can.
    Open(SocketAddr),
    /// Nothing could be tried, and why.
    Unmeasured(String),
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Enforced(address) => write!(
                f,
                "The Pod could not connect to {address}, which its NetworkPolicy forbids: the policy is enforced."
            ),
            Self::Open(address) => write!(
                f,
                "The Pod could connect to {address}, which its NetworkPolicy forbids: the policy is not enforced. Use a \
                 network plugin that enforces NetworkPolicies; if network.egress allows the API server's own addresses, set \
                 network.probe to an address and port that answer and that network.egress does not allow."
            ),
            Self::Unmeasured(why) => f.write_str(why),
        }
    }
}

/// Looks for what the policy forbids. A network plugin may let a new Pod through until it has heard of it, so connections
/// count as proof only after `enforced_within`; where a Pod before has waited for that in vain, the first one does.
pub async fn find(asked: &Isolation, api_server: Option<SocketAddr>, enforced_within: Duration) -> Finding {
    let named = asked.probe.as_ref().map(|probe| probe.parse().ok());
    let Some(address) = named.unwrap_or(api_server) else {
        let why = "There is no address to try, so whether the NetworkPolicy is enforced is not known. Set network.probe to \
                   an address and port that answer and that network.egress does not allow.";
        return Finding::Unmeasured(why.to_owned());
    };
    if ranges::allows(asked.egress.iter().map(String::as_str), address.ip()) {
        return Finding::Unmeasured(format!(
            "network.egress allows {address}, so trying it shows nothing. Allow less, or set network.probe to an address \
             and port that answer and that network.egress does not allow."
        ));
    }
    let patience = if asked.is_known_open {
        Duration::ZERO
    } else {
        enforced_within
    };
    if is_kept_from(|| reaches(address), patience).await {
        Finding::Enforced(address)
    } else {
        Finding::Open(address)
    }
}

/// Whether connections fail in a row before they have succeeded for too long.
async fn is_kept_from(mut reaches: impl AsyncFnMut() -> bool, patience: Duration) -> bool {
    let began = Instant::now();
    let mut failures = 0;
    while failures < FAILURES {
        let tried = Instant::now();
        if reaches().await {
            if began.elapsed() >= patience {
                return false;
            }
            failures = 0;
            sleep(PAUSE).await;
        } else {
            failures += 1;
            // An error that comes at once, such as of a route that is not set up yet, counts for no more than a silence.
            sleep_until(tried + TRY).await;
        }
    }
    true
}

/// Whether packets come through. A refusal does count: the address has answered. Network plugins drop what a policy
/// forbids, and an API server that is being restarted refuses.
async fn reaches(address: SocketAddr) -> bool {
    match timeout(TRY, TcpStream::connect(address)).await {
        Ok(Ok(_)) => true,
        Ok(Err(error)) => matches!(
            error.kind(),
            io::ErrorKind::ConnectionRefused | io::ErrorKind::ConnectionReset
        ),
        Err(_) => false,
    }
}

#[cfg(test)]
mod tests {
    use tokio::net::{TcpListener, TcpSocket};

    use super::*;
    use crate::api::Enforcement;

    const WITHIN: Duration = Duration::from_mins(1);

    fn asked() -> Isolation {
        Isolation {
            enforcement: Enforcement::Warn,
            probe: None,
            egress: Vec::new(),
            is_known_open: false,
        }
    }

    /// What is found, and after how many milliseconds, where connections are made until `until`, and once at each of `also`.
    async fn found(until: Duration, also: &[u64], patience: Duration) -> (bool, u128) {
        let began = Instant::now();
        let reaches = async || {
            let now = began.elapsed();
            let is_open = now < until || also.iter().any(|at| Duration::from_millis(*at) == now);
            if !is_open {
                sleep(TRY).await;
            }
            is_open
        };
        (is_kept_from(reaches, patience).await, began.elapsed().as_millis())
    }

    #[tokio::test(start_paused = true)]
    async fn a_policy_that_is_enforced_costs_three_seconds() {
        assert_eq!(found(Duration::ZERO, &[], WITHIN).await, (true, 3_000));
    }

    #[tokio::test(start_paused = true)]
    async fn a_plugin_that_is_late_is_waited_for() {
        assert_eq!(found(Duration::from_secs(40), &[], WITHIN).await, (true, 43_000));
        assert_eq!(
            found(Duration::ZERO, &[2_000], WITHIN).await,
            (true, 5_500),
            "only failures in a row count"
        );
    }

    #[tokio::test(start_paused = true)]
    async fn where_nothing_enforces_a_minute_is_lost_once() {
        assert_eq!(found(Duration::MAX, &[], WITHIN).await, (false, 60_000));
        assert_eq!(found(Duration::MAX, &[], Duration::ZERO).await, (false, 0));
        assert_eq!(
            found(Duration::ZERO, &[], Duration::ZERO).await,
            (true, 3_000),
            "a plugin that was installed since is noticed"
        );
    }

    #[tokio::test]
    async fn what_answers_is_reached_and_what_is_silent_is_not() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        assert!(reaches(address).await);
        drop(listener);
        assert!(reaches(address).await, "a refusal is an answer");

        // A listener whose queue is full drops what else comes, as a policy does.
        let socket = TcpSocket::new_v4().unwrap();
        socket.bind("127.0.0.1:0".parse().unwrap()).unwrap();
        let full = socket.listen(0).unwrap();
        let address = full.local_addr().unwrap();
        let _queued = TcpStream::connect(address).await.unwrap();
        assert!(!reaches(address).await);
    }

    #[tokio::test]
    async fn an_address_that_shows_nothing_is_not_tried() {
        let api_server = "10.96.0.1:443".parse().ok();
        let wide = Isolation {
            egress: vec!["10.0.0.0/8".to_owned()],
            ..asked()
        };
        let found = find(&wide, api_server, WITHIN).await;
        assert!(
            matches!(&found, Finding::Unmeasured(why) if why.contains("allows 10.96.0.1:443")),
            "{found}"
        );
        assert!(matches!(find(&asked(), None, WITHIN).await, Finding::Unmeasured(_)));
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let named = Isolation {
            probe: Some(listener.local_addr().unwrap().to_string()),
            is_known_open: true,
            ..wide
        };
        let found = find(&named, api_server, WITHIN).await;
        assert_eq!(found, Finding::Open(listener.local_addr().unwrap()));
    }
}
