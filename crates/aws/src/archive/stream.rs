//! Objects whose content comes as a stream: each part is stored before the next one is taken in.
//!
//! Part of [`Archive`]. An object of one part is stored whole, without an upload in parts.

use std::pin::pin;

use futures::stream::{Stream, TryStreamExt};
use hyper::body::Bytes;
use sha2::{Digest, Sha256};

use super::{Archive, ArchiveError, parts};
use leaderboard_api::SubmittedFile;

/// Why a stream was not stored.
#[derive(thiserror::Error, Debug)]
pub enum StreamError<E> {
    /// It brings more than may be stored.
    #[error("it has more than {0} bytes")]
    TooLarge(u64),
    /// It failed itself.
    #[error("it broke off")]
    Broken(E),
    /// S3 did not take it.
    #[error(transparent)]
    Archive(#[from] ArchiveError),
}

impl Archive {
    /// Stores what a stream brings, `limit` bytes at most, with one part of it in memory. When it fails, the upload is aborted and the object
    /// stays what it was.
    pub async fn put_stream<E>(
        &self,
        key: &str,
        stream: impl Stream<Item = Result<Bytes, E>>,
        limit: u64,
    ) -> Result<SubmittedFile, StreamError<E>> {
        let step = parts::step_within(limit).map_err(|e| self.error("storing", key, e.into()))?;
        let stream = pin!(stream);
        let mut source = Source::new(stream, step, limit);
        let first = source.part().await?;
        if !source.fill().await? {
            self.put(key, first).await?;
            return Ok(source.file());
        }
        let id = self.begin_upload(key).await?;
        let sent = self.send_stream(key, &id, first, &mut source).await;
        if sent.is_err() {
            self.abort_upload(key, &id).await;
        }
        sent.map(|()| source.file())
    }

    async fn send_stream<S, E>(
        &self,
        key: &str,
        id: &str,
        first: Vec<u8>,
        source: &mut Source<S>,
    ) -> Result<(), StreamError<E>>
    where
        S: Stream<Item = Result<Bytes, E>> + Unpin,
    {
        let (mut done, mut part) = (Vec::new(), first);
        for number in 1.. {
            let sent = self.send_bytes(key, id, number, part).await?;
            done.push(sent.part_number(number).build());
            if !source.fill().await? {
                break;
            }
            part = source.part().await?;
        }
        self.join_parts(key, id, done).await?;
        Ok(())
    }
}

/// A stream that is cut into parts.
struct Source<S> {
    stream: S,
    /// Bytes of a part.
    step: usize,
    limit: u64,
    /// What has come and belongs to the next part.
    rest: Bytes,
    is_over: bool,
    /// Bytes that have come, and their digest.
    size: u64,
    digest: Sha256,
}

impl<S, E> Source<S>
where
    S: Stream<Item = Result<Bytes, E>> + Unpin,
{
    fn new(stream: S, step: u64, limit: u64) -> Self {
        Self {
            stream,
            step: usize::try_from(step).unwrap_or(usize::MAX),
            limit,
            rest: Bytes::new(),
            is_over: false,
            size: 0,
            digest: Sha256::new(),
        }
    }

    /// The next part, which is shorter at the end of the stream.
    async fn part(&mut self) -> Result<Vec<u8>, StreamError<E>> {
        let mut part = Vec::with_capacity(self.step);
        while part.len() < self.step && self.fill().await? {
            let length = self.rest.len().min(self.step - part.len());
            part.extend_from_slice(&self.rest.split_to(length));
        }
        Ok(part)
    }

    /// Waits until there is something of a next part. False at the end of the stream.
    async fn fill(&mut self) -> Result<bool, StreamError<E>> {
        while self.rest.is_empty() && !self.is_over {
            match self.stream.try_next().await.map_err(StreamError::Broken)? {
                Some(bytes) => self.take(bytes)?,
                None => self.is_over = true,
            }
        }
        Ok(!self.rest.is_empty())
    }

    fn take(&mut self, bytes: Bytes) -> Result<(), StreamError<E>> {
        self.size = self.size.saturating_add(bytes.len() as u64);
        if self.size > self.limit {
            return Err(StreamError::TooLarge(self.limit));
        }
        self.digest.update(&bytes);
        self.rest = bytes;
        Ok(())
    }

    /// What has come.
    fn file(self) -> SubmittedFile {
        SubmittedFile {
            sha256: hex::encode(self.digest.finalize()),
            size: i64::try_from(self.size).unwrap_or(i64::MAX),
        }
    }
}

#[cfg(test)]
mod tests;
