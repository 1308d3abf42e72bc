//! The trace of a submission: the same id in each of its log lines and spans, whichever process writes them.
//!
//! Made from the object's UID alone, so that nothing has to be stored for it. Pure.

use std::fmt;

use sha2::{Digest, Sha256};

/// Trace of one submission, over all its attempts. Written as 32 hexadecimal digits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TraceId(u128);

impl TraceId {
    /// Trace of the object with this UID. A UID has fixed bits, by which samplers would take all or none; so it is hashed.
    pub fn of(uid: &str) -> Self {
        let digest = Sha256::digest(uid.as_bytes());
        Self(u128::from_be_bytes(std::array::from_fn(|at| digest[at])))
    }

    /// As OTLP has it.
    pub fn number(self) -> u128 {
        self.0
    }
}

impl fmt::Display for TraceId {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{:032x}", self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_trace_id_is_what_sha256sum_prints_of_the_uid() {
        let id = TraceId::of("5d1f6a3e-7f0f-4c0a-9a57-0d6f7a9f1e11");
        assert_eq!(id.to_string(), "62efba1f0d08135d05d1db695e94c17d");
        assert_ne!(id, TraceId::of("5d1f6a3e-7f0f-4c0a-9a57-0d6f7a9f1e12"));
    }
}
