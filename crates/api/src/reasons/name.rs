//! A reason as a status has it.

use std::borrow::Cow;
use std::fmt;

use schemars::JsonSchema;
use serde::de::{Deserialize, Deserializer};
use serde::{Serialize, Serializer};

use super::Reason;
use crate::SharedText;

/// One of the table, or the name of another version's, which is kept as it is and equals none.
#[derive(JsonSchema, Clone, PartialEq, Eq)]
#[schemars(with = "String", inline, extend("maxLength" = 64))]
pub enum ReasonName {
    Known(Reason),
    Other(SharedText),
}

impl ReasonName {
    /// The reason of the table.
    pub fn known(&self) -> Option<Reason> {
        match self {
            Self::Known(reason) => Some(*reason),
            Self::Other(_) => None,
        }
    }

    /// As it is written.
    pub fn as_str(&self) -> &str {
        match self {
            Self::Known(reason) => reason.as_str(),
            Self::Other(name) => name,
        }
    }

    /// For labels of metrics and spans, which are a closed set: the name, or `Other`.
    pub fn label(&self) -> &'static str {
        self.known().map_or("Other", Reason::as_str)
    }

    /// True if it is one of these. A name that the table does not know is none of them.
    pub fn is_one_of(&self, reasons: &[Reason]) -> bool {
        self.known().is_some_and(|known| reasons.contains(&known))
    }
}

impl Default for ReasonName {
    fn default() -> Self {
        Self::Other(SharedText::default())
    }
}

impl From<Reason> for ReasonName {
    fn from(reason: Reason) -> Self {
        Self::Known(reason)
    }
}

impl From<&str> for ReasonName {
    fn from(name: &str) -> Self {
        Reason::of(name).map_or_else(|| Self::Other(name.into()), Self::Known)
    }
}

impl PartialEq<Reason> for ReasonName {
    fn eq(&self, other: &Reason) -> bool {
        self.known() == Some(*other)
    }
}

impl fmt::Debug for ReasonName {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(self.as_str(), out)
    }
}

impl fmt::Display for ReasonName {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(self.as_str())
    }
}

impl Serialize for ReasonName {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.as_str())
    }
}

impl<'de> Deserialize<'de> for ReasonName {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let name = Cow::<'de, str>::deserialize(deserializer)?;
        Ok(Self::from(&*name))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reason_of_another_version_is_kept_and_equals_none() {
        for (text, known) in [
            ("NodeLost", Some(Reason::NodeLost)),
            ("FromTheFuture", None),
            ("", None),
        ] {
            let read: ReasonName = serde_json::from_value(text.into()).unwrap();
            assert_eq!(read.known(), known, "{text}");
            assert_eq!(serde_json::to_value(&read).unwrap(), text);
            assert!(
                Reason::ALL
                    .into_iter()
                    .all(|reason| (read == reason) == (known == Some(reason)))
            );
        }
    }
}
