//! Ranges of addresses, and which addresses the policy of a Leaderboard lets its Pods reach. Pure.
//!
//! Read by the controller, which makes the policy, and in the Pod, which measures whether it is enforced.

use std::net::IpAddr;

/// Where clouds hand out credentials of nodes and Pods: all link-local addresses, and AWS's own of IPv6.
const FORBIDDEN: [(&str, u8); 3] = [("169.254.0.0", 16), ("fe80::", 10), ("fd00:ec2::", 64)];

/// What no policy lets a Pod reach, whatever the host allows.
pub fn forbidden() -> impl Iterator<Item = Range> {
    FORBIDDEN
        .iter()
        .filter_map(|(address, bits)| Range::new(address.parse().ok()?, *bits))
}

/// Whether a policy that allows these ranges lets a Pod reach an address, on some port.
pub fn allows<'a>(mut allowed: impl Iterator<Item = &'a str>, address: IpAddr) -> bool {
    let Some(alone) = Range::new(address, if address.is_ipv4() { 32 } else { 128 }) else {
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

    /// Whether all of another range lies in this one.
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
        assert!(!allowed(&["0.0.0.0/0"], "169.254.169.254"));
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
