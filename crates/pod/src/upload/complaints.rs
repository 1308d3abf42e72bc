//! Complaints: files that were left out, each written once to logcopy's log, with the limit's name and the next step.

use std::collections::BTreeSet;
use std::time::Duration;

use super::quota::Limit;

/// Most complaints of one life: an agent can have any number of files that can't be read.
const MOST: usize = 1000;

/// Why a file, or a part of it, is not stored.
#[derive(thiserror::Error, Clone, Debug, PartialEq, Eq)]
pub enum Why {
    /// There is no room for it.
    #[error("{0}. Further files are left out without a word")]
    Limit(Limit),
    /// A known log is stored up to this byte only.
    #[error(
        "beyond {0} bytes: storage.s3.sizeLimit is reached, and that is what the log keeps of it. Raise it, or have less \
         printed"
    )]
    Shortened(u64),
    /// The allowance of the day is used up.
    #[error(
        "it waits for the end of the run or of the day (UTC): the daily limit of requests or bytes to S3 is used up. Have \
         files rewritten less often"
    )]
    Day,
    /// It took too long and was cut.
    #[error(
        "it was not sent within {} s, so that it does not keep the report back. It is tried again later, and at the end; \
         have files of this size written in pieces",
        .0.as_secs()
    )]
    Slow(Duration),
    /// The time at the end is over.
    #[error("{0} files at the end: half of deadlines.flushSeconds is over. Raise it, or have less written at the end")]
    Ended(usize),
    /// Status files beyond this number of rounds.
    #[error("a container's status files are stored for its first {0} rounds. The results need none of them")]
    Statuses(u32),
    /// Entries of folders that are not looked at.
    #[error("{0} entries are beyond what is looked at, or no files. Have fewer files written, and no links or pipes")]
    Entries(usize),
    /// Another file has its key.
    #[error("another file has the same key")]
    SameKey,
    /// It can't be read.
    #[error("{0}")]
    File(String),
}

impl Why {
    /// Topic that is shown once: each limit, and each file that has a reason of its own.
    fn topic(&self, key: &str) -> String {
        match self {
            Self::Shortened(_) | Self::Slow(_) | Self::SameKey | Self::File(_) => format!("of {key}"),
            // Their numbers differ from round to round.
            Self::Ended(_) => "end".to_owned(),
            Self::Entries(_) => "entries".to_owned(),
            Self::Limit(_) | Self::Day | Self::Statuses(_) => self.to_string(),
        }
    }
}

/// Topics that were shown already.
#[derive(Debug, Default)]
pub struct Complaints(BTreeSet<String>);

impl Complaints {
    /// Logs it, unless it was logged.
    pub fn say(&mut self, key: &str, why: &Why) {
        if self.is_new(key, why) {
            tracing::warn!(file = %key, "not stored: {why}");
        }
    }

    fn is_new(&mut self, key: &str, why: &Why) -> bool {
        self.0.len() < MOST && self.0.insert(why.topic(key))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_limit_is_named_once_and_a_file_of_its_own_reason_once() {
        let mut complaints = Complaints::default();
        let limit = Why::Limit(Limit::AgentBytes(9));
        assert!(complaints.is_new("a", &limit) && !complaints.is_new("b", &limit));
        assert!(
            limit.to_string().contains("storage.s3.sizeLimit, 9 bytes. Raise it"),
            "{limit}"
        );
        assert!(complaints.is_new("a", &Why::Limit(Limit::Bytes(9))));
        let file = Why::File("it is gone".to_owned());
        assert!(complaints.is_new("a", &file) && !complaints.is_new("a", &file));
        for number in 0..2 * MOST {
            complaints.is_new(&number.to_string(), &file);
        }
        assert_eq!(complaints.0.len(), MOST);
    }
}
