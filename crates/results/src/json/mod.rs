//! JSON as Python's `json` module reads and writes it. Owns the value tree; called by the checkpoint reader and the
//! renderers. Knows nothing of checkpoints.
//!
//! `serde_json` can't stand in: the files may hold NaN, Infinity, `1e999`, whole numbers of any size, lone surrogates and
//! repeated keys, and all of these have to come out again as Python would write them.

mod limits;
mod read;
mod write;

pub use limits::{FileLimits, Limit};
pub(crate) use read::{ReadError, read};
pub(crate) use write::{KeyOrder, Node, write};

/// A text of Unicode code points in which, as in Python, half of a surrogate pair may stand alone. Encoded as UTF-8 with
/// such halves as three bytes; byte order is code point order.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Text(Box<[u8]>);

impl Text {
    /// The text, unless half of a surrogate pair stands alone in it.
    pub(crate) fn as_str(&self) -> Option<&str> {
        std::str::from_utf8(&self.0).ok()
    }

    pub(crate) fn as_bytes(&self) -> &[u8] {
        &self.0
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
    /// What Python's `not value` is.
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
