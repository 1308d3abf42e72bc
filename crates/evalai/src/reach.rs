//! Which addresses a stranger may name: those of the internet alone, and none in a network of the operator's.
//!
//! Asked by `network`. Pure. An address that stands in the URL itself is not looked up: ask [`check`] before each request, and follow
//! no redirect without asking again.

use std::net::{IpAddr, SocketAddr};

use url::Url;

/// A host that has no address of the internet.
#[derive(thiserror::Error, Debug, Clone, PartialEq, Eq)]
#[error("{host} is at {address}, which is no address of the internet")]
pub struct NotPublic {
    host: String,
    address: IpAddr,
}

/// True for an address that may be connected to.
pub type Reach = fn(IpAddr) -> bool;

/// Refuses an address in a URL that may not be connected to. A name is judged when it is looked up.
pub fn check(reach: Reach, url: &Url) -> Result<(), NotPublic> {
    let host = url.host_str().unwrap_or_default();
    let address = host.trim_start_matches('[').trim_end_matches(']').parse::<IpAddr>();
    let found = address.map(|address| SocketAddr::new(address, 0)).into_iter();
    reached(reach, host, found.collect()).map(|_| ())
}

/// The addresses of a host that may be connected to. An error: all that were found may not.
pub(super) fn reached(reach: Reach, host: &str, found: Vec<SocketAddr>) -> Result<Vec<SocketAddr>, NotPublic> {
    let (public, other): (Vec<SocketAddr>, Vec<SocketAddr>) = found.into_iter().partition(|found| reach(found.ip()));
    match (public.is_empty(), other.first()) {
        (true, Some(address)) => Err(NotPublic {
            host: host.to_owned(),
            address: address.ip(),
        }),
        _ => Ok(public),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use leaderboard_api::ranges::is_public;

    #[test]
    fn an_address_in_a_url_is_judged_however_it_is_written() {
        for url in [
            "http://10.0.0.1/",
            "http://127.1/",
            "http://0x7f000001/",
            "http://2130706433/",
            "https://169.254.169.254/latest/meta-data/",
            "http://[::1]:8080/",
            "http://[::ffff:10.0.0.1]/",
            "http://[fd00:ec2::254]/",
        ] {
            assert!(check(is_public, &Url::parse(url).unwrap()).is_err(), "{url}");
        }
        for url in ["https://1.1.1.1/", "https://example.org/", "http://[2600:1f18::1]/"] {
            assert_eq!(check(is_public, &Url::parse(url).unwrap()), Ok(()), "{url}");
        }
    }

    #[test]
    fn of_a_names_addresses_only_public_ones_are_connected_to() {
        let found = |addresses: &[&str]| -> Vec<SocketAddr> {
            addresses
                .iter()
                .map(|address| (address.parse::<IpAddr>().unwrap(), 0).into())
                .collect()
        };
        let reached = |addresses: &[&str]| reached(is_public, "host", found(addresses));
        assert_eq!(reached(&["1.1.1.1", "10.0.0.1", "::1"]).unwrap(), found(&["1.1.1.1"]));
        assert_eq!(
            reached(&["10.0.0.1", "::1"]).unwrap_err().to_string(),
            "host is at 10.0.0.1, which is no address of the internet"
        );
        assert_eq!(reached(&[]).unwrap(), []);
    }
}
