//! S3, seen as the folder of one run: every key is below the run's prefix.
//!
//! Called by the controller (report, owner, texts) and by the programs in the Pod (everything). Knows keys and bytes; what
//! is stored when, and what the documents mean, is for its callers.

mod error;
mod keeping;
mod listing;
mod parts;
mod stream;
mod upload;

use aws_sdk_s3::error::{ProvideErrorMetadata, SdkError};
use aws_sdk_s3::operation::get_object::builders::GetObjectFluentBuilder;
use aws_sdk_s3::primitives::ByteStream;
use futures::{StreamExt, TryStreamExt};
use hyper::body::Bytes;
use tokio::io::AsyncWriteExt;

use crate::clients::Aws;
use crate::metered::Metered;
use leaderboard_api::{RunId, S3Bucket, effective};
use leaderboard_base::meter::Meter;

pub use error::{ArchiveError, Cause};
pub use listing::{Listed, Listing};
pub use parts::{MIN_PART, PART, PartsError};
pub use stream::StreamError;
pub use upload::read_range;

use keeping::Keeping;

/// Objects that are removed side by side.
const DELETIONS_AT_ONCE: usize = 8;
/// Times that an object is sent which another one gets ahead of.
const REPLACE_TRIES: u32 = 5;
type HttpResponse = aws_sdk_s3::config::http::HttpResponse;

/// One run's prefix in its bucket. Cheap to clone.
#[derive(Clone, Debug)]
pub struct Archive {
    client: aws_sdk_s3::Client,
    bucket: String,
    prefix: String,
    meter: Meter,
    keeping: Keeping,
}

/// An object with its content.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
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

/// Condition under which an object is stored in a place.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Before {
    /// No object.
    Nothing,
    /// The object with this entity tag.
    Tagged(String),
    /// It is not known, or this S3 has no conditions.
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
            keeping: Keeping::default(),
        }
    }

    /// The prefix of a run.
    pub fn of_run(aws: &Aws, storage: &S3Bucket, run_id: &RunId) -> Self {
        Self::of_storage(aws, storage).at_prefix(effective::key_prefix(storage, run_id))
    }

    /// The prefix of all runs.
    pub fn of_storage(aws: &Aws, storage: &S3Bucket) -> Self {
        let client = aws.s3(storage.region.as_deref(), storage.endpoint.as_deref());
        Self {
            meter: aws.meter().clone(),
            keeping: Keeping::of(storage),
            ..Self::new(client, &storage.bucket, storage.prefix.as_deref().unwrap_or_default())
        }
    }

    /// The bucket's name.
    pub fn bucket(&self) -> &str {
        &self.bucket
    }

    /// This bucket by this client, below another prefix.
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
        let request = self.client.get_object().set_if_none_match(etag.map(str::to_owned));
        self.read(key, request, limit).await
    }

    /// The last `bytes` of an object, or all of it; `None` if there is none.
    pub async fn tail(&self, key: &str, bytes: u64) -> Result<Option<Vec<u8>>, ArchiveError> {
        let request = self.client.get_object().range(format!("bytes=-{bytes}"));
        match self.read(key, request, bytes).await? {
            Fetched::Found(object) => Ok(Some(object.bytes)),
            Fetched::Absent | Fetched::NotModified => Ok(None),
        }
    }

    async fn read(&self, key: &str, request: GetObjectFluentBuilder, limit: u64) -> Result<Fetched, ArchiveError> {
        const OP: &str = "reading";
        let request = request.bucket(&self.bucket).key(self.full(key));
        let mut output = match self.meter.aws("s3", "GetObject", request.send()).await {
            Ok(output) => output,
            Err(error) if error::status(&error) == Some(304) => return Ok(Fetched::NotModified),
            // An empty object has no range.
            Err(error) if error::status(&error) == Some(416) => return Ok(Fetched::Found(Object::default())),
            Err(error) if is_absent(&error) => return Ok(Fetched::Absent),
            Err(error) if error::status(&error) == Some(403) && self.is_unlisted(key).await => {
                return Ok(Fetched::Absent);
            }
            Err(error) => return Err(self.failed(OP, key, &error)),
        };
        let announced = output.content_length.and_then(|length| u64::try_from(length).ok());
        let mut bytes = Vec::with_capacity(usize::try_from(announced.unwrap_or(0).min(limit)).unwrap_or(0));
        while let Some(chunk) = output.body.try_next().await.map_err(|e| self.broken(OP, key, &e))? {
            // A stand-in without ranges sends everything.
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
        let request = self.keeping.of_object(request).body(bytes.into()).send();
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
            let request = self.keeping.of_object(request).body(ByteStream::from(bytes.clone()));
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

    /// Lists `folder` (empty: everything), at most `limit` objects.
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
                    stored: object.last_modified.as_ref().and_then(listing::moment),
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

    /// True if nothing lies below the prefix.
    pub async fn prefix_is_empty(&self) -> Result<bool, ArchiveError> {
        Ok(self.list("", 1).await?.objects.is_empty())
    }

    /// Removes objects; ones that are not there are fine. One by one, because the request that removes many is one that cannot go without
    /// a checksum, which some stores refuse.
    pub async fn delete(&self, keys: &[String]) -> Result<(), ArchiveError> {
        let removals = keys.iter().map(|key| self.remove(key));
        futures::stream::iter(removals)
            .buffer_unordered(DELETIONS_AT_ONCE)
            .try_collect()
            .await
    }

    async fn remove(&self, key: &str) -> Result<(), ArchiveError> {
        let request = self.client.delete_object().bucket(&self.bucket).key(self.full(key));
        match request.send().await {
            Err(error) if !is_absent(&error) => Err(self.failed("deleting", key, &error)),
            Ok(_) | Err(_) => Ok(()),
        }
    }

    /// S3 answers 403 for a missing object to whom may list one prefix only. The list of that prefix distinguishes the two.
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
