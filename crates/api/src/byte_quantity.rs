//! A number of bytes, written as Kubernetes writes a quantity: `20Gi`, `1.5Gi`, `500M`, `1e9`, or a bare integer.
//!
//! Pure. The one place that reads such a text.

use std::borrow::Cow;
use std::str::FromStr;

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Serialize};

/// Suffixes of Kubernetes, with the factor and the divisor that each stands for.
const UNITS: [(&str, u128, u128); 16] = [
    ("", 1, 1),
    ("Ki", 1 << 10, 1),
    ("Mi", 1 << 20, 1),
    ("Gi", 1 << 30, 1),
    ("Ti", 1 << 40, 1),
    ("Pi", 1 << 50, 1),
    ("Ei", 1 << 60, 1),
    ("n", 1, 1_000_000_000),
    ("u", 1, 1_000_000),
    ("m", 1, 1_000),
    ("k", 1_000, 1),
    ("M", 1_000_000, 1),
    ("G", 1_000_000_000, 1),
    ("T", 1_000_000_000_000, 1),
    ("P", 1_000_000_000_000_000, 1),
    ("E", 1_000_000_000_000_000_000, 1),
];

/// A number of bytes as it was written; a part of a byte counts as a whole one.
#[derive(Serialize, Deserialize, Clone, Debug, PartialEq, Eq)]
#[serde(try_from = "Written", into = "String")]
pub struct ByteQuantity {
    text: String,
    bytes: u64,
}

/// An integer or a text, as in every quantity of Kubernetes.
#[derive(Deserialize)]
#[serde(untagged)]
enum Written {
    Number(u64),
    Text(String),
}

/// A text that is no [`ByteQuantity`].
#[derive(thiserror::Error, Debug, PartialEq, Eq)]
#[error("{0:?} is not a number of bytes; write a quantity of Kubernetes, for example 20Gi")]
pub struct NotBytes(String);

impl ByteQuantity {
    /// As a number of bytes.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// So many MiB.
    pub fn mebibytes(number: u8) -> Self {
        Self {
            text: format!("{number}Mi"),
            bytes: u64::from(number) << 20,
        }
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
        let bytes = bytes(text).ok_or_else(|| NotBytes(text.into()))?;
        Ok(Self {
            text: text.into(),
            bytes,
        })
    }
}

fn bytes(text: &str) -> Option<u64> {
    let text = text.strip_prefix('+').unwrap_or(text);
    let end = text.find(|letter: char| !letter.is_ascii_digit() && letter != '.');
    let (number, suffix) = text.split_at(end.unwrap_or(text.len()));
    let (whole, part) = number.split_once('.').unwrap_or((number, ""));
    let digits: u128 = format!("{whole}{part}").parse().ok()?;
    let (factor, divisor) = unit(suffix)?;
    let divisor = divisor.checked_mul(power_of_ten(part.len())?)?;
    u64::try_from(digits.checked_mul(factor)?.div_ceil(divisor)).ok()
}

/// Factor and divisor of a suffix, or of an exponent such as `e9`.
fn unit(suffix: &str) -> Option<(u128, u128)> {
    if let Some((_, factor, divisor)) = UNITS.iter().find(|(known, ..)| *known == suffix) {
        return Some((*factor, *divisor));
    }
    let exponent: i8 = suffix.strip_prefix(['e', 'E'])?.parse().ok()?;
    let power = power_of_ten(exponent.unsigned_abs().into())?;
    Some(if exponent < 0 { (1, power) } else { (power, 1) })
}

fn power_of_ten(exponent: usize) -> Option<u128> {
    10_u128.checked_pow(exponent.try_into().ok()?)
}

impl TryFrom<Written> for ByteQuantity {
    type Error = NotBytes;

    fn try_from(written: Written) -> Result<Self, NotBytes> {
        match written {
            Written::Number(bytes) => bytes.to_string().parse(),
            Written::Text(text) => text.parse(),
        }
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
        json_schema!({ "x-kubernetes-int-or-string": true })
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
            ("1.5Gi", 3 << 29),
            (".5Ki", 512),
            ("2.Mi", 2 << 20),
            ("+1e3", 1000),
            ("25E-1", 3),
            ("1500m", 2),
            ("1E", 1_000_000_000_000_000_000),
        ] {
            assert_eq!(text.parse().map(|size: ByteQuantity| size.bytes()), Ok(bytes), "{text}");
        }
        for bad in [
            "",
            "Gi",
            ".",
            "1.5.5Gi",
            "-1",
            "1 Gi",
            "1gi",
            "1e",
            "1e99",
            "20Ei",
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
        let size: ByteQuantity = serde_json::from_value(1024.into()).unwrap();
        assert_eq!(
            (size.bytes(), serde_json::to_value(&size).unwrap()),
            (1024, "1024".into())
        );
        assert_eq!(ByteQuantity::gibibytes(2), "2Gi".parse().unwrap());
    }
}
