//! What the tests of this module share, and what the caches hold.

mod cache;
pub(crate) mod fixtures;
