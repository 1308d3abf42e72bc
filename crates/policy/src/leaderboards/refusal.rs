//! Names that a Leaderboard may not use. With one the operator reads no token, asks no queue and sends EvalAI nothing. Pure.

use std::net::IpAddr;

use crate::allowed::Allowed;
use leaderboard_api::{Leaderboard, Reason, ranges};

/// Ends of names that a cluster or a machine gives itself, which the internet has not.
const LOCAL_NAMES: [&str; 5] = [".svc", ".local", ".localhost", ".internal", ".home.arpa"];

/// Why a Leaderboard is not served as it is written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Refusal {
    pub reason: Reason,
    pub message: String,
}

/// The first thing that a Leaderboard names and may not.
pub fn of(allowed: &Allowed, leaderboard: &Leaderboard) -> Option<Refusal> {
    if let Some(refused) = allowed.refusal(leaderboard) {
        return Some(Refusal {
            reason: Reason::NotAllowed,
            message: refused.to_string(),
        });
    }
    let server = &leaderboard.spec.evalai.as_ref()?.api_server;
    is_exposed(server).then(|| Refusal {
        reason: Reason::InsecureServer,
        message: format!(
            "evalai.apiServer {server} would get the host's token unencrypted over the internet; use https. http is for servers inside the \
             cluster and at private addresses."
        ),
    })
}

/// True if a token would go over the internet unencrypted.
fn is_exposed(server: &str) -> bool {
    let Some(rest) = server.strip_prefix("http://") else {
        return false;
    };
    let authority = rest.split(['/', '?', '#']).next().unwrap_or_default();
    let host = match authority.strip_prefix('[') {
        Some(v6) => v6.split(']').next().unwrap_or_default(),
        None => authority.split(':').next().unwrap_or_default(),
    };
    if let Ok(address) = host.parse::<IpAddr>() {
        return ranges::is_public(address);
    }
    let host = host.trim_end_matches('.').to_ascii_lowercase();
    // The resolver's own search list completes a name of one label. A name that ends in a number is an address in another spelling.
    let is_number = host
        .rsplit('.')
        .next()
        .is_some_and(|last| last.starts_with(|first: char| first.is_ascii_digit()));
    is_number || host.contains('.') && !LOCAL_NAMES.iter().any(|end| host.ends_with(end))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn http_is_for_servers_that_are_not_on_the_internet() {
        let cases = [
            ("https://eval.ai", false),
            ("http://eval.ai", true),
            ("http://eval.ai:8000/path", true),
            ("http://EVAL.AI.", true),
            ("http://1.1.1.1", true),
            ("http://[2600:1f18::1]:8000", true),
            ("http://10.77.0.1:8000", false),
            ("http://127.0.0.1:8000", false),
            ("http://[::1]:8000", false),
            ("http://[fd00::1]/path", false),
            ("http://evalai", false),
            ("http://evalai.evalai.svc", false),
            ("http://evalai.evalai.svc.cluster.local:8000", false),
            ("http://localhost:8000", false),
            ("http://evalai.corp.internal", false),
            ("http://evalai.svc.example.org", true),
            ("http://16843009", true),
            ("http://0x1.0x1.0x1.0x1", true),
            ("http://1.1", true),
        ];
        for (server, expected) in cases {
            assert_eq!(is_exposed(server), expected, "{server}");
        }
    }
}
