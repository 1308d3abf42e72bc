//! How objects are kept: what a Leaderboard asks of S3 for each object that is made. Pure.

use aws_sdk_s3::operation::create_multipart_upload::builders::CreateMultipartUploadFluentBuilder;
use aws_sdk_s3::operation::put_object::builders::PutObjectFluentBuilder;
use aws_sdk_s3::types::{ServerSideEncryption, StorageClass};

use leaderboard_api::S3Bucket;

/// Nothing is asked for by default: the bucket decides.
#[derive(Clone, Debug, Default)]
pub(super) struct Keeping {
    kms_key: Option<String>,
    class: Option<StorageClass>,
}

impl Keeping {
    pub(super) fn of(storage: &S3Bucket) -> Self {
        Self {
            kms_key: storage.kms_key_arn.clone(),
            class: storage.storage_class.map(|class| class.as_str().into()),
        }
    }

    fn encryption(&self) -> Option<ServerSideEncryption> {
        self.kms_key.as_ref().map(|_| ServerSideEncryption::AwsKms)
    }

    /// With a key of the bucket's own, S3 asks KMS once in a while and not for each object.
    fn has_bucket_key(&self) -> Option<bool> {
        self.kms_key.as_ref().map(|_| true)
    }

    /// For an object that is sent whole.
    pub(super) fn of_object(&self, request: PutObjectFluentBuilder) -> PutObjectFluentBuilder {
        request
            .set_server_side_encryption(self.encryption())
            .set_ssekms_key_id(self.kms_key.clone())
            .set_bucket_key_enabled(self.has_bucket_key())
            .set_storage_class(self.class.clone())
    }

    /// For one that is sent in parts; they are kept as its beginning requires.
    pub(super) fn of_upload(&self, request: CreateMultipartUploadFluentBuilder) -> CreateMultipartUploadFluentBuilder {
        request
            .set_server_side_encryption(self.encryption())
            .set_ssekms_key_id(self.kms_key.clone())
            .set_bucket_key_enabled(self.has_bucket_key())
            .set_storage_class(self.class.clone())
    }
}
