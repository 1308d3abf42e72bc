//! Complaints: files that were left out, each written once to logcopy's log, with the limit's name and the next step.

use std::collections::BTreeSet;
use std::fmt;
use std::time::Duration;

use super::quota::Limit;

/// Most complaints of one life: an agent can have any number of files that can't be read.
const MOST: usize = 1000;

/// Why a file, or a part of it, is not stored.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Why {
    /// There is no room for it.
    Limit(Limit),
    /// A known log is stored up to this byte only.
    Shortened(u64),
    /// The allowance of the day is used up.
    Day,
    /// It took too long and was cut.
    Slow(Duration),
    /// The time at the end is over.
    Ended(usize),
    /// Status files beyond this number of rounds.
    Statuses(u32),
    /// Entries of folders that are not looked at.
    Entries(usize),
    /// Another file has its key.
    SameKey,
    /// It can't be read.
    File(String),
}

impl fmt::Display for Why {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Limit(limit) => write!(f, "{limit}. Further files are left out without a word"),
            Self::Shortened(size) => write!(
                f,
                "beyond {size} bytes: storage.s3.sizeLimit is reached, and that is what the log keeps of it. Raise it, or have \
                 less printed"
            ),
            Self::Day => f.write_str(
                "it waits for the end of the run or of the day (UTC): the daily limit of requests or bytes to S3 is used \
                 up. Have files rewritten less often",
            ),
            Self::Slow(limit) => write!(
                f,
                "it was not sent within {} s, so that it does not keep the report back. It is tried again later, and at \
                 the end; have files of this size written in pieces",
                limit.as_secs()
            ),
            Self::Ended(files) => write!(
                f,
                "{files} files at the end: half of deadlines.flushSeconds is over. Raise it, or have less written at the \
                 end"
            ),
            Self::Statuses(rounds) => write!(
                f,
                "a container's status files are stored for its first {rounds} rounds. The results need none of them"
            ),
            Self::Entries(number) => write!(
                f,
                "{number} entries are beyond what is looked at, or no files. Have fewer files written, and no links or \
                 pipes"
            ),
            Self::SameKey => f.write_str("another file has the same key"),
            Self::File(text) => f.write_str(text),
        }
    }
}

impl Why {
    /// Topic that is shown once: each limit, and each file that has a reason of its own.
    fn topic(&self, key: &str) -> String {
        match self {
            Self::Limit(Limit::Bytes(_)) => "bytes".to_owned(),
            Self::Limit(Limit::AgentBytes(_)) => "agents' bytes".to_owned(),
            Self::Limit(Limit::Objects(_)) => "objects".to_owned(),
            Self::Limit(Limit::AgentObjects(_)) => "agents' objects".to_owned(),
            Self::Day => "day".to_owned(),
            Self::Ended(_) => "end".to_owned(),
            Self::Statuses(_) => "statuses".to_owned(),
            Self::Entries(_) => "entries".to_owned(),
            Self::Shortened(_) | Self::Slow(_) | Self::SameKey | Self::File(_) => format!("of {key}"),
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
