//! Plan of a run: format, slices, strictness. Owns the types the callers fill in and the check that they make
//! sense together; knows nothing of checkpoints.

use crate::Refusal;
use crate::json::{FileLimits, KeyOrder};

/// Bounds of the checkpoints of all pairs together in a Pod. Real ones hold a few kilobytes a route run.
const SHARED: FileLimits = FileLimits {
    bytes: 32 << 20,
    values: 500_000,
};
/// Bounds of each pair besides its share.
const LEAST: FileLimits = FileLimits {
    bytes: 1 << 20,
    values: 10_000,
};

/// The checkpoint format: Leaderboard 1.0, or 2.0 and everything after it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Format {
    /// Leaderboard 1.0.
    V1,
    /// Leaderboard 2.0, 2.1 and later.
    V2,
}

impl Format {
    /// The order in which its scripts write the keys of an object.
    pub(crate) fn key_order(self) -> KeyOrder {
        match self {
            Self::V1 => KeyOrder::Sorted,
            Self::V2 => KeyOrder::AsGiven,
        }
    }
}

/// How much of a strange checkpoint is put up with.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Strictness {
    /// A person's own files: free status texts, unknown infraction sources, NaN.
    Offline,
    /// A stranger's files whose content is published: known statuses and sensors only, plausible numbers, ids inside the
    /// pair's slice.
    Pod,
}

/// Treatment of scores that do not follow from a record's infractions.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Verify {
    /// Nothing is recomputed.
    Disabled,
    /// The mismatch is listed in [`Merged::warnings`](crate::Merged::warnings).
    Warn,
    /// The file is refused.
    Refuse,
}

/// The routes of one pair, as inclusive positions: `{first: 5, last: 9}` are five routes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Slice {
    /// First route id.
    pub first: u32,
    /// Last route id, itself included.
    pub last: u32,
}

impl Slice {
    /// How many routes the slice holds; 0 for one written backwards.
    pub fn routes(self) -> u32 {
        self.last
            .checked_sub(self.first)
            .map_or(0, |more| more.saturating_add(1))
    }

    pub(crate) fn contains(self, id: i64) -> bool {
        (i64::from(self.first)..=i64::from(self.last)).contains(&id)
    }
}

/// Plan of a run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Plan {
    /// The checkpoint format of the workers.
    pub format: Format,
    /// How much of a strange checkpoint is put up with.
    pub strictness: Strictness,
    /// The slice of each pair, in the order of the workers. Empty: unknown, so completeness is judged from the files alone,
    /// as the original does.
    pub pairs: Vec<Slice>,
    /// Routes of the whole run; the sum over `pairs` when these are known.
    pub routes: u32,
    /// How often each route is driven.
    pub repetitions: u32,
    /// Treatment of scores that do not follow from a record's infractions.
    pub verify: Verify,
    /// Switches the deliberate differences from the original off.
    pub as_original: bool,
}

impl Plan {
    /// A plan that knows nothing but the format: for files whose run is not known.
    pub fn lenient(format: Format) -> Self {
        Self {
            format,
            strictness: Strictness::Offline,
            pairs: Vec::new(),
            routes: 0,
            repetitions: 1,
            verify: Verify::Disabled,
            as_original: false,
        }
    }

    /// True if the plan has the pairs and routes, and decides where the files differ.
    pub(crate) fn decides(&self) -> bool {
        !self.pairs.is_empty() && !self.as_original
    }

    pub(crate) fn is_pod(&self) -> bool {
        self.strictness == Strictness::Pod
    }

    /// How many records the pair's file ends with; `None` when the plan does not know.
    pub(crate) fn expected_of(&self, pair: usize) -> Option<u32> {
        self.pairs
            .get(pair)
            .map(|slice| slice.routes().saturating_mul(self.repetitions))
    }

    /// How large the pair's checkpoint may be. In a Pod the pairs share one bound in proportion to their route runs, so that
    /// the memory that reading and merging takes does not grow with the number of pairs.
    pub fn limits_of(&self, pair: usize) -> FileLimits {
        let (Some(slice), true) = (self.pairs.get(pair), self.is_pod()) else {
            return FileLimits::LARGEST;
        };
        let routes = self.pairs.iter().map(|slice| u64::from(slice.routes()));
        let all = routes.fold(0, u64::saturating_add);
        let share = |least: usize, shared: usize| {
            let part = (shared as u64)
                .saturating_mul(u64::from(slice.routes()))
                .checked_div(all);
            least.saturating_add(part.and_then(|part| usize::try_from(part).ok()).unwrap_or(0))
        };
        FileLimits {
            bytes: share(LEAST.bytes, SHARED.bytes),
            values: share(LEAST.values, SHARED.values),
        }
    }

    /// How many records the whole run ends with; `None` when the plan does not know.
    pub(crate) fn expected(&self) -> Option<u32> {
        self.decides().then(|| self.routes.saturating_mul(self.repetitions))
    }

    /// Refuses a plan whose parts contradict each other.
    pub fn check(&self) -> Result<(), Refusal> {
        let refuse = |problem: String| Err(Refusal::Plan { problem });
        if self.pairs.is_empty() {
            return Ok(());
        }
        if self.repetitions == 0 {
            return refuse("it has no repetition".to_owned());
        }
        if let Some(slice) = self.pairs.iter().find(|slice| slice.last < slice.first) {
            return refuse(format!("the slice {}-{} is written backwards", slice.first, slice.last));
        }
        let covered: u64 = self.pairs.iter().map(|slice| u64::from(slice.routes())).sum();
        if covered != u64::from(self.routes) {
            return refuse(format!("its slices hold {covered} routes, but it says {}", self.routes));
        }
        let mut slices = self.pairs.clone();
        slices.sort_by_key(|slice| slice.first);
        if let Some([a, b]) = slices.array_windows::<2>().find(|[a, b]| b.first <= a.last) {
            return refuse(format!(
                "the slices {}-{} and {}-{} overlap",
                a.first, a.last, b.first, b.last
            ));
        }
        if self.routes.checked_mul(self.repetitions).is_none() {
            return refuse("it has more records than can be counted".to_owned());
        }
        Ok(())
    }
}
