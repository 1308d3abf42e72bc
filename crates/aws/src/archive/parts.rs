//! How an object is cut into the parts of a multipart upload. Pure; called by the archive alone.
//!
//! S3 refuses parts under 5 MiB unless they are the last, but only when the upload is completed, and stand-ins do not
//! refuse them at all. So the rule is enforced here.

use std::ops::Range;

/// Smallest part that may be followed by another.
pub const MIN_PART: u64 = 5 << 20;
/// Most parts of one upload.
const MAX_PARTS: u64 = 10_000;
/// Bytes of an ordinary part, which is also what is held in memory of one file.
pub const PART: u64 = 8 << 20;
/// Most bytes of a part: several are in memory at once, and a stranger's sparse file can have any size. An object has 156 GiB at
/// most.
const MAX_PART: u64 = 16 << 20;
/// Bytes copied by one request. S3 takes 5 GiB, but answers only when it is done.
const COPY: u64 = 1 << 30;

/// One part.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Part {
    /// The stored object has its bytes already; else they are the file's.
    pub is_stored: bool,
    pub bytes: Range<u64>,
}

/// Parts that S3 would refuse.
#[derive(thiserror::Error, Clone, Copy, Debug, PartialEq, Eq)]
pub enum PartsError {
    /// The stored beginning is too small to be one.
    #[error("a part would have {0} bytes, and S3 takes parts under {MIN_PART} bytes only as the last")]
    TooSmall(u64),
    /// Its parts would be larger than what may be in memory.
    #[error("it has {0} bytes, and its parts would have more than {MAX_PART}")]
    TooLarge(u64),
    /// More is kept than the file has.
    #[error("the file is shorter than what is stored of it")]
    Shrunk,
}

/// The parts of an object of `size` bytes whose first `kept` bytes are stored already.
pub fn plan(kept: u64, size: u64) -> Result<Vec<Part>, PartsError> {
    let new = size.checked_sub(kept).ok_or(PartsError::Shrunk)?;
    if new > 0 && (1..MIN_PART).contains(&kept) {
        return Err(PartsError::TooSmall(kept));
    }
    let pieces = kept.div_ceil(COPY);
    let room = MAX_PARTS.saturating_sub(pieces).max(1);
    let step = step(new, room).ok_or(PartsError::TooLarge(size))?;
    let copied = cut(0..kept, kept.div_ceil(pieces.max(1)), true);
    Ok(copied.chain(cut(kept..size, step, false)).collect())
}

/// Bytes in parts of `step`, of which the last has what is left.
fn cut(bytes: Range<u64>, step: u64, is_stored: bool) -> impl Iterator<Item = Part> {
    let count = (bytes.end - bytes.start).div_ceil(step.max(1));
    (0..count).map(move |index| {
        let from = bytes.start + index * step;
        let bytes = from..bytes.end.min(from + step);
        Part { is_stored, bytes }
    })
}

/// Bytes of each part but the last of an object that has `most` bytes at most, and whose size is not known yet.
pub fn step_within(most: u64) -> Result<u64, PartsError> {
    step(most, MAX_PARTS).ok_or(PartsError::TooLarge(most))
}

/// Bytes of a part with which so many bytes need `room` parts at most; None: more than a part may have.
fn step(bytes: u64, room: u64) -> Option<u64> {
    let step = PART.max(bytes.div_ceil(room).next_multiple_of(1 << 20));
    (step <= MAX_PART).then_some(step)
}

#[cfg(test)]
mod tests {
    use super::*;

    const MIB: u64 = 1 << 20;

    fn len(part: &Part) -> u64 {
        part.bytes.end - part.bytes.start
    }

    #[test]
    fn a_part_under_the_minimum_is_refused_unless_it_is_the_last() {
        let small = PartsError::TooSmall(MIN_PART - 1);
        assert_eq!(plan(MIN_PART - 1, 20 * MIB), Err(small));
        assert!(plan(MIN_PART - 1, MIN_PART - 1).is_ok());
        assert!(plan(MIN_PART, MIN_PART + 1).is_ok());
        assert!(plan(0, 1).is_ok());
    }

    #[test]
    fn the_parts_cover_the_object_once_and_in_order() {
        let sizes = [
            (0, 1),
            (0, PART),
            (0, PART + 1),
            (MIN_PART, MIN_PART + 3),
            (50 * MIB, 67 * MIB + 5),
            (COPY + 1, COPY + 2),
            (3 * COPY + 17, 3 * COPY + 17 + PART * 2),
            (0, 150_000 * MIB),
        ];
        for (kept, size) in sizes {
            let parts = plan(kept, size).unwrap();
            let mut at = 0;
            for part in &parts {
                assert_eq!((part.bytes.start, part.is_stored), (at, at < kept), "{kept} of {size}");
                at = part.bytes.end;
            }
            assert_eq!(at, size);
            let followed = parts.iter().rev().skip(1);
            assert!(followed.map(len).all(|len| len >= MIN_PART), "{kept} of {size}");
            assert!(parts.len() as u64 <= MAX_PARTS);
        }
    }

    #[test]
    fn no_part_is_larger_than_what_may_be_in_memory() {
        let most = MAX_PART * MAX_PARTS;
        assert!(plan(0, most).is_ok_and(|parts| parts.iter().all(|part| len(part) <= MAX_PART)));
        for size in [most + 1, 4 << 40, u64::MAX / 2] {
            assert_eq!(plan(0, size), Err(PartsError::TooLarge(size)));
        }
    }

    #[test]
    fn a_stream_has_parts_of_8_mib_unless_that_would_be_too_many() {
        for (most, expected) in [(1, PART), (1 << 30, PART), (100 << 30, 11 * MIB), (150 << 30, MAX_PART)] {
            let step = step_within(most).unwrap();
            assert_eq!(step, expected, "{most}");
            assert!(most.div_ceil(step) <= MAX_PARTS, "{most}");
        }
        let more = MAX_PART * MAX_PARTS + 1;
        assert_eq!(step_within(more), Err(PartsError::TooLarge(more)));
    }

    #[test]
    fn a_shrunk_file_is_not_appended_to() {
        assert_eq!(plan(10, 9), Err(PartsError::Shrunk));
    }
}
