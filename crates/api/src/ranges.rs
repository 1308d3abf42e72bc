//! Ranges of addresses, and which addresses the policy of a Leaderboard lets its Pods reach. Pure.
//!
//! The controller reads them to make the policy, and a Pod reads them to measure whether the policy is enforced.
//! The module also tells public addresses from others: a URL that a participant may have chosen leads to public ones only.

use std::net::{IpAddr, Ipv4Addr};

/// Where clouds hand out credentials of nodes and Pods: all link-local addresses, AWS's own of IPv6, and those of Alibaba, Azure and
/// Oracle that are not link-local.
const FORBIDDEN: [(&str, u8); 6] = [
    ("169.254.0.0", 16),
    ("100.100.100.200", 32),
    ("168.63.129.16", 32),
    ("192.0.0.192", 32),
    ("fe80::", 10),
    ("fd00:ec2::", 64),
];

/// Ranges that no server on the internet owns, or that lead back into a private network (IANA's registries of special addresses).
const NOT_PUBLIC: [(&str, u8); 25] = [
    ("0.0.0.0", 8),
    ("10.0.0.0", 8),
    // Between a provider and its customers; EKS gives it to Pods too.
    ("100.64.0.0", 10),
    ("127.0.0.0", 8),
    ("169.254.0.0", 16),
    // Azure's own services, on every one of its machines.
    ("168.63.129.16", 32),
    ("172.16.0.0", 12),
    ("192.0.0.0", 24),
    ("192.0.2.0", 24),
    ("192.88.99.0", 24),
    ("192.168.0.0", 16),
    ("198.18.0.0", 15),
    ("198.51.100.0", 24),
    ("203.0.113.0", 24),
    // Multicast, the reserved ones, and broadcast.
    ("224.0.0.0", 3),
    // Protocols' own, with tunnels whose end an address names (Teredo).
    ("2001::", 23),
    ("2001:db8::", 32),
    // Tunnels whose end an address names (6to4).
    ("2002::", 16),
    ("3fff::", 20),
    // All that is not 2000::/3: loopback, local, unique local and multicast among it.
    ("::", 3),
    ("4000::", 2),
    ("8000::", 2),
    ("c000::", 3),
    ("e000::", 4),
    ("f000::", 4),
];

/// IPv6 prefixes in front of an IPv4 address: the form that a socket shows, and the form that a NAT64 gateway takes.
const LEADS_TO_V4: [(&str, u8); 2] = [("::ffff:0:0", 96), ("64:ff9b::", 96)];

/// True if an address belongs to a server on the internet. Private, local, shared, documentation, multicast and reserved
/// addresses do not, nor do addresses that lead to one of these.
pub fn is_public(address: IpAddr) -> bool {
    let address = leads_to(address);
    let Some(alone) = Range::alone(address) else {
        return false;
    };
    !table(&NOT_PUBLIC).any(|range| range.contains(alone))
}

/// The IPv4 address that one of IPv6 leads to, else the address itself.
fn leads_to(address: IpAddr) -> IpAddr {
    let (IpAddr::V6(v6), Some(alone)) = (address, Range::alone(address)) else {
        return address;
    };
    if !table(&LEADS_TO_V4).any(|range| range.contains(alone)) {
        return address;
    }
    let [.., high, low] = v6.segments();
    let [a, b] = high.to_be_bytes();
    let [c, d] = low.to_be_bytes();
    Ipv4Addr::new(a, b, c, d).into()
}

/// The ranges that no policy lets a Pod reach, whatever the host allows.
pub fn forbidden() -> impl Iterator<Item = Range> {
    table(&FORBIDDEN)
}

fn table(rows: &'static [(&str, u8)]) -> impl Iterator<Item = Range> {
    rows.iter()
        .filter_map(|(address, bits)| Range::new(address.parse().ok()?, *bits))
}

/// True if a policy that allows these ranges lets a Pod reach an address, on some port.
pub fn allows<'a>(mut allowed: impl Iterator<Item = &'a str>, address: IpAddr) -> bool {
    let Some(alone) = Range::alone(address) else {
        return false;
    };
    let is_in = |cidr: &str| Range::parse(cidr).is_some_and(|range| range.contains(alone));
    !forbidden().any(|range| range.contains(alone)) && allowed.any(is_in)
}

/// A range of addresses. Both kinds are kept as 128 bits, the number left-aligned.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Range {
    v6: bool,
    start: u128,
    bits: u8,
}

impl Range {
    /// Reads `10.0.0.0/16`; bits behind the prefix count as zero.
    pub fn parse(text: &str) -> Option<Self> {
        let (address, bits) = text.split_once('/')?;
        Self::new(address.parse().ok()?, bits.parse().ok()?)
    }

    /// Reads an address or a range.
    pub fn of(text: &str) -> Option<Self> {
        match text.parse() {
            Ok(address) => Self::alone(address),
            Err(_) => Self::parse(text),
        }
    }

    /// The range of `bits` bits around an address.
    pub fn new(address: IpAddr, bits: u8) -> Option<Self> {
        let (v6, number, width) = match address {
            IpAddr::V4(address) => (false, u128::from(address.to_bits()) << 96, 32),
            IpAddr::V6(address) => (true, address.to_bits(), 128),
        };
        (bits <= width).then(|| Self {
            v6,
            start: number & mask(bits),
            bits,
        })
    }

    /// The range of one address.
    pub fn alone(address: IpAddr) -> Option<Self> {
        Self::new(address, if address.is_ipv4() { 32 } else { 128 })
    }

    /// True if all of another range lies in this one.
    pub fn contains(self, other: Self) -> bool {
        self.v6 == other.v6 && self.bits <= other.bits && other.start & mask(self.bits) == self.start
    }

    /// As it is written.
    pub fn text(self) -> String {
        let address = if self.v6 {
            IpAddr::V6(self.start.into())
        } else {
            IpAddr::V4(u32::try_from(self.start >> 96).unwrap_or_default().into())
        };
        format!("{address}/{}", self.bits)
    }
}

fn mask(bits: u8) -> u128 {
    u128::MAX.checked_shl(128 - u32::from(bits)).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_is_allowed_by_a_range_that_holds_it_unless_no_policy_allows_it() {
        let allowed = |cidrs: &[&str], address: &str| allows(cidrs.iter().copied(), address.parse().unwrap());
        assert!(allowed(&["192.0.2.0/24", "10.0.0.0/8"], "10.96.0.1"));
        assert!(allowed(&["fd00::/8"], "fd00:1::1"));
        assert!(!allowed(&[], "10.96.0.1"));
        assert!(!allowed(&["10.96.0.2/32", "::/0", "nonsense"], "10.96.0.1"));
        for metadata in ["169.254.169.254", "168.63.129.16", "100.100.100.200", "192.0.0.192"] {
            assert!(!allowed(&["0.0.0.0/0"], metadata), "{metadata}");
        }
    }

    #[test]
    fn every_row_of_the_tables_is_read() {
        assert_eq!(forbidden().count(), FORBIDDEN.len());
        assert_eq!(table(&NOT_PUBLIC).count(), NOT_PUBLIC.len());
        assert_eq!(table(&LEADS_TO_V4).count(), LEADS_TO_V4.len());
        let text = |(address, bits): &(&str, u8)| format!("{address}/{bits}");
        let rows: Vec<String> = FORBIDDEN.iter().chain(&NOT_PUBLIC).map(text).collect();
        let read: Vec<String> = forbidden().chain(table(&NOT_PUBLIC)).map(Range::text).collect();
        assert_eq!(read, rows);
    }

    const PUBLIC: &str = "
        1.1.1.1 52.94.133.131 100.63.255.255 100.128.0.0 168.63.129.17 172.15.255.255 172.32.0.0 192.0.1.0
        198.17.255.255 198.20.0.0 223.255.255.255 2600:1f18::1 2001:200::1 ::ffff:1.1.1.1 64:ff9b::1.1.1.1";
    const PRIVATE: &str = "
        0.0.0.0 0.1.2.3 10.0.0.1 100.64.0.1 100.100.100.200 127.0.0.1 127.255.255.254 168.63.129.16 169.254.169.254
        172.16.0.1 172.31.255.255 192.0.0.192 192.0.2.1 192.88.99.1 192.168.1.1 198.18.0.1 198.51.100.1 203.0.113.1
        224.0.0.1 240.0.0.1 255.255.255.255 :: ::1 ::10.0.0.1 ::ffff:10.0.0.1 ::ffff:169.254.169.254
        64:ff9b::10.0.0.1 64:ff9b::169.254.169.254 64:ff9b:1::1.1.1.1 100::1 2001::1 2001:db8::1 2002:a9fe:a9fe::1
        2002:101:101::1 3fff::1 4000::1 5f00::1 8000::1 c000::1 fc00::1 fd00:ec2::254 fe80::1 fec0::1 ff02::1";

    #[test]
    fn only_addresses_of_the_internet_are_public() {
        for address in PUBLIC.split_whitespace() {
            assert!(is_public(address.parse().unwrap()), "{address}");
        }
        for address in PRIVATE.split_whitespace() {
            assert!(!is_public(address.parse().unwrap()), "{address}");
        }
    }

    #[test]
    fn ranges_are_read_exactly() {
        for bad in [
            "",
            "10.0.0.0",
            "10.0.0.0/33",
            "::/129",
            "a/8",
            "10.0.0/8",
            "10.0.0.0/-1",
        ] {
            assert_eq!(Range::parse(bad), None, "{bad}");
        }
        for (text, expected) in [
            ("10.9.8.7/8", "10.0.0.0/8"),
            ("0.0.0.0/0", "0.0.0.0/0"),
            ("2001:DB8::1/32", "2001:db8::/32"),
            ("1.2.3.4/32", "1.2.3.4/32"),
        ] {
            assert_eq!(Range::parse(text).map(Range::text).as_deref(), Some(expected));
        }
    }
}
