//! Sends the containers' logs to CloudWatch: each file once, in order, line by line.
//!
//! A task of `logcopy` with a pace of its own, so that neither waits for the other. Streams are `<run id>/<container>`. The position
//! in each file is noted next to the files, so that a restarted logcopy goes on where the last one was.

use std::collections::{BTreeMap, BTreeSet};
use std::os::unix::fs::FileExt;
use std::sync::Arc;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use tokio::sync::watch;

use super::blocking;
use super::daily::{Daily, Spent, today};
use super::upload::Memory;
use leaderboard_api::RunId;
use leaderboard_aws::logs::{BETWEEN_BATCHES, LogClient, LogEvent, LogsError, Miss, OVERHEAD, cut};
use leaderboard_base::backoff::Backoff;
use leaderboard_base::clock::Clock;
use leaderboard_contract::keys::{COLLECT_LOG, CONTENTS_LOG, OWN_LOG, WORKSPACE_LOG, agent_log, host_log};
use leaderboard_contract::report::Logs;
use leaderboard_evidence::{Tree, TreeError};
use leaderboard_protocol::files::{Host, Pair};

/// Bytes read of one file at once.
const CHUNK: u64 = 256 << 10;
/// Batches of one file in one round.
const BATCHES: usize = 64;
/// Where the note lies on the `logs` volume.
const NOTE: &str = "logcopy/.shipped.json";
/// Largest note that is read, in bytes.
const NOTE_LIMIT: u64 = 1 << 20;
/// Bytes that one stream gets on a day, as CloudWatch bills them: an agent that rewrites its log all the time ends its stream
/// for that day. S3 has the log all the same.
pub const STREAM_A_DAY: u64 = 512 << 20;
/// Pauses of the last round after failures.
const AGAIN: Backoff = Backoff::new(Duration::from_millis(500), Duration::from_secs(4));
/// Time the last round may take.
const LAST_ROUND: Duration = Duration::from_secs(20);

/// How far a file was sent.
#[derive(Serialize, Deserialize, Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Mark {
    inode: u64,
    offset: u64,
}

/// Note next to the files.
#[derive(Serialize, Deserialize, Clone, Debug, Default, PartialEq, Eq)]
struct Note {
    /// By path.
    marks: BTreeMap<String, Mark>,
    /// By stream.
    sent: Daily,
}

/// Batch whose answer never came, so that it may have been sent.
#[derive(Clone, Debug)]
struct Doubt {
    path: String,
    last: LogEvent,
    after: Mark,
}

/// Sends the logs of one run.
#[derive(Debug)]
pub struct Shipper {
    client: LogClient,
    tree: Arc<Tree>,
    /// Stream by path.
    streams: BTreeMap<String, String>,
    note: Note,
    /// Bytes of one stream on a day.
    a_day: u64,
    made: BTreeSet<String>,
    doubt: Option<Doubt>,
    newest: i64,
}

impl Shipper {
    /// Goes on where the last one was. Bytes that a Pod before this one has stored count as sent: that Pod sent them. `a_day`: bytes
    /// that one stream gets on a day.
    pub fn new(
        client: LogClient,
        tree: Arc<Tree>,
        run_id: &RunId,
        (pairs, host): (usize, Host),
        restored: &Memory,
        a_day: u64,
    ) -> Self {
        let agents = Pair::first(pairs).map(|pair| (agent_log(pair), format!("{run_id}/{}", pair.agent())));
        let hosts = Pair::first(pairs).map(|pair| (host_log(host, pair), format!("{run_id}/{}", pair.host(host))));
        let streams: BTreeMap<String, String> = agents
            .chain(hosts)
            .chain([
                (OWN_LOG.to_owned(), format!("{run_id}/logcopy")),
                (WORKSPACE_LOG.to_owned(), format!("{run_id}/workspace")),
                (CONTENTS_LOG.to_owned(), format!("{run_id}/contents")),
                (COLLECT_LOG.to_owned(), format!("{run_id}/collect")),
            ])
            .collect();
        let note = tree.read(NOTE, NOTE_LIMIT).ok().flatten();
        let noted = note.and_then(|(bytes, _)| serde_json::from_slice(&bytes).ok());
        let note = noted.unwrap_or_else(|| {
            let marks = streams.keys().filter_map(|path| {
                let stamp = restored.stored.get(path)?.stamp;
                let (inode, offset) = (stamp.inode, stamp.size);
                Some((path.clone(), Mark { inode, offset }))
            });
            let (marks, sent) = (marks.collect(), Daily::default());
            Note { marks, sent }
        });
        Self {
            client,
            tree,
            streams,
            note,
            a_day,
            made: BTreeSet::new(),
            doubt: None,
            newest: 0,
        }
    }

    /// Sends every `period` until `done` is true, and then once more. Tells what has become of the lines.
    pub async fn run(mut self, period: Duration, mut done: watch::Receiver<bool>, told: watch::Sender<Option<Logs>>) {
        // Noted before this life of logcopy has stored anything: its next one must not take what is stored for what was sent.
        self.write_note().await;
        let mut complained = false;
        while !*done.borrow_and_update() {
            let sent = self.pass(false).await;
            if let Some(logs) = self.what_of(&sent) {
                told.send_if_modified(|known| known.replace(logs.clone()) != Some(logs));
            }
            match sent {
                Ok(()) => complained = false,
                Err(error) if !complained => {
                    complained = true;
                    tracing::warn!("{error}");
                }
                Err(_) => {}
            }
            let ended = tokio::time::timeout(period, done.changed()).await;
            if matches!(ended, Ok(Err(_))) {
                break;
            }
        }
        match tokio::time::timeout(LAST_ROUND, self.last()).await {
            Ok(Ok(())) => {}
            Ok(Err(error)) => tracing::warn!("{error}"),
            Err(_) => tracing::warn!("the last lines are not in CloudWatch Logs: it took too long"),
        }
    }

    /// State of the lines for the report; none while CloudWatch does not answer, or nothing was printed.
    fn what_of(&self, sent: &Result<(), LogsError>) -> Option<Logs> {
        match sent {
            Err(error) if error.is_transient() => None,
            Err(error) => Some(Logs::Refused(error.to_string())),
            Ok(()) => (!self.made.is_empty()).then_some(Logs::Sent),
        }
    }

    /// Sends what is left, also of lines without an end, as often as it takes: no round follows.
    async fn last(&mut self) -> Result<(), LogsError> {
        let mut failures: u32 = 0;
        loop {
            match self.pass(true).await {
                Err(error) if error.is_transient() => tracing::warn!("{error}"),
                ended => return ended,
            }
            failures = failures.saturating_add(1);
            tokio::time::sleep(AGAIN.after(failures)).await;
        }
    }

    /// Sends what is new in every file; `last`: also a line without an end.
    pub async fn pass(&mut self, last: bool) -> Result<(), LogsError> {
        self.resolve().await?;
        let streams = self.streams.clone();
        for (path, stream) in &streams {
            // A flood in one file must not keep the others back.
            for _ in 0..BATCHES {
                if !self.send(path, stream, last).await? {
                    break;
                }
            }
        }
        Ok(())
    }

    /// Sends one batch of a file. Returns whether there may be more.
    async fn send(&mut self, path: &str, stream: &str, last: bool) -> Result<bool, LogsError> {
        self.note.sent.begin(today());
        if self.note.sent.of(stream).bytes >= self.a_day {
            return Ok(false);
        }
        let mark = self.note.marks.get(path).copied().unwrap_or_default();
        // A file that can't be read is the uploader's to complain about.
        let (tree, file) = (Arc::clone(&self.tree), path.to_owned());
        let Ok(Some((bytes, mark))) = blocking(move || next(&tree, &file, mark)).await else {
            return Ok(false);
        };
        let is_full = bytes.len() as u64 == CHUNK;
        self.newest = self.newest.max(milliseconds());
        let endless = is_full && !bytes.contains(&b'\n');
        let (events, consumed) = cut(&bytes, (last && !is_full) || endless, self.newest);
        if consumed == 0 {
            return Ok(false);
        }
        let after = Mark {
            offset: mark.offset.saturating_add(consumed as u64),
            ..mark
        };
        let sent = Instant::now();
        if self.note.sent.of(stream).bytes.saturating_add(billed(&events)) > self.a_day {
            return self.end_for_today(path, stream).await.map(|()| false);
        }
        self.put(path, stream, &events, after).await?;
        self.note(path, after).await;
        let more = is_full || consumed < bytes.len();
        if more {
            tokio::time::sleep(BETWEEN_BATCHES.saturating_sub(sent.elapsed())).await;
        }
        Ok(more)
    }

    /// Writes to the stream and to logcopy's own log that no more of it comes today.
    async fn end_for_today(&mut self, path: &str, stream: &str) -> Result<(), LogsError> {
        let text = format!(
            "logcopy: the daily limit of {} bytes of this stream is reached; it goes on tomorrow (UTC). {path} in S3 has \
             all. Have less printed.",
            self.a_day
        );
        let line = LogEvent {
            time: self.newest,
            text,
        };
        // Noted first: whatever becomes of the line, nothing more is sent.
        let rest = Spent {
            requests: 1,
            bytes: self.a_day,
        };
        self.note.sent.add(stream, rest);
        self.write_note().await;
        tracing::warn!(stream, "not in CloudWatch Logs: {}", line.text);
        let mark = self.note.marks.get(path).copied().unwrap_or_default();
        self.put(path, stream, &[line], mark).await
    }

    async fn put(&mut self, path: &str, stream: &str, events: &[LogEvent], after: Mark) -> Result<(), LogsError> {
        let Some(last) = events.last() else {
            return Ok(());
        };
        if !self.made.contains(stream) {
            self.client.create_stream(stream).await?;
            self.made.insert(stream.to_owned());
        }
        let result = self.client.put(stream, events).await;
        let miss = result.as_ref().err().map(|error| error.miss);
        if miss.is_none_or(|miss| miss == Miss::Unanswered) {
            let cost = Spent {
                requests: 1,
                bytes: billed(events),
            };
            self.note.sent.add(stream, cost);
        }
        match miss {
            Some(Miss::NoStream) => {
                self.made.remove(stream);
            }
            Some(Miss::Unanswered) => {
                self.doubt = Some(Doubt {
                    path: path.to_owned(),
                    last: last.clone(),
                    after,
                });
            }
            _ => {}
        }
        result
    }

    /// Finds out whether the batch without an answer arrived, before anything is sent again.
    async fn resolve(&mut self) -> Result<(), LogsError> {
        let Some(doubt) = self.doubt.clone() else {
            return Ok(());
        };
        let stream = self.streams.get(&doubt.path).cloned().unwrap_or_default();
        let arrived = match self.client.last(&stream).await {
            Ok(last) => last.as_ref() == Some(&doubt.last),
            Err(error) if error.miss == Miss::NoStream => false,
            Err(error) => return Err(error),
        };
        if arrived {
            self.note(&doubt.path, doubt.after).await;
        }
        self.doubt = None;
        Ok(())
    }

    async fn note(&mut self, path: &str, mark: Mark) {
        self.note.marks.insert(path.to_owned(), mark);
        self.write_note().await;
    }

    async fn write_note(&self) {
        let (note, tree) = (self.note.clone(), Arc::clone(&self.tree));
        let write = move || -> Result<(), TreeError> {
            let bytes = serde_json::to_vec(&note).map_err(std::io::Error::other)?;
            tree.write(NOTE, &bytes)
        };
        if let Err(error) = blocking(write).await {
            tracing::warn!("how far logs were sent can't be noted down: {error}");
        }
    }
}

/// The next piece of a file, and where it begins: at 0 if it is another file than before.
fn next(tree: &Tree, path: &str, mark: Mark) -> Result<Option<(Vec<u8>, Mark)>, TreeError> {
    let Some((file, stamp)) = tree.file(path)? else {
        return Ok(None);
    };
    let goes_on = stamp.inode == mark.inode && stamp.size >= mark.offset;
    let offset = if goes_on { mark.offset } else { 0 };
    let len = stamp.size.saturating_sub(offset).min(CHUNK);
    let mut bytes = vec![0; usize::try_from(len).unwrap_or(0)];
    file.read_exact_at(&mut bytes, offset)?;
    let inode = stamp.inode;
    Ok((len > 0).then_some((bytes, Mark { inode, offset })))
}

/// Bytes that events count.
fn billed(events: &[LogEvent]) -> u64 {
    let sizes = events.iter().map(|event| event.text.len().saturating_add(OVERHEAD));
    sizes.fold(0, |sum: u64, size| sum.saturating_add(size as u64))
}

fn milliseconds() -> i64 {
    Clock::system().now().as_millisecond()
}
