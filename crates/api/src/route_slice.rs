//! Consecutive routes: of a pair in a plan, and as `carla.routeSubsets` and the evaluator write them.
//!
//! Pure.

use std::fmt;
use std::str::FromStr;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Consecutive routes of one pair.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, PartialEq, Eq)]
pub struct RouteSlice {
    /// Number of the first route, counted from 0.
    #[schemars(range(min = 0, max = 99_999))]
    pub first: u32,
    /// Number of the last route.
    #[schemars(range(min = 0, max = 99_999))]
    pub last: u32,
}

impl RouteSlice {
    /// How many routes it has.
    pub fn routes(self) -> u32 {
        self.last.saturating_sub(self.first).saturating_add(1)
    }
}

/// As the evaluator's `ROUTES_SUBSET` takes it: `5-9`.
impl fmt::Display for RouteSlice {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{}-{}", self.first, self.last)
    }
}

/// A text that is not a [`RouteSlice`].
#[derive(thiserror::Error, Clone, Debug, PartialEq, Eq)]
#[error("{0:?} is not a range of routes; write first-last, for example 5-9")]
pub struct NotASlice(String);

impl FromStr for RouteSlice {
    type Err = NotASlice;

    fn from_str(text: &str) -> Result<Self, NotASlice> {
        let slice = text.split_once('-').and_then(|(first, last)| {
            Some(Self {
                first: first.parse().ok()?,
                last: last.parse().ok()?,
            })
        });
        slice
            .filter(|slice| slice.first <= slice.last)
            .ok_or_else(|| NotASlice(text.into()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slice_must_be_two_numbers_in_order() {
        assert_eq!("5-9".parse(), Ok(RouteSlice { first: 5, last: 9 }));
        for bad in ["", "5", "9-5", "a-b", "-1-2"] {
            assert!(bad.parse::<RouteSlice>().is_err(), "{bad}");
        }
    }
}
