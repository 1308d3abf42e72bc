//! One call to the API server, with its limit of time and what it was about.

use std::future::Future;
use std::time::Duration;

use kube::core::Status;
use leaderboard_api::client_errors;

/// Time any one call may take.
const CALL_TIMEOUT: Duration = Duration::from_secs(20);

/// Why a call failed.
#[derive(thiserror::Error, Debug)]
pub enum CallError {
    #[error("{what} of {object} failed: {}", client_errors::kube(source))]
    Refused {
        what: &'static str,
        object: String,
        source: Box<kube::Error>,
    },
    #[error("{what} of {object}: {}", no_answer(limit))]
    Silent {
        what: &'static str,
        object: String,
        limit: Duration,
    },
}

impl CallError {
    /// Answer of the API server, if it has given one.
    pub fn status(&self) -> Option<&Status> {
        match self {
            Self::Refused { source, .. } => match source.as_ref() {
                kube::Error::Api(status) => Some(status),
                _ => None,
            },
            Self::Silent { .. } => None,
        }
    }

    /// The API server's answer, if it is no until somebody changes something: no right, a quota, or a webhook or a policy of admission.
    /// A conflict and too many requests are no refusal.
    pub fn refusal(&self) -> Option<&Status> {
        let is_refusal = |code: u16| (400..500).contains(&code) && ![408, 409, 429].contains(&code);
        self.status().filter(|status| is_refusal(status.code))
    }

    /// Why it failed, without what it was about.
    pub fn cause(&self) -> String {
        match self {
            Self::Refused { source, .. } => client_errors::kube(source),
            Self::Silent { limit, .. } => no_answer(limit),
        }
    }

    /// There is no such object.
    pub fn is_gone(&self) -> bool {
        self.status().map(|status| status.code) == Some(404)
    }

    /// The object was changed meanwhile, or is there already.
    pub fn is_conflict(&self) -> bool {
        self.status().map(|status| status.code) == Some(409)
    }

    /// The class of the cause, for a metric's label.
    pub fn reason(&self) -> &'static str {
        match self {
            Self::Refused { source, .. } => client_errors::reason(source),
            Self::Silent { .. } => "timeout",
        }
    }
}

/// Makes a call. `what` and `object` are for the message.
///
/// # Errors
/// If the API server refuses it, cannot be reached, or does not answer in time.
pub fn call<T>(
    what: &'static str,
    object: &str,
    call: impl Future<Output = Result<T, kube::Error>>,
) -> impl Future<Output = Result<T, CallError>> {
    call_within(CALL_TIMEOUT, what, object, call)
}

/// Makes a call with a limit of time of its own.
///
/// # Errors
/// If the API server refuses it, cannot be reached, or does not answer in time.
pub async fn call_within<T>(
    limit: Duration,
    what: &'static str,
    object: &str,
    call: impl Future<Output = Result<T, kube::Error>>,
) -> Result<T, CallError> {
    match tokio::time::timeout(limit, call).await {
        Ok(Ok(answer)) => Ok(answer),
        Ok(Err(source)) => Err(CallError::Refused {
            what,
            object: object.to_owned(),
            source: Box::new(source),
        }),
        Err(_) => Err(CallError::Silent {
            what,
            object: object.to_owned(),
            limit,
        }),
    }
}

fn no_answer(limit: &Duration) -> String {
    format!("the API server did not answer within {} s", limit.as_secs_f32().ceil())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn what_a_person_has_to_change_is_a_refusal() {
        for (code, expected) in [
            (400, true),
            (403, true),
            (422, true),
            (409, false),
            (429, false),
            (500, false),
        ] {
            let status = Status::failure("No.", "Reason").with_code(code).boxed();
            let refused = async { Err::<(), _>(kube::Error::Api(status)) };
            let error = call("the status", "one", refused).await.unwrap_err();
            assert_eq!(error.refusal().is_some(), expected, "{code}");
        }
    }

    #[tokio::test(start_paused = true)]
    async fn a_failure_shows_what_was_called_and_why() {
        let refused = |code| async move {
            Err::<(), _>(kube::Error::Api(
                Status::failure("No.", "Reason").with_code(code).boxed(),
            ))
        };
        let error = call("the status", "one", refused(404)).await.unwrap_err();
        assert!(error.is_gone() && !error.is_conflict() && error.reason() == "not_found");
        assert_eq!(
            error.to_string(),
            "the status of one failed: the API server answered 404: No."
        );
        assert!(call("the status", "one", refused(409)).await.unwrap_err().is_conflict());
        let error = call("the status", "one", std::future::pending::<Result<(), kube::Error>>())
            .await
            .unwrap_err();
        assert_eq!(
            error.to_string(),
            "the status of one: the API server did not answer within 20 s"
        );
        assert_eq!((error.status().is_none(), error.reason()), (true, "timeout"));
    }
}
