//! Errors of S3, in words for the person who runs the bucket.

use std::borrow::Cow;

use aws_sdk_s3::error::{ProvideErrorMetadata, SdkError};

use super::parts::PartsError;
use crate::fault::{self, Fault};
use leaderboard_api::DOCUMENTS;

type HttpResponse = aws_sdk_s3::config::http::HttpResponse;

/// A request to S3 that did not do what it was for.
#[derive(thiserror::Error, Debug)]
#[error("{op} s3://{object}: {cause}. {}", .cause.next_step())]
pub struct ArchiveError {
    /// Operation, as a verb.
    pub op: &'static str,
    /// Bucket and key.
    pub object: String,
    /// Why not.
    pub cause: Cause,
}

/// Why a request to S3 failed.
#[derive(thiserror::Error, Debug)]
pub enum Cause {
    /// The credentials do not allow it, or there are none.
    #[error("S3 denies access ({0})")]
    Denied(String),
    /// No such bucket.
    #[error("the bucket does not exist")]
    NoBucket,
    /// The object is not the one that was asked for, or is gone.
    #[error("the object was changed by somebody else")]
    Changed,
    /// More than is read.
    #[error("the object has more than the {0} bytes that are read")]
    TooLarge(u64),
    /// No answer, or one that asks to try again.
    #[error("S3 does not answer ({0})")]
    Away(String),
    /// The store knows no such request, or nothing of a header that it has.
    #[error("the store does not know how to do this ({0})")]
    Unknown(String),
    /// Any other refusal.
    #[error("S3 refuses the request ({0})")]
    Refused(String),
    /// It is not done in the time that its caller has for it.
    #[error("it takes too long")]
    Slow,
    /// The file on this side.
    #[error("the local file can't be used ({0})")]
    Local(#[from] std::io::Error),
    /// S3 would not take the parts.
    #[error(transparent)]
    Parts(#[from] PartsError),
}

impl ArchiveError {
    /// True if there is more than was to be read.
    pub fn is_too_large(&self) -> bool {
        matches!(self.cause, Cause::TooLarge(_))
    }
}

impl Cause {
    /// Next step, as one sentence.
    pub fn next_step(&self) -> Cow<'static, str> {
        let step = match self {
            Self::Denied(_) => {
                "Give the identity s3:GetObject, s3:PutObject, s3:DeleteObject, s3:AbortMultipartUpload and \
                 s3:ListBucket for the prefix."
            }
            Self::NoBucket => {
                "Create the bucket, or correct storage.s3.bucket and storage.s3.region of the leaderboard."
            }
            Self::Changed => "Let nobody else write below this prefix.",
            Self::TooLarge(_) => "Look at the object: nothing of ours is that large.",
            Self::Away(_) => "It is tried again; check storage.s3.endpoint and the network rules if this stays.",
            Self::Unknown(_) => {
                "If it is for a checksum (CRC32), set AWS_REQUEST_CHECKSUM_CALCULATION=when_required in controller.extraEnv of the chart: \
                 the controller and its Pods then send none."
            }
            Self::Refused(_) => {
                return Cow::Owned(format!(
                    "Check storage.s3.bucket, storage.s3.region and storage.s3.endpoint of the leaderboard; {DOCUMENTS}results.md has the \
                     stores that refuse checksums."
                ));
            }
            Self::Slow => "It is tried again later.",
            Self::Local(_) => "Check the volume of the Pod.",
            Self::Parts(_) => "The file is stored whole instead.",
        };
        Cow::Borrowed(step)
    }

    /// True if the same request may succeed later.
    pub fn is_transient(&self) -> bool {
        matches!(self, Self::Away(_))
    }

    /// Cause of an error of the SDK.
    pub(super) fn of<E>(error: &SdkError<E, HttpResponse>) -> Self
    where
        E: ProvideErrorMetadata + std::error::Error + 'static,
    {
        let status = status(error);
        let sentence = fault::sentence(error);
        // Without a message it names the status itself.
        let text = match status {
            Some(status) if !sentence.ends_with(&format!("(HTTP {status})")) => format!("status {status}, {sentence}"),
            _ => sentence,
        };
        match (status, error.code()) {
            (_, Some("NoSuchBucket")) => Self::NoBucket,
            (Some(404 | 412), _) | (_, Some("PreconditionFailed" | "ConditionalRequestConflict")) => Self::Changed,
            (Some(501), _) | (_, Some("NotImplemented")) => Self::Unknown(text),
            _ => match fault::of(error) {
                Fault::Denied => Self::Denied(text),
                Fault::Throttled | Fault::Unavailable => Self::Away(text),
                Fault::Missing | Fault::Conflict | Fault::Refused => Self::Refused(text),
            },
        }
    }
}

/// The status of an answer that the SDK takes for an error.
pub(super) fn status<E>(error: &SdkError<E, HttpResponse>) -> Option<u16> {
    error.raw_response().map(|response| response.status().as_u16())
}

#[cfg(test)]
mod tests {
    use aws_sdk_s3::error::ErrorMetadata;
    use aws_sdk_s3::operation::get_object::GetObjectError;
    use aws_sdk_s3::primitives::SdkBody;

    use super::*;

    #[test]
    fn a_refusal_names_its_status_once() {
        let cause = |message: Option<&str>| {
            let mut answer = ErrorMetadata::builder().code("AccessDenied");
            if let Some(message) = message {
                answer = answer.message(message);
            }
            let raw = HttpResponse::new(403_u16.try_into().unwrap(), SdkBody::empty());
            Cause::of(&SdkError::service_error(GetObjectError::generic(answer.build()), raw)).to_string()
        };
        assert_eq!(cause(None), "S3 denies access (AccessDenied (HTTP 403))");
        assert_eq!(
            cause(Some("Not yours.")),
            "S3 denies access (status 403, AccessDenied: Not yours.)"
        );
    }
}
