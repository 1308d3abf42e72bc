//! Parts that the tests of this crate share, and the size of cached objects.

mod cache;
pub(crate) mod fixtures;
