//! Where a look-up may connect to. Participants choose the name of an image, and a registry chooses where a redirect leads: without
//! this the operator would connect for them to whatever its own network can reach.

use std::net::{IpAddr, Ipv4Addr};

use reqwest::Url;

use crate::services::public::Reach;
use leaderboard_api::ranges::{self, Range};

/// To a registry that the host's patterns name: also one in the host's own network.
pub(super) const REGISTRY: Reach = Reach::of(may_be_a_registry);

/// False for this machine, and for what answers machines alone, such as the service that hands out credentials.
fn may_be_a_registry(address: IpAddr) -> bool {
    let address = embedded(address);
    let is_machines = address.is_loopback() || address.is_unspecified() || address.is_multicast();
    let answers_for_machines = |alone| ranges::forbidden().any(|range| range.contains(alone));
    !is_machines && !Range::alone(address).is_none_or(answers_for_machines)
}

/// The host of an address as an IP, where it is one.
pub(super) fn ip(url: &Url) -> Option<IpAddr> {
    let host = url.host_str()?;
    host.trim_matches(['[', ']']).parse().ok()
}

/// The IPv4 address that an IPv6 address stands for.
fn embedded(address: IpAddr) -> IpAddr {
    let IpAddr::V6(v6) = address else { return address };
    let last = |high: u16, low: u16| {
        let ([a, b], [c, d]) = (high.to_be_bytes(), low.to_be_bytes());
        IpAddr::V4(Ipv4Addr::new(a, b, c, d))
    };
    match v6.segments() {
        // `::ffff:0:0/96`, NAT64 and 6to4.
        [0, 0, 0, 0, 0, 0xffff, high, low] | [0x64, 0xff9b, 0, 0, 0, 0, high, low] | [0x2002, high, low, ..] => {
            last(high, low)
        }
        // The old form `::a.b.c.d`, whose first two addresses are others.
        [0, 0, 0, 0, 0, 0, high, low] if high != 0 => last(high, low),
        _ => address,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_redirect_goes_to_public_addresses_and_a_registry_may_be_the_hosts_own() {
        for (address, of_registry, is_public) in [
            ("52.216.1.1", true, true),
            ("2600:1f00::1", true, true),
            ("10.0.0.5", true, false),
            ("172.16.0.1", true, false),
            ("192.168.1.1", true, false),
            ("100.64.0.1", true, false),
            ("198.18.0.1", true, false),
            ("192.0.0.8", true, false),
            ("240.0.0.1", true, false),
            ("255.255.255.255", true, false),
            ("0.1.2.3", true, false),
            ("fd12::1", true, false),
            ("2001:db8::1", true, false),
            ("64:ff9b::10.0.0.5", true, false),
            ("::ffff:10.0.0.5", true, false),
            ("2002:a00:5::", true, false),
            ("127.0.0.1", false, false),
            ("::1", false, false),
            ("::ffff:127.0.0.1", false, false),
            ("::127.0.0.1", false, false),
            ("0.0.0.0", false, false),
            ("::", false, false),
            ("169.254.169.254", false, false),
            ("::ffff:169.254.169.254", false, false),
            ("64:ff9b::169.254.169.254", false, false),
            ("2002:a9fe:a9fe::", false, false),
            ("fe80::1", false, false),
            ("fd00:ec2::254", false, false),
            ("168.63.129.16", false, false),
            ("100.100.100.200", false, false),
            ("224.0.0.1", false, false),
            ("ff02::1", false, false),
        ] {
            let ip: IpAddr = address.parse().unwrap();
            assert_eq!(may_be_a_registry(ip), of_registry, "{address}");
            assert_eq!(ranges::is_public(ip), is_public, "{address}");
        }
    }

    #[test]
    fn an_address_is_known_in_every_spelling() {
        for (text, wanted) in [
            ("https://127.1/", Some("127.0.0.1")),
            ("https://0x7f.0.0.1/", Some("127.0.0.1")),
            ("https://2130706433/", Some("127.0.0.1")),
            ("https://[::1]:5000/", Some("::1")),
            ("https://r.example/", None),
        ] {
            let url = Url::parse(text).unwrap();
            assert_eq!(ip(&url), wanted.map(|ip| ip.parse().unwrap()), "{text}");
        }
    }
}
