//! Lists of S3.

use aws_sdk_s3::primitives::DateTime;
use jiff::Timestamp;

/// An object as the list shows it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Listed {
    /// Its key below the prefix.
    pub key: String,
    /// Its bytes.
    pub size: u64,
    /// Its entity tag.
    pub etag: Option<String>,
    /// When it was stored.
    pub stored: Option<Timestamp>,
}

/// Objects below a prefix.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Listing {
    /// In the order of their keys.
    pub objects: Vec<Listed>,
    /// False if there are more than were asked for.
    pub complete: bool,
}

/// One of the SDK's times; none if it is outside of all calendars.
pub(super) fn moment(time: &DateTime) -> Option<Timestamp> {
    let nanoseconds = i32::try_from(time.subsec_nanos()).ok()?;
    Timestamp::new(time.secs(), nanoseconds).ok()
}
