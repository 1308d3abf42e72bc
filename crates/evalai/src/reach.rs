//! Connections to addresses that a stranger has named: to the internet alone, never into a network of the operator's.
//!
//! A name is looked up once, and what was found is checked and connected to, so that a second look-up cannot lead elsewhere. An address
//! that stands in the URL itself is looked up by nobody: ask [`check`] before each request, and follow no redirect without asking again.
//! Where a proxy is set and used, it is the proxy that connects, and its rules that hold.

use std::error::Error;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;

use reqwest::dns::{Addrs, Name, Resolve, Resolving};
use reqwest::{ClientBuilder, Url};

use leaderboard_api::ranges;

/// Variables with the address of a proxy, in capital letters.
const PROXIES: [&str; 3] = ["HTTPS_PROXY", "HTTP_PROXY", "ALL_PROXY"];

/// A host that has no address of the internet.
#[derive(thiserror::Error, Debug, Clone, PartialEq, Eq)]
#[error("{host} is at {address}, which is no address of the internet")]
pub struct NotPublic {
    host: String,
    address: IpAddr,
}

/// Which addresses may be connected to.
#[derive(Clone, Copy, Debug)]
pub struct Reach(fn(IpAddr) -> bool);

impl Default for Reach {
    fn default() -> Self {
        Self(ranges::is_public)
    }
}

impl Reach {
    /// Another rule than the internet's.
    #[cfg(test)]
    pub const fn of(rule: fn(IpAddr) -> bool) -> Self {
        Self(rule)
    }

    /// A client that connects nowhere else. It follows no redirect.
    pub fn limit(self, builder: ClientBuilder) -> ClientBuilder {
        let proxies = proxies(|name| std::env::var(name).ok());
        builder
            .redirect(reqwest::redirect::Policy::none())
            .dns_resolver(Arc::new(Resolver { reach: self, proxies }))
    }

    /// Refuses an address in a URL that may not be connected to. A name is judged when it is looked up.
    pub fn check(self, url: &Url) -> Result<(), NotPublic> {
        let host = url.host_str().unwrap_or_default();
        let address = host.trim_start_matches('[').trim_end_matches(']').parse();
        match address {
            Ok(address) if !(self.0)(address) => Err(NotPublic {
                host: host.to_owned(),
                address,
            }),
            _ => Ok(()),
        }
    }
}

/// Refused address, if a request has failed because of where it would have gone.
pub fn cause(error: &reqwest::Error) -> Option<&NotPublic> {
    std::iter::successors(error.source(), |error| (*error).source()).find_map(|cause| cause.downcast_ref())
}

struct Resolver {
    reach: Reach,
    proxies: Vec<String>,
}

impl Resolve for Resolver {
    fn resolve(&self, name: Name) -> Resolving {
        let is_proxy = self
            .proxies
            .iter()
            .any(|proxy| proxy.eq_ignore_ascii_case(name.as_str()));
        let reach = self.reach;
        Box::pin(async move {
            let found: Vec<SocketAddr> = tokio::net::lookup_host((name.as_str(), 0)).await?.collect();
            if is_proxy {
                let all: Addrs = Box::new(found.into_iter());
                return Ok(all);
            }
            Ok(reached(reach, name.as_str(), found)?)
        })
    }
}

fn reached(reach: Reach, host: &str, found: Vec<SocketAddr>) -> Result<Addrs, NotPublic> {
    let (public, other): (Vec<SocketAddr>, Vec<SocketAddr>) =
        found.into_iter().partition(|found| (reach.0)(found.ip()));
    match (public.is_empty(), other.first()) {
        (true, Some(address)) => Err(NotPublic {
            host: host.to_owned(),
            address: address.ip(),
        }),
        _ => Ok(Box::new(public.into_iter())),
    }
}

/// The hosts of the proxies that the environment sets.
fn proxies(variable: impl Fn(&str) -> Option<String>) -> Vec<String> {
    let set = PROXIES
        .iter()
        .flat_map(|name| [variable(name), variable(&name.to_lowercase())]);
    let host = |text: String| {
        let url = if text.contains("://") {
            text
        } else {
            format!("http://{text}")
        };
        Url::parse(&url).ok()?.host_str().map(str::to_owned)
    };
    set.flatten().filter_map(host).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

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
            assert!(Reach::default().check(&Url::parse(url).unwrap()).is_err(), "{url}");
        }
        for url in ["https://1.1.1.1/", "https://example.org/", "http://[2600:1f18::1]/"] {
            assert_eq!(Reach::default().check(&Url::parse(url).unwrap()), Ok(()), "{url}");
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
        let reached =
            |addresses: &[&str]| reached(Reach::default(), "host", found(addresses)).map(Iterator::collect::<Vec<_>>);
        assert_eq!(reached(&["1.1.1.1", "10.0.0.1", "::1"]).unwrap(), found(&["1.1.1.1"]));
        assert_eq!(
            reached(&["10.0.0.1", "::1"]).unwrap_err().to_string(),
            "host is at 10.0.0.1, which is no address of the internet"
        );
        assert_eq!(reached(&[]).unwrap(), []);
    }

    #[test]
    fn a_proxy_may_be_anywhere() {
        let set = |name: &str| match name {
            "HTTPS_PROXY" => Some("http://proxy.internal:3128".to_owned()),
            "http_proxy" => Some("10.0.0.2:3128".to_owned()),
            _ => None,
        };
        assert_eq!(proxies(set), ["proxy.internal", "10.0.0.2"]);
    }
}
