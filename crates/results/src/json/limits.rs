//! Bounds of a file of a stranger, for any bytes.

/// A bound a hostile file ran into.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Limit {
    /// Size of the whole file: more bytes than these.
    #[error("is larger than {}", size_text(*.0))]
    Size(usize),
    /// Lists and objects inside each other.
    #[error("is nested deeper than 64 levels")]
    Depth,
    /// Values of any kind: more than so many.
    #[error("holds more than {} values", grouped(*.0))]
    Values(usize),
    /// Length of one text.
    #[error("holds a text longer than 1 MiB")]
    Text,
    /// Length of one number.
    #[error("holds a number of more than 4,096 characters")]
    Number,
    /// Route records.
    #[error("holds more than 10,000 records")]
    Records,
    /// Sensors.
    #[error("holds more than 1,000 sensors")]
    Sensors,
    /// Size of what is written from it.
    #[error("would make the merged file larger than 64 MiB")]
    Output,
}

/// How large one file may be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FileLimits {
    /// Bytes.
    pub bytes: usize,
    /// Values of any kind.
    pub values: usize,
}

impl FileLimits {
    /// Bounds of any file.
    pub(crate) const LARGEST: Self = Self {
        bytes: 64 << 20,
        values: 500_000,
    };
}

/// In MiB where that is a whole number, else in KiB.
fn size_text(bytes: usize) -> String {
    if bytes.is_multiple_of(1 << 20) {
        format!("{} MiB", bytes >> 20)
    } else {
        format!("{} KiB", bytes >> 10)
    }
}

/// With a comma between the thousands.
fn grouped(number: usize) -> String {
    let digits = number.to_string();
    let groups: Vec<&str> = digits
        .as_bytes()
        .rchunks(3)
        .rev()
        .filter_map(|group| std::str::from_utf8(group).ok())
        .collect();
    groups.join(",")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limits_are_shown_in_units_and_groups() {
        assert_eq!(Limit::Size(64 << 20).to_string(), "is larger than 64 MiB");
        assert_eq!(Limit::Size(2600 << 10).to_string(), "is larger than 2600 KiB");
        assert_eq!(Limit::Values(500_000).to_string(), "holds more than 500,000 values");
        assert_eq!(Limit::Values(41_250).to_string(), "holds more than 41,250 values");
    }
}
