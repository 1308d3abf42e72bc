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
use tokio::time::{Instant, sleep, timeout};

use leaderboard_api::ranges;
use leaderboard_contract::run::Isolation;

/// Time that one connection may take.
const TRY: Duration = Duration::from_secs(1);
/// Between a connection that was made and the next try.
const PAUSE: Duration = Duration::from_millis(500);
/// Tries in a row that must fail: one may be lost without any policy, and an API server that is being restarted refuses some.
const FAILURES: u32 = 3;
/// Where a Pod before has waited in vain: a plugin that is some seconds late must not be called absent again each time.
const KNOWN_OPEN: Duration = Duration::from_secs(10);

/// Result of the measurement.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Finding {
    /// Forbidden addresses cannot be reached, and how that showed.
    Enforced(SocketAddr, Blocked),
    /// It can.
    Open(SocketAddr),
    /// Nothing could be tried, and why.
    Unmeasured(String),
}

/// How connections have failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Blocked {
    /// Without an answer: most network plugins drop what a policy forbids.
    Silent,
    /// By a refusal at the last: some plugins reject it, and so does a closed port.
    Refused,
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Enforced(address, Blocked::Silent) => write!(
                f,
                "The Pod could not connect to {address}, which its NetworkPolicy forbids: the policy is enforced."
            ),
            Self::Enforced(address, Blocked::Refused) => write!(
                f,
                "The Pod could not connect to {address}, which its NetworkPolicy forbids: the policy is enforced. The \
                 connections were refused, as some network plugins do and as an address does at which nothing listens: if \
                 network.probe is set, check that {address} accepts connections from elsewhere."
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
/// count as proof only after `enforced_within`, or `KNOWN_OPEN` where a Pod before has waited for that in vain.
pub async fn find(asked: &Isolation, api_server: Option<SocketAddr>, enforced_within: Duration) -> Finding {
    let address = match address(asked, api_server) {
        Ok(address) => address,
        Err(why) => return Finding::Unmeasured(why),
    };
    let patience = if asked.is_known_open {
        KNOWN_OPEN.min(enforced_within)
    } else {
        enforced_within
    };
    match measure(|| reach(address), patience).await {
        Try::Blocked(how) => Finding::Enforced(address, how),
        Try::Connected => Finding::Open(address),
        Try::NoRoute => Finding::Unmeasured(format!(
            "The Pod has no route to {address}, so whether the NetworkPolicy is enforced is not known. Set network.probe to an \
             address and port that Pods have a route to, that answer and that network.egress does not allow."
        )),
    }
}

/// The address to try, or why there is none.
fn address(asked: &Isolation, api_server: Option<SocketAddr>) -> Result<SocketAddr, String> {
    let address = match &asked.probe {
        Some(probe) => probe.parse().map_err(|_| {
            format!(
                "network.probe {probe} is not an address and port, so whether the NetworkPolicy is enforced is not known. \
                 Set it to one such as 192.0.2.1:443 or [2001:db8::1]:443 that answers, or leave it out."
            )
        })?,
        None => api_server.ok_or_else(|| {
            "There is no address to try, so whether the NetworkPolicy is enforced is not known. Set network.probe to an \
             address and port that answer and that network.egress does not allow."
                .to_owned()
        })?,
    };
    if ranges::allows(asked.egress.iter().map(String::as_str), address.ip()) {
        return Err(format!(
            "network.egress allows {address}, so trying it shows nothing. Allow less, or set network.probe to an address \
             and port that answer and that network.egress does not allow."
        ));
    }
    Ok(address)
}

/// Result of one try, or of all of them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Try {
    /// A connection was made, the only proof that packets come through.
    Connected,
    Blocked(Blocked),
    /// It could not even be sent: that proves nothing, unless it could be before.
    NoRoute,
}

/// Tries until enough fail in a row, or until they have done anything else for too long.
async fn measure(mut reach: impl AsyncFnMut() -> Try, patience: Duration) -> Try {
    let began = Instant::now();
    let (mut failures, mut was_reached) = (0, false);
    loop {
        let tried = Instant::now();
        let found = reach().await;
        let how = match found {
            Try::Blocked(how) => Some(how),
            Try::NoRoute if was_reached => Some(Blocked::Silent),
            Try::Connected | Try::NoRoute => None,
        };
        let Some(how) = how else {
            was_reached |= found == Try::Connected;
            if began.elapsed() >= patience {
                return if was_reached { Try::Connected } else { Try::NoRoute };
            }
            failures = 0;
            sleep(PAUSE).await;
            continue;
        };
        failures = u32::saturating_add(failures, 1);
        // An error that comes at once counts for no more than a silence.
        sleep(TRY.saturating_sub(tried.elapsed())).await;
        if failures == FAILURES {
            return Try::Blocked(how);
        }
    }
}

/// Tries to connect, for at most [`TRY`]. `of_error` tells the network's answers from other errors that come at once.
async fn reach(address: SocketAddr) -> Try {
    match timeout(TRY, TcpStream::connect(address)).await {
        Ok(Ok(_)) => Try::Connected,
        Ok(Err(error)) => of_error(error.kind()),
        Err(_) => Try::Blocked(Blocked::Silent),
    }
}

fn of_error(kind: io::ErrorKind) -> Try {
    match kind {
        io::ErrorKind::ConnectionRefused | io::ErrorKind::ConnectionReset | io::ErrorKind::PermissionDenied => {
            Try::Blocked(Blocked::Refused)
        }
        io::ErrorKind::TimedOut => Try::Blocked(Blocked::Silent),
        _ => Try::NoRoute,
    }
}

#[cfg(test)]
mod tests {
    use tokio::net::{TcpListener, TcpSocket};

    use super::*;
    use leaderboard_api::Enforcement;

    const WITHIN: Duration = Duration::from_mins(1);

    fn asked() -> Isolation {
        Isolation {
            enforcement: Enforcement::Warn,
            probe: None,
            egress: Vec::new(),
            is_known_open: false,
        }
    }

    /// True if it is found to be enforced, and after how many milliseconds, where connections are made until `until`, and
    /// once at each of `also`.
    async fn found(until: Duration, also: &[u64], patience: Duration) -> (bool, u128) {
        let began = Instant::now();
        let reach = async || {
            let now = began.elapsed();
            if now < until || also.iter().any(|at| Duration::from_millis(*at) == now) {
                return Try::Connected;
            }
            sleep(TRY).await;
            Try::Blocked(Blocked::Silent)
        };
        let found = measure(reach, patience).await;
        (found == Try::Blocked(Blocked::Silent), began.elapsed().as_millis())
    }

    /// Finding where the tries show this, one after the other, and the last again and again; and after how many seconds.
    async fn of(tries: &[Try], patience: Duration) -> (Try, u64) {
        let (began, mut next) = (Instant::now(), 0);
        let reach = async || {
            next += 1;
            tries[(next - 1).min(tries.len() - 1)]
        };
        let found = measure(reach, patience).await;
        (found, began.elapsed().as_secs())
    }

    #[tokio::test(start_paused = true)]
    async fn a_plugin_that_rejects_enforces_and_a_missing_route_proves_nothing() {
        use Try::{Connected, NoRoute};
        let refused = Try::Blocked(Blocked::Refused);
        let silent = Try::Blocked(Blocked::Silent);
        let (by_refusal, by_silence) = (Try::Blocked(Blocked::Refused), Try::Blocked(Blocked::Silent));
        let cases: [(&str, &[Try], (Try, u64)); 8] = [
            ("it rejects", &[refused], (by_refusal, 3)),
            ("it drops", &[silent], (by_silence, 3)),
            ("both", &[silent, refused, silent], (by_silence, 3)),
            (
                "an API server that is being restarted",
                &[refused, refused, Connected],
                (Try::Connected, 60),
            ),
            (
                "no route yet",
                &[NoRoute, NoRoute, NoRoute, NoRoute, silent],
                (by_silence, 5),
            ),
            ("no route ever", &[NoRoute], (Try::NoRoute, 60)),
            (
                "no route yet, then open",
                &[NoRoute, NoRoute, Connected],
                (Try::Connected, 60),
            ),
            ("a route that is taken away", &[Connected, NoRoute], (by_silence, 3)),
        ];
        for (name, tries, expected) in cases {
            assert_eq!(of(tries, WITHIN).await, expected, "{name}");
        }
    }

    #[test]
    fn only_an_answer_of_the_network_is_a_failure() {
        use io::ErrorKind::{
            AddrNotAvailable, ConnectionRefused, ConnectionReset, HostUnreachable, NetworkUnreachable, OutOfMemory,
            PermissionDenied,
        };
        for kind in [ConnectionRefused, ConnectionReset, PermissionDenied] {
            assert_eq!(of_error(kind), Try::Blocked(Blocked::Refused), "{kind}");
        }
        for kind in [NetworkUnreachable, HostUnreachable, AddrNotAvailable, OutOfMemory] {
            assert_eq!(of_error(kind), Try::NoRoute, "{kind}");
        }
    }

    #[tokio::test(start_paused = true)]
    async fn where_a_pod_has_waited_in_vain_a_plugin_that_is_late_is_still_noticed() {
        assert_eq!(found(Duration::from_secs(8), &[], KNOWN_OPEN).await, (true, 11_000));
        assert_eq!(found(Duration::MAX, &[], KNOWN_OPEN).await, (false, 10_000));
    }

    #[tokio::test]
    async fn a_probe_that_is_no_address_is_named() {
        for probe in ["999.1.1.1:99999", "10.0.0.1:0x1", "10.0.0.1"] {
            let asked = Isolation {
                probe: Some(probe.to_owned()),
                ..asked()
            };
            let found = find(&asked, "10.96.0.1:443".parse().ok(), WITHIN).await;
            let said = found.to_string();
            assert!(
                matches!(found, Finding::Unmeasured(_)) && said.starts_with(&format!("network.probe {probe} is not")),
                "{said}"
            );
        }
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
        assert_eq!(
            found(Duration::ZERO, &[], Duration::ZERO).await,
            (true, 3_000),
            "a plugin that was installed since is noticed"
        );
    }

    #[tokio::test]
    async fn only_a_connection_that_is_made_reaches_an_address() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        assert_eq!(reach(address).await, Try::Connected);
        drop(listener);
        assert_eq!(reach(address).await, Try::Blocked(Blocked::Refused));

        // A listener whose queue is full drops what else comes, as a policy does.
        let socket = TcpSocket::new_v4().unwrap();
        socket.bind("127.0.0.1:0".parse().unwrap()).unwrap();
        let full = socket.listen(0).unwrap();
        let address = full.local_addr().unwrap();
        let _queued = TcpStream::connect(address).await.unwrap();
        assert_eq!(reach(address).await, Try::Blocked(Blocked::Silent));
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
        let found = find(&named, api_server, Duration::ZERO).await;
        assert_eq!(found, Finding::Open(listener.local_addr().unwrap()));
    }
}
