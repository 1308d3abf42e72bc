//! Files that are stored in parts, because they are large or have grown: what S3 has already is copied there.
//!
//! Part of [`Archive`], which stores what fits into memory. How a file is cut is in `parts`.

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::sync::Arc;
use std::time::{Duration, Instant};

use aws_sdk_s3::config::RequestChecksumCalculation;
use aws_sdk_s3::primitives::ByteStream;
use aws_sdk_s3::types::builders::CompletedPartBuilder;
use aws_sdk_s3::types::{ChecksumAlgorithm, CompletedMultipartUpload, CompletedPart};
use percent_encoding::{AsciiSet, NON_ALPHANUMERIC, utf8_percent_encode};

use super::parts::{self, Part};
use super::{Archive, ArchiveError, Cause, Kept};
use crate::clients::timeouts;
use crate::metered::Metered;

const OP: &str = "storing";
const OP_PART: &str = "storing a part of";
/// Time S3 may take for copying a part or joining them.
const LONG_TRY: Duration = Duration::from_mins(5);
/// Characters that stay as they are in `x-amz-copy-source`.
const PLAIN: &AsciiSet = &NON_ALPHANUMERIC
    .remove(b'-')
    .remove(b'_')
    .remove(b'.')
    .remove(b'~')
    .remove(b'/');

impl Archive {
    /// Stores the first `size` bytes of a file in parts. Bytes that are stored already are copied inside S3. At most one part
    /// is in memory. At `cut_at` it aborts an upload that is not done. Returns the new object's entity tag.
    pub async fn upload(
        &self,
        key: &str,
        file: &Arc<File>,
        kept: Option<Kept<'_>>,
        size: u64,
        cut_at: Option<Instant>,
    ) -> Result<Option<String>, ArchiveError> {
        let parts = parts::plan(kept.map_or(0, |kept| kept.size), size);
        let parts = parts.map_err(|e| self.error(OP, key, e.into()))?;
        let id = self.begin_upload(key).await?;
        let sending = self.send_parts(key, &id, file, kept, parts);
        let stored = match cut_at {
            Some(cut_at) => tokio::time::timeout_at(cut_at.into(), sending)
                .await
                .unwrap_or_else(|_| Err(self.error(OP, key, Cause::Slow))),
            None => sending.await,
        };
        if stored.is_err() {
            self.abort_upload(key, &id).await;
        }
        stored
    }

    /// Begins an upload in parts. Returns its id.
    pub(super) async fn begin_upload(&self, key: &str) -> Result<String, ArchiveError> {
        let request = self.client.create_multipart_upload().bucket(&self.bucket);
        let request = request.key(self.full(key)).set_checksum_algorithm(self.announced());
        let request = self.keeping.of_upload(request).send();
        let output = self.meter.aws("s3", "CreateMultipartUpload", request).await;
        let id = output.map_err(|e| self.failed(OP, key, &e))?.upload_id;
        id.ok_or_else(|| self.error(OP, key, Cause::Refused("no upload id in the answer".to_owned())))
    }

    /// Gives an upload up.
    pub(super) async fn abort_upload(&self, key: &str, id: &str) {
        let request = self.client.abort_multipart_upload().bucket(&self.bucket);
        let request = request.key(self.full(key)).upload_id(id).send();
        // A failed abort leaves parts that cost storage only; the bucket's lifecycle rule removes them.
        let _ = self.meter.aws("s3", "AbortMultipartUpload", request).await;
    }

    /// Makes the object of the parts of an upload.
    pub(super) async fn join_parts(
        &self,
        key: &str,
        id: &str,
        parts: Vec<CompletedPart>,
    ) -> Result<Option<String>, ArchiveError> {
        let upload = CompletedMultipartUpload::builder().set_parts(Some(parts)).build();
        let request = self.client.complete_multipart_upload().bucket(&self.bucket);
        let request = request.key(self.full(key)).upload_id(id).multipart_upload(upload);
        let request = request.customize().config_override(patient()).send();
        let output = self.meter.aws("s3", "CompleteMultipartUpload", request).await;
        Ok(output.map_err(|e| self.failed(OP, key, &e))?.e_tag)
    }

    /// The SDK adds this checksum to each part, which S3 takes only if the upload has announced it. Without it where the SDK is not to add
    /// any: some stores refuse what they don't know.
    fn announced(&self) -> Option<ChecksumAlgorithm> {
        match self.client.config().request_checksum_calculation() {
            Some(RequestChecksumCalculation::WhenRequired) => None,
            _ => Some(ChecksumAlgorithm::Crc32),
        }
    }

    async fn send_parts(
        &self,
        key: &str,
        id: &str,
        file: &Arc<File>,
        kept: Option<Kept<'_>>,
        parts: Vec<Part>,
    ) -> Result<Option<String>, ArchiveError> {
        let mut done = Vec::with_capacity(parts.len());
        for (number, Part { is_stored, bytes }) in (1..).zip(parts) {
            let completed = match kept.filter(|_| is_stored) {
                Some(kept) => self.copy_part(key, id, number, kept.etag, bytes).await?,
                None => self.send_part(key, id, number, file, bytes).await?,
            };
            done.push(completed.part_number(number).build());
        }
        self.join_parts(key, id, done).await
    }

    async fn send_part(
        &self,
        key: &str,
        id: &str,
        number: i32,
        file: &Arc<File>,
        range: std::ops::Range<u64>,
    ) -> Result<CompletedPartBuilder, ArchiveError> {
        let bytes = read_range(file, range).await;
        let bytes = bytes.map_err(|e| self.error(OP_PART, key, e.into()))?;
        self.send_bytes(key, id, number, bytes).await
    }

    /// Stores one part of an upload.
    pub(super) async fn send_bytes(
        &self,
        key: &str,
        id: &str,
        number: i32,
        bytes: Vec<u8>,
    ) -> Result<CompletedPartBuilder, ArchiveError> {
        let request = self.client.upload_part().bucket(&self.bucket).key(self.full(key));
        let request = request.upload_id(id).part_number(number);
        let request = request.body(ByteStream::from(bytes)).send();
        let output = self.meter.aws("s3", "UploadPart", request).await;
        let output = output.map_err(|e| self.failed(OP_PART, key, &e))?;
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
    ) -> Result<CompletedPartBuilder, ArchiveError> {
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
}

/// Copying and joining large objects takes S3 longer than an ordinary answer.
fn patient() -> aws_sdk_s3::config::Builder {
    aws_sdk_s3::config::Builder::new().timeout_config(timeouts(LONG_TRY, LONG_TRY * 2))
}

/// Reads a part of a file, on a thread that may block.
pub async fn read_range(file: &Arc<File>, range: std::ops::Range<u64>) -> std::io::Result<Vec<u8>> {
    let file = Arc::clone(file);
    let read = tokio::task::spawn_blocking(move || {
        let mut bytes = vec![0; usize::try_from(range.end - range.start).map_err(std::io::Error::other)?];
        file.read_exact_at(&mut bytes, range.start)?;
        Ok(bytes)
    });
    read.await.map_err(std::io::Error::other)?
}
