//! Meaning of a failed AWS call: whether a person has to act, and a sentence for people.
//!
//! Called by everything that talks to AWS. Knows no service: error codes and HTTP statuses only.

use std::error::Error;

use aws_sdk_sqs::config::http::HttpResponse;
use aws_sdk_sqs::error::{ProvideErrorMetadata, SdkError};

/// The kinds of failure that callers treat differently.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Fault {
    /// Credentials are missing, expired or not allowed to do this: a person has to act.
    Denied,
    /// The queue or table does not exist: a person has to act.
    Missing,
    /// Too many requests: the same one succeeds later.
    Throttled,
    /// No answer, or an error of the service's own: the same one may succeed later.
    Unavailable,
    /// A condition of the request did not hold.
    Conflict,
    /// The service will refuse this request each time.
    Refused,
}

impl Fault {
    /// True if the same request may succeed later by itself.
    pub fn is_passing(self) -> bool {
        matches!(self, Self::Throttled | Self::Unavailable | Self::Conflict)
    }

    /// The value of a metric's label.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Denied => "denied",
            Self::Missing => "missing",
            Self::Throttled => "throttled",
            Self::Unavailable => "unavailable",
            Self::Conflict => "conflict",
            Self::Refused => "refused",
        }
    }
}

/// The kind of a failed call.
pub fn of<E>(error: &SdkError<E, HttpResponse>) -> Fault
where
    E: ProvideErrorMetadata + Error + 'static,
{
    match error {
        SdkError::ServiceError(answer) => {
            of_answer(answer.err().code().unwrap_or_default(), answer.raw().status().as_u16())
        }
        // Credentials that can't be had and connections that break are the same kind of failure to the SDK.
        SdkError::DispatchFailure(_) if sentence(error).contains("credential") => Fault::Denied,
        SdkError::ConstructionFailure(_) => Fault::Refused,
        _ => Fault::Unavailable,
    }
}

/// The kind by error code and HTTP status, as AWS and its stand-ins use them.
fn of_answer(code: &str, status: u16) -> Fault {
    // Query-compatible services put the old name behind a prefix.
    let code = code.rsplit('.').next().unwrap_or(code);
    let code = code.rsplit('#').next().unwrap_or(code);
    match code {
        "AccessDenied"
        | "AccessDeniedException"
        | "KmsAccessDenied"
        | "InvalidSecurity"
        | "ExpiredToken"
        | "ExpiredTokenException"
        | "InvalidClientTokenId"
        | "UnrecognizedClientException"
        | "SignatureDoesNotMatch"
        | "InvalidSignatureException"
        | "MissingAuthenticationToken"
        | "MissingAuthenticationTokenException"
        | "InvalidAccessKeyId"
        | "OptInRequired"
        | "UnauthorizedOperation" => Fault::Denied,
        "NonExistentQueue"
        | "QueueDoesNotExist"
        | "InvalidAddress"
        | "ResourceNotFoundException"
        | "TableNotFoundException" => Fault::Missing,
        "Throttling"
        | "ThrottlingException"
        | "ThrottledException"
        | "RequestThrottled"
        | "RequestLimitExceeded"
        | "ProvisionedThroughputExceededException"
        | "OverLimit"
        | "KmsThrottled"
        | "TooManyRequestsException"
        | "LimitExceededException"
        | "SlowDown" => Fault::Throttled,
        "ConditionalCheckFailedException" => Fault::Conflict,
        "TransactionConflictException" | "ResourceInUseException" | "RequestTimeout" | "InternalError" => {
            Fault::Unavailable
        }
        _ => match status {
            401 | 403 => Fault::Denied,
            429 => Fault::Throttled,
            408 | 500.. => Fault::Unavailable,
            _ => Fault::Refused,
        },
    }
}

/// The failure as one line for people: the service's code and message, or what kept the request from being answered.
pub fn sentence<E>(error: &SdkError<E, HttpResponse>) -> String
where
    E: ProvideErrorMetadata + Error + 'static,
{
    if let SdkError::ServiceError(answer) = error {
        let code = answer.err().code().unwrap_or("unknown error");
        return match answer.err().message().map(str::trim).filter(|text| !text.is_empty()) {
            Some(text) => format!("{code}: {text}"),
            None => format!("{code} (HTTP {})", answer.raw().status().as_u16()),
        };
    }
    leaderboard_api::text::chain(error)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_kind_follows_from_code_and_status() {
        for (code, status, want) in [
            ("AccessDenied", 403, Fault::Denied),
            ("AWS.SimpleQueueService.NonExistentQueue", 400, Fault::Missing),
            ("QueueDoesNotExist", 400, Fault::Missing),
            (
                "com.amazonaws.dynamodb.v20120810#ResourceNotFoundException",
                400,
                Fault::Missing,
            ),
            ("ProvisionedThroughputExceededException", 400, Fault::Throttled),
            ("ConditionalCheckFailedException", 400, Fault::Conflict),
            ("ValidationException", 400, Fault::Refused),
            ("", 403, Fault::Denied),
            ("", 429, Fault::Throttled),
            ("", 503, Fault::Unavailable),
            ("Whatever", 400, Fault::Refused),
        ] {
            assert_eq!(of_answer(code, status), want, "{code} {status}");
        }
    }
}
