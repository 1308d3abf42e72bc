//! JSON as Python's `json` module reads and writes it. Owns the value tree; called by the checkpoint reader and the
//! renderers. Knows nothing of checkpoints.
//!
//! `serde_json` can't stand in: the files may hold NaN, Infinity, `1e999`, whole numbers of any size, lone surrogates and
//! repeated keys, and all of these have to come out again as Python would write them.

mod limits;
mod read;
mod write;

use std::cmp::Ordering;
use std::fmt;
use std::ops::Range;
use std::sync::Arc;

pub use limits::{FileLimits, Limit};
pub(crate) use read::{ReadError, read};
pub(crate) use write::{KeyOrder, Node, write};

/// A text of Unicode code points in which, as in Python, half of a surrogate pair may stand alone. Encoded as UTF-8 with
/// such halves as three bytes; byte order is code point order.
///
/// A part of the file it was read from, which all texts share: a record has some thirty, and an allocation for each would be
/// most of what a merge does. A text with escapes has bytes of its own.
#[derive(Clone)]
pub(crate) struct Text {
    shared: Arc<[u8]>,
    place: Range<u32>,
}

impl Text {
    /// Part of `shared` at `place`.
    fn part(shared: &Arc<[u8]>, place: Range<usize>) -> Option<Self> {
        let place = u32::try_from(place.start).ok()?..u32::try_from(place.end).ok()?;
        let shared = Arc::clone(shared);
        Some(Self { shared, place })
    }

    /// The text, unless half of a surrogate pair stands alone in it.
    pub(crate) fn as_str(&self) -> Option<&str> {
        std::str::from_utf8(self.as_bytes()).ok()
    }

    pub(crate) fn as_bytes(&self) -> &[u8] {
        let [start, end] = [self.place.start, self.place.end].map(|at| usize::try_from(at).unwrap_or(usize::MAX));
        self.shared.get(start..end).unwrap_or_default()
    }
}

impl PartialEq for Text {
    fn eq(&self, other: &Self) -> bool {
        self.as_bytes() == other.as_bytes()
    }
}

impl Eq for Text {}

impl PartialOrd for Text {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Text {
    fn cmp(&self, other: &Self) -> Ordering {
        self.as_bytes().cmp(other.as_bytes())
    }
}

impl fmt::Debug for Text {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?}", String::from_utf8_lossy(self.as_bytes()))
    }
}

/// Keys and values in file order; a repeated key has its first place and its last value.
#[derive(Clone, Debug, PartialEq, Default)]
pub(crate) struct Object(Vec<(Text, Value)>);

impl Object {
    pub(crate) fn get(&self, key: &str) -> Option<&Value> {
        self.0
            .iter()
            .find(|(k, _)| k.as_bytes() == key.as_bytes())
            .map(|(_, value)| value)
    }

    /// Takes a value out; the key stays, with null.
    pub(crate) fn take(&mut self, key: &str) -> Option<Value> {
        let entry = self.0.iter_mut().find(|(k, _)| k.as_bytes() == key.as_bytes())?;
        Some(std::mem::replace(&mut entry.1, Value::Null))
    }

    pub(crate) fn iter(&self) -> impl Iterator<Item = (&Text, &Value)> + Clone {
        self.0.iter().map(|(key, value)| (key, value))
    }

    pub(crate) fn len(&self) -> usize {
        self.0.len()
    }
}

/// Any JSON value.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Value {
    Null,
    Bool(bool),
    Int(i128),
    /// A whole number beyond `i128`, as its digits.
    BigInt(Box<str>),
    Float(f64),
    Text(Text),
    List(Vec<Value>),
    Object(Object),
}

impl Value {
    /// Value of Python's `not value`.
    pub(crate) fn is_falsy(&self) -> bool {
        match self {
            Self::Null => true,
            Self::Bool(b) => !b,
            Self::Int(i) => *i == 0,
            Self::BigInt(_) => false,
            Self::Float(f) => *f == 0.0,
            Self::Text(text) => text.as_bytes().is_empty(),
            Self::List(list) => list.is_empty(),
            Self::Object(object) => object.len() == 0,
        }
    }

    pub(crate) fn as_object(&self) -> Option<&Object> {
        if let Self::Object(object) = self {
            Some(object)
        } else {
            None
        }
    }

    pub(crate) fn as_list(&self) -> Option<&[Self]> {
        if let Self::List(list) = self { Some(list) } else { None }
    }

    /// The text, unless it is none or half of a surrogate pair stands alone in it.
    pub(crate) fn as_str(&self) -> Option<&str> {
        if let Self::Text(text) = self {
            text.as_str()
        } else {
            None
        }
    }
}
