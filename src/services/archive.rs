//! S3, seen as the folder of one run: every key is below the run's prefix.
//!
//! Called by the controller (report, owner, texts) and by the programs in the Pod (everything). Knows keys and bytes; what
//! is stored when, and what the documents say, is for its callers.

mod error;
mod parts;

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::sync::Arc;
use std::time::{Duration, Instant};

use aws_sdk_s3::error::{ProvideErrorMetadata, SdkError};
use aws_sdk_s3::primitives::ByteStream;
use aws_sdk_s3::types::{ChecksumAlgorithm, CompletedMultipartUpload, CompletedPart, Delete, ObjectIdentifier};
use hyper::body::Bytes;
use percent_encoding::{AsciiSet, NON_ALPHANUMERIC, utf8_percent_encode};
use tokio::io::AsyncWriteExt;

use crate::services::aws::Aws;
use crate::services::meter::Meter;
use leaderboard_api::{Storage, effective};

pub use error::{ArchiveError, Cause};
pub use parts::{MIN_PART, PART, Part, PartsError, plan as plan_parts};

/// Keys one DeleteObjects takes.
const DELETE_PAGE: usize = 1000;
/// Time S3 may take for copying a part or joining them.
const LONG_TRY: Duration = Duration::from_mins(5);
/// Times that an object is sent which another one gets ahead of.
const REPLACE_TRIES: u32 = 5;
/// What stays as it is in `x-amz-copy-source`.
const PLAIN: &AsciiSet = &NON_ALPHANUMERIC
    .remove(b'-')
    .remove(b'_')
    .remove(b'.')
    .remove(b'~')
    .remove(b'/');

type HttpResponse = aws_sdk_s3::config::http::HttpResponse;

/// One run's prefix in its bucket. Cheap to clone.
#[derive(Clone, Debug)]
pub struct Archive {
    client: aws_sdk_s3::Client,
    bucket: String,
    prefix: String,
    meter: Meter,
}

/// An object with its content.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Object {
    /// Its content.
    pub bytes: Vec<u8>,
    /// Its entity tag, for the next [`Archive::get_if_none_match`].
    pub etag: Option<String>,
}

/// Answer to a conditional read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Fetched {
    /// It is the one that is known.
    NotModified,
    /// There is none.
    Absent,
    /// Another one.
    Found(Object),
}

/// An object as the list shows it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Listed {
    /// Its key below the prefix.
    pub key: String,
    /// Its bytes.
    pub size: u64,
    /// Its entity tag.
    pub etag: Option<String>,
}

/// What lies below a prefix.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Listing {
    /// In the order of their keys.
    pub objects: Vec<Listed>,
    /// False if there are more than were asked for.
    pub complete: bool,
}

/// What has to be there for an object to be stored in its place.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Before {
    /// No object.
    Nothing,
    /// The object with this entity tag.
    Tagged(String),
    /// It is not known, or this S3 knows no conditions.
    Anything,
}

/// The stored beginning of a file that has grown.
#[derive(Clone, Copy, Debug)]
pub struct Kept<'a> {
    /// The stored object's entity tag: nothing is copied from another one.
    pub etag: &'a str,
    /// Its bytes.
    pub size: u64,
}

impl Archive {
    /// A prefix of one's own; `prefix` is empty or ends with a slash.
    pub fn new(client: aws_sdk_s3::Client, bucket: impl Into<String>, prefix: impl Into<String>) -> Self {
        Self {
            client,
            bucket: bucket.into(),
            prefix: prefix.into(),
            meter: Meter::default(),
        }
    }

    /// The prefix of a run.
    pub fn of_run(aws: &Aws, storage: &Storage, run_id: &str) -> Self {
        let client = aws.s3(storage.region.as_deref(), storage.endpoint.as_deref());
        Self {
            meter: aws.meter().clone(),
            ..Self::new(client, &storage.bucket, effective::key_prefix(storage, run_id))
        }
    }

    /// The same bucket by the same client, below another prefix.
    #[must_use]
    pub fn at_prefix(&self, prefix: impl Into<String>) -> Self {
        Self {
            prefix: prefix.into(),
            ..self.clone()
        }
    }

    /// An object of at most `limit` bytes; `None` if there is none.
    pub async fn get(&self, key: &str, limit: u64) -> Result<Option<Object>, ArchiveError> {
        match self.get_if_none_match(key, None, limit).await? {
            Fetched::Found(object) => Ok(Some(object)),
            Fetched::Absent | Fetched::NotModified => Ok(None),
        }
    }

    /// An object of at most `limit` bytes, unless it is still the one with this entity tag.
    pub async fn get_if_none_match(&self, key: &str, etag: Option<&str>, limit: u64) -> Result<Fetched, ArchiveError> {
        const OP: &str = "reading";
        let request = self.client.get_object().bucket(&self.bucket).key(self.full(key));
        let request = request.set_if_none_match(etag.map(str::to_owned)).send();
        let mut output = match self.meter.aws("s3", "GetObject", request).await {
            Ok(output) => output,
            Err(error) if error::status(&error) == Some(304) => return Ok(Fetched::NotModified),
            Err(error) if is_absent(&error) => return Ok(Fetched::Absent),
            Err(error) if error::status(&error) == Some(403) && self.is_unlisted(key).await => {
                return Ok(Fetched::Absent);
            }
            Err(error) => return Err(self.failed(OP, key, &error)),
        };
        let mut bytes = Vec::new();
        while let Some(chunk) = output.body.try_next().await.map_err(|e| self.broken(OP, key, &e))? {
            if (bytes.len() + chunk.len()) as u64 > limit {
                return Err(self.error(OP, key, Cause::TooLarge(limit)));
            }
            bytes.extend_from_slice(&chunk);
        }
        Ok(Fetched::Found(Object {
            bytes,
            etag: output.e_tag,
        }))
    }

    /// The last `bytes` of an object, or all of it; `None` if there is none.
    pub async fn tail(&self, key: &str, bytes: u64) -> Result<Option<Vec<u8>>, ArchiveError> {
        const OP: &str = "reading";
        let request = self.client.get_object().bucket(&self.bucket).key(self.full(key));
        let mut output = match request.range(format!("bytes=-{bytes}")).send().await {
            Ok(output) => output,
            Err(error) if is_absent(&error) => return Ok(None),
            // An empty object has no range.
            Err(error) if error::status(&error) == Some(416) => return Ok(Some(Vec::new())),
            Err(error) if error::status(&error) == Some(403) && self.is_unlisted(key).await => return Ok(None),
            Err(error) => return Err(self.failed(OP, key, &error)),
        };
        let mut tail = Vec::new();
        while let Some(chunk) = output.body.try_next().await.map_err(|e| self.broken(OP, key, &e))? {
            tail.extend_from_slice(&chunk);
            if tail.len() as u64 > bytes {
                // A stand-in that knows no ranges sends everything.
                return Err(self.error(OP, key, Cause::TooLarge(bytes)));
            }
        }
        Ok(Some(tail))
    }

    /// Writes an object's content to `into`, at most `limit` bytes. Returns how many; `None` if there is no object.
    pub async fn download(
        &self,
        key: &str,
        into: &mut tokio::fs::File,
        limit: u64,
    ) -> Result<Option<u64>, ArchiveError> {
        const OP: &str = "downloading";
        let request = self.client.get_object().bucket(&self.bucket).key(self.full(key));
        let mut output = match self.meter.aws("s3", "GetObject", request.send()).await {
            Ok(output) => output,
            Err(error) if is_absent(&error) => return Ok(None),
            Err(error) => return Err(self.failed(OP, key, &error)),
        };
        let mut size = 0;
        while let Some(chunk) = output.body.try_next().await.map_err(|e| self.broken(OP, key, &e))? {
            size += chunk.len() as u64;
            if size > limit {
                return Err(self.error(OP, key, Cause::TooLarge(limit)));
            }
            let written = into.write_all(&chunk).await;
            written.map_err(|e| self.error(OP, key, e.into()))?;
        }
        into.flush().await.map_err(|e| self.error(OP, key, e.into()))?;
        Ok(Some(size))
    }

    /// Stores an object that fits into memory. Returns its entity tag.
    pub async fn put(&self, key: &str, bytes: impl Into<ByteStream>) -> Result<Option<String>, ArchiveError> {
        let request = self.client.put_object().bucket(&self.bucket).key(self.full(key));
        let request = request.body(bytes.into()).send();
        let output = self.meter.aws("s3", "PutObject", request).await;
        Ok(output.map_err(|e| self.failed("storing", key, &e))?.e_tag)
    }

    /// Stores an object that fits into memory in place of the one with the entity tag `known`, or of none. If another one is
    /// there, that one is replaced. The condition is for a request that S3 carries out late, when its sender is gone: it must
    /// not replace what was stored since. Returns the new entity tag.
    pub async fn replace(&self, key: &str, bytes: Bytes, known: Option<&str>) -> Result<Option<String>, ArchiveError> {
        let mut before = known.map_or(Before::Nothing, |etag| Before::Tagged(etag.to_owned()));
        let mut tries: u32 = 0;
        loop {
            let request = self.client.put_object().bucket(&self.bucket).key(self.full(key));
            let request = request.body(ByteStream::from(bytes.clone()));
            let request = match &before {
                Before::Nothing => request.if_none_match("*"),
                Before::Tagged(etag) => request.if_match(etag),
                Before::Anything => request,
            };
            let error = match self.meter.aws("s3", "PutObject", request.send()).await {
                Ok(output) => return Ok(output.e_tag),
                Err(error) => error,
            };
            tries = tries.saturating_add(1);
            let failed = self.failed("storing", key, &error);
            before = match failed.cause {
                _ if tries == REPLACE_TRIES => return Err(failed),
                _ if knows_no_conditions(&error) => Before::Anything,
                Cause::Changed => self.before(key).await?,
                _ => return Err(failed),
            };
        }
    }

    async fn before(&self, key: &str) -> Result<Before, ArchiveError> {
        let listing = self.list(key, 1).await?;
        let present = listing.objects.into_iter().find(|object| object.key == key);
        Ok(present.map_or(Before::Nothing, |object| {
            object.etag.map_or(Before::Anything, Before::Tagged)
        }))
    }

    /// What lies below `folder` (empty: everything), at most `limit` objects.
    pub async fn list(&self, folder: &str, limit: usize) -> Result<Listing, ArchiveError> {
        let mut objects = Vec::new();
        let mut next = None;
        loop {
            let page = i32::try_from((limit - objects.len()).clamp(1, 1000)).unwrap_or(1000);
            let request = self.client.list_objects_v2().bucket(&self.bucket).max_keys(page);
            let request = request.prefix(self.full(folder)).set_continuation_token(next);
            let output = self.meter.aws("s3", "ListObjectsV2", request.send()).await;
            let output = output.map_err(|e| self.failed("listing", folder, &e))?;
            objects.extend(output.contents.unwrap_or_default().into_iter().filter_map(|object| {
                Some(Listed {
                    key: object.key?.strip_prefix(&self.prefix)?.to_owned(),
                    size: object.size.and_then(|size| u64::try_from(size).ok()).unwrap_or(0),
                    etag: object.e_tag,
                })
            }));
            next = output.next_continuation_token;
            if next.is_none() || objects.len() >= limit {
                let complete = next.is_none() && objects.len() <= limit;
                objects.truncate(limit);
                return Ok(Listing { objects, complete });
            }
        }
    }

    /// Whether nothing lies below the prefix.
    pub async fn prefix_is_empty(&self) -> Result<bool, ArchiveError> {
        Ok(self.list("", 1).await?.objects.is_empty())
    }

    /// Removes objects; ones that are not there are fine.
    pub async fn delete(&self, keys: &[String]) -> Result<(), ArchiveError> {
        const OP: &str = "deleting";
        for page in keys.chunks(DELETE_PAGE) {
            let first = page.first().map_or("", String::as_str);
            let refused = |text: String| self.error(OP, first, Cause::Refused(text));
            let objects: Result<Vec<_>, _> = page
                .iter()
                .map(|key| ObjectIdentifier::builder().key(self.full(key)).build())
                .collect();
            let objects = objects.map_err(|e| refused(e.to_string()))?;
            let delete = Delete::builder().set_objects(Some(objects)).quiet(true).build();
            let delete = delete.map_err(|e| refused(e.to_string()))?;
            let request = self.client.delete_objects().bucket(&self.bucket).delete(delete);
            let output = request.send().await.map_err(|e| self.failed(OP, first, &e))?;
            if let Some(error) = output.errors().first() {
                let text = error.message().or(error.code()).unwrap_or("no reason given");
                return Err(refused(text.to_owned()));
            }
        }
        Ok(())
    }

    /// Stores the first `size` bytes of a file in parts; what is stored of it already is copied inside S3. At most one part
    /// is in memory. What is not done at `cut_at` is aborted. Returns the new object's entity tag.
    pub async fn upload(
        &self,
        key: &str,
        file: &Arc<File>,
        kept: Option<Kept<'_>>,
        size: u64,
        cut_at: Option<Instant>,
    ) -> Result<Option<String>, ArchiveError> {
        const OP: &str = "storing";
        let parts = parts::plan(kept.map_or(0, |kept| kept.size), size);
        let parts = parts.map_err(|e| self.error(OP, key, e.into()))?;
        let request = self.client.create_multipart_upload().bucket(&self.bucket);
        // The SDK adds a checksum to each part, which S3 takes only if the upload announced it.
        let request = request.key(self.full(key)).checksum_algorithm(ChecksumAlgorithm::Crc32);
        let output = request.send().await.map_err(|e| self.failed(OP, key, &e))?;
        let Some(id) = output.upload_id else {
            return Err(self.error(OP, key, Cause::Refused("no upload id in the answer".to_owned())));
        };
        let sending = self.send_parts(key, &id, file, kept, &parts);
        let stored = match cut_at {
            Some(cut_at) => tokio::time::timeout_at(cut_at.into(), sending)
                .await
                .unwrap_or_else(|_| Err(self.error(OP, key, Cause::Slow))),
            None => sending.await,
        };
        if stored.is_err() {
            let abort = self.client.abort_multipart_upload().bucket(&self.bucket);
            // What is left over costs storage only; the bucket's lifecycle rule ends it.
            let _ = abort.key(self.full(key)).upload_id(&id).send().await;
        }
        stored
    }

    async fn send_parts(
        &self,
        key: &str,
        id: &str,
        file: &Arc<File>,
        kept: Option<Kept<'_>>,
        parts: &[Part],
    ) -> Result<Option<String>, ArchiveError> {
        let mut done = Vec::with_capacity(parts.len());
        for (number, part) in (1..).zip(parts) {
            let completed = match *part {
                Part::Copy { from, len } => {
                    let etag = kept.map_or("", |kept| kept.etag);
                    self.copy_part(key, id, number, etag, from..from + len).await?
                }
                Part::Send { from, len } => self.send_part(key, id, number, file, from..from + len).await?,
            };
            done.push(completed.part_number(number).build());
        }
        let upload = CompletedMultipartUpload::builder().set_parts(Some(done)).build();
        let request = self.client.complete_multipart_upload().bucket(&self.bucket);
        let request = request.key(self.full(key)).upload_id(id).multipart_upload(upload);
        let output = request.customize().config_override(patient()).send().await;
        Ok(output.map_err(|e| self.failed("storing", key, &e))?.e_tag)
    }

    async fn send_part(
        &self,
        key: &str,
        id: &str,
        number: i32,
        file: &Arc<File>,
        range: std::ops::Range<u64>,
    ) -> Result<aws_sdk_s3::types::builders::CompletedPartBuilder, ArchiveError> {
        const OP: &str = "storing a part of";
        let bytes = read_range(file, range)
            .await
            .map_err(|e| self.error(OP, key, e.into()))?;
        let request = self.client.upload_part().bucket(&self.bucket).key(self.full(key));
        let request = request.upload_id(id).part_number(number);
        let request = request.checksum_algorithm(ChecksumAlgorithm::Crc32);
        let output = request.body(ByteStream::from(bytes)).send().await;
        let output = output.map_err(|e| self.failed(OP, key, &e))?;
        let part = CompletedPart::builder().set_e_tag(output.e_tag);
        Ok(part.set_checksum_crc32(output.checksum_crc32))
    }

    async fn copy_part(
        &self,
        key: &str,
        id: &str,
        number: i32,
        etag: &str,
        range: std::ops::Range<u64>,
    ) -> Result<aws_sdk_s3::types::builders::CompletedPartBuilder, ArchiveError> {
        const OP: &str = "copying a part of";
        let source = format!("{}/{}", self.bucket, self.full(key));
        let source = utf8_percent_encode(&source, PLAIN).to_string();
        let request = self.client.upload_part_copy().bucket(&self.bucket).key(self.full(key));
        let request = request.upload_id(id).part_number(number).copy_source(source);
        let request = request.copy_source_if_match(etag);
        let request = request.copy_source_range(format!("bytes={}-{}", range.start, range.end - 1));
        let output = request.customize().config_override(patient()).send().await;
        let result = output.map_err(|e| self.failed(OP, key, &e))?.copy_part_result;
        let part = CompletedPart::builder();
        Ok(match result {
            Some(result) => part.set_e_tag(result.e_tag).set_checksum_crc32(result.checksum_crc32),
            None => part,
        })
    }

    /// S3 says 403 for a missing object to whom may list one prefix only. The list of that prefix tells the two apart.
    async fn is_unlisted(&self, key: &str) -> bool {
        let listing = self.list(key, 1).await;
        listing.is_ok_and(|listing| listing.objects.iter().all(|object| object.key != key))
    }

    fn full(&self, key: &str) -> String {
        format!("{}{key}", self.prefix)
    }

    fn error(&self, op: &'static str, key: &str, cause: Cause) -> ArchiveError {
        ArchiveError {
            op,
            object: format!("{}/{}", self.bucket, self.full(key)),
            cause,
        }
    }

    fn failed<E>(&self, op: &'static str, key: &str, error: &SdkError<E, HttpResponse>) -> ArchiveError
    where
        E: ProvideErrorMetadata + std::error::Error + 'static,
    {
        self.error(op, key, Cause::of(error))
    }

    fn broken(&self, op: &'static str, key: &str, error: &dyn std::error::Error) -> ArchiveError {
        self.error(op, key, Cause::Away(error.to_string()))
    }
}

fn is_absent<E: ProvideErrorMetadata>(error: &SdkError<E, HttpResponse>) -> bool {
    error::status(error) == Some(404) && error.code() != Some("NoSuchBucket")
}

/// Some stores refuse a request with a condition that they can't check.
fn knows_no_conditions<E: ProvideErrorMetadata>(error: &SdkError<E, HttpResponse>) -> bool {
    error::status(error) == Some(501) || error.code() == Some("NotImplemented")
}

/// Copying and joining large objects takes S3 longer than an ordinary answer.
fn patient() -> aws_sdk_s3::config::Builder {
    let timeouts = aws_config::timeout::TimeoutConfig::builder()
        .connect_timeout(Duration::from_secs(5))
        .operation_attempt_timeout(LONG_TRY)
        .operation_timeout(LONG_TRY * 2)
        .build();
    aws_sdk_s3::config::Builder::new().timeout_config(timeouts)
}

/// Reads a part of a file, on a thread that may block.
pub(crate) async fn read_range(file: &Arc<File>, range: std::ops::Range<u64>) -> std::io::Result<Vec<u8>> {
    let file = Arc::clone(file);
    let read = tokio::task::spawn_blocking(move || {
        let mut bytes = vec![0; usize::try_from(range.end - range.start).map_err(std::io::Error::other)?];
        file.read_exact_at(&mut bytes, range.start)?;
        Ok(bytes)
    });
    read.await.map_err(std::io::Error::other)?
}
