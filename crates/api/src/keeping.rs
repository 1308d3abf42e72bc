//! How AWS keeps what is stored: the storage class of objects, and what a log group that the operator makes is like.
//!
//! Owned by `api`; parts of `storage` and `logs.cloudWatch`.

use serde::{Deserialize, Serialize};

/// Storage classes of S3 whose objects can be read at once, by S3's names: reports and checkpoints are read again.
#[derive(Serialize, Deserialize, Clone, Copy, Debug, PartialEq, Eq)]
#[serde(rename_all = "SCREAMING_SNAKE_CASE")]
pub enum StorageClass {
    Standard,
    IntelligentTiering,
    StandardIa,
    OnezoneIa,
    GlacierIr,
}

impl StorageClass {
    /// S3's name.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Standard => "STANDARD",
            Self::IntelligentTiering => "INTELLIGENT_TIERING",
            Self::StandardIa => "STANDARD_IA",
            Self::OnezoneIa => "ONEZONE_IA",
            Self::GlacierIr => "GLACIER_IR",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_api_has_the_names_of_s3() {
        let all = [
            StorageClass::Standard,
            StorageClass::IntelligentTiering,
            StorageClass::StandardIa,
            StorageClass::OnezoneIa,
            StorageClass::GlacierIr,
        ];
        for class in all {
            assert_eq!(serde_json::to_value(class).unwrap(), class.as_str());
        }
    }
}
