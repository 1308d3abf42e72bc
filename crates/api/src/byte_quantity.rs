//! A number of bytes, written as Kubernetes writes one: `20Gi`, `500M`.
//!
//! Pure. The one place that reads such a text.

use std::borrow::Cow;
use std::str::FromStr;

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Serialize};

const PATTERN: &str = "^[0-9]{1,15}(k|M|G|T|Ki|Mi|Gi|Ti)?$";
/// Suffixes and what they stand for. An empty one comes last: every text ends with it.
const UNITS: [(&str, u64); 9] = [
    ("Ki", 1 << 10),
    ("Mi", 1 << 20),
    ("Gi", 1 << 30),
    ("Ti", 1 << 40),
    ("k", 1_000),
    ("M", 1_000_000),
    ("G", 1_000_000_000),
    ("T", 1_000_000_000_000),
    ("", 1),
];

/// A whole number of bytes with a suffix. It keeps the text it was read from.
#[derive(Serialize, Deserialize, Clone, Debug, PartialEq, Eq)]
#[serde(try_from = "String", into = "String")]
pub struct ByteQuantity {
    text: String,
    bytes: u64,
}

/// A text that is no [`ByteQuantity`].
#[derive(thiserror::Error, Debug, PartialEq, Eq)]
#[error(
    "{0:?} is not a number of bytes; write a whole number with a suffix of Ki, Mi, Gi, Ti, k, M, G or T, for example 20Gi"
)]
pub struct NotBytes(String);

impl ByteQuantity {
    /// As a number of bytes.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// So many GiB.
    pub fn gibibytes(number: u8) -> Self {
        Self {
            text: format!("{number}Gi"),
            bytes: u64::from(number) << 30,
        }
    }
}

impl FromStr for ByteQuantity {
    type Err = NotBytes;

    fn from_str(text: &str) -> Result<Self, NotBytes> {
        let (number, unit) = UNITS
            .iter()
            .find_map(|(suffix, unit)| Some((text.strip_suffix(suffix)?, *unit)))
            .ok_or_else(|| NotBytes(text.into()))?;
        let number = Some(number).filter(|digits| digits.bytes().all(|byte| byte.is_ascii_digit()));
        let number: Option<u64> = number.and_then(|digits| digits.parse().ok());
        let bytes = number.and_then(|number| number.checked_mul(unit));
        Ok(Self {
            bytes: bytes.ok_or_else(|| NotBytes(text.into()))?,
            text: text.into(),
        })
    }
}

impl TryFrom<String> for ByteQuantity {
    type Error = NotBytes;

    fn try_from(text: String) -> Result<Self, NotBytes> {
        text.parse()
    }
}

impl From<ByteQuantity> for String {
    fn from(quantity: ByteQuantity) -> Self {
        quantity.text
    }
}

impl JsonSchema for ByteQuantity {
    fn schema_name() -> Cow<'static, str> {
        "ByteQuantity".into()
    }

    fn inline_schema() -> bool {
        true
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({ "type": "string", "maxLength": 17, "pattern": PATTERN })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_read_as_kubernetes_reads_them() {
        for (text, bytes) in [
            ("0", 0),
            ("1048576", 1 << 20),
            ("20Gi", 20 << 30),
            ("500M", 500_000_000),
            ("3k", 3000),
            ("1Ti", 1 << 40),
        ] {
            assert_eq!(text.parse().map(|size: ByteQuantity| size.bytes()), Ok(bytes), "{text}");
        }
        for bad in [
            "",
            "Gi",
            "1.5Gi",
            "-1",
            "+1",
            "1 Gi",
            "1gi",
            "1Ei",
            "99999999999999999999",
            "999999999999999Ti",
        ] {
            assert_eq!(bad.parse::<ByteQuantity>(), Err(NotBytes(bad.into())), "{bad}");
        }
    }

    #[test]
    fn a_size_is_written_as_it_was_read() {
        for text in ["1024Mi", "1Gi"] {
            let size: ByteQuantity = serde_json::from_value(text.into()).unwrap();
            assert_eq!(serde_json::to_value(&size).unwrap(), text);
        }
        assert_eq!(ByteQuantity::gibibytes(2), "2Gi".parse().unwrap());
    }
}
