//! One call to the API server, with its limit of time and what it was about.

use std::future::Future;
use std::time::Duration;

use kube::core::Status;
use leaderboard_api::client_errors;

/// Time any one call may take.
pub const CALL_TIMEOUT: Duration = Duration::from_secs(20);

/// Why a call failed.
#[derive(thiserror::Error, Debug)]
pub enum CallError {
    #[error("{what} of {object} failed: {}", client_errors::kube(source))]
    Refused {
        what: &'static str,
        object: String,
        source: Box<kube::Error>,
    },
    #[error("{what} of {object}: the API server did not answer within {} s", CALL_TIMEOUT.as_secs())]
    Silent { what: &'static str, object: String },
}

impl CallError {
    /// What the API server has answered, if it has.
    pub fn status(&self) -> Option<&Status> {
        match self {
            Self::Refused { source, .. } => match source.as_ref() {
                kube::Error::Api(status) => Some(status),
                _ => None,
            },
            Self::Silent { .. } => None,
        }
    }

    /// Why it failed, without what it was about.
    pub fn cause(&self) -> String {
        match self {
            Self::Refused { source, .. } => client_errors::kube(source),
            Self::Silent { .. } => format!("the API server did not answer within {} s", CALL_TIMEOUT.as_secs()),
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

    /// One word for metrics.
    pub fn label(&self) -> &'static str {
        match self {
            Self::Refused { .. } => "kubernetes",
            Self::Silent { .. } => "timeout",
        }
    }
}

/// Makes a call. `what` and `object` are for the message.
///
/// # Errors
/// If the API server refuses it, cannot be reached, or does not answer in time.
pub async fn call<T>(
    what: &'static str,
    object: &str,
    call: impl Future<Output = Result<T, kube::Error>>,
) -> Result<T, CallError> {
    match tokio::time::timeout(CALL_TIMEOUT, call).await {
        Ok(Ok(answer)) => Ok(answer),
        Ok(Err(source)) => Err(CallError::Refused {
            what,
            object: object.to_owned(),
            source: Box::new(source),
        }),
        Err(_) => Err(CallError::Silent {
            what,
            object: object.to_owned(),
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn a_failure_says_what_was_called_and_why() {
        let refused = |code| async move {
            Err::<(), _>(kube::Error::Api(
                Status::failure("No.", "Reason").with_code(code).boxed(),
            ))
        };
        let error = call("the status", "one", refused(404)).await.unwrap_err();
        assert!(error.is_gone() && !error.is_conflict() && error.label() == "kubernetes");
        assert!(error.to_string().starts_with("the status of one failed: "), "{error}");
        assert!(call("the status", "one", refused(409)).await.unwrap_err().is_conflict());
        let error = call("the status", "one", std::future::pending::<Result<(), kube::Error>>())
            .await
            .unwrap_err();
        assert_eq!(
            error.to_string(),
            "the status of one: the API server did not answer within 20 s"
        );
        assert_eq!((error.status().is_none(), error.label()), (true, "timeout"));
    }
}
