//! Why a command could not be carried out: one line each, with the next step.
//!
//! Called by `cluster` and `main`.

use std::error::Error as StdError;
use std::process::ExitStatus;

use kube::client::AuthError;
use kube::config::KubeconfigError;
use kube::runtime::watcher;

use super::text::clean;
use leaderboard_api::text::{causes, chain};
use leaderboard_api::{DOCUMENTS, client_errors as text};

/// Why a command could not be carried out.
#[derive(thiserror::Error, Debug)]
pub enum Error {
    /// No cluster is configured.
    #[error("no cluster is configured: {0}. Set KUBECONFIG, or use --kubeconfig and --context")]
    Config(String),
    /// The cluster does not know the person.
    #[error(
        "the cluster does not accept your credentials: {0}. Log in as for kubectl, and check that `kubectl get submissions` works"
    )]
    Credentials(String),
    /// The person lacks a right.
    #[error(
        "missing right: {0}. Check namespace and context, or ask for the right: {DOCUMENTS}plugin.md#rights has a Role with all that the plugin needs"
    )]
    Forbidden(String),
    /// The cluster does not have the kind.
    #[error(
        "the Submission CRD is not installed in this cluster. Check the context, and that the operator's chart is installed"
    )]
    NotInstalled,
    /// No object has the name.
    #[error("there is no {kind} {name} in namespace {namespace}. {next}")]
    Unknown {
        /// The object's kind, such as `submission`.
        kind: &'static str,
        /// As the person wrote it.
        name: String,
        /// The namespace that was searched.
        namespace: String,
        /// Names that the person may have meant.
        next: String,
    },
    /// The request does not fit the state; the text has the next step.
    #[error("{0}")]
    Unfit(String),
    /// The API server refuses the patch.
    #[error("the API server refused the change: {message}. {next}")]
    Refused {
        /// Its message.
        message: String,
        /// The next step.
        next: String,
    },
    /// Others keep changing the object.
    #[error("conflict: {0} keeps being modified concurrently. Try again in a moment")]
    Conflict(String),
    /// The object was deleted while it was being changed or waited for.
    #[error(
        "{0} was deleted in the meantime. Its results are kept; apply it again with a higher attempt to continue from them"
    )]
    Gone(String),
    /// A file cannot be written.
    #[error("cannot write {0}: {1}. Name another file")]
    File(String, std::io::Error),
    /// A file cannot be read.
    #[error("cannot read {0}: {1}. Name another file")]
    Unread(String, std::io::Error),
    /// The person ended the command.
    #[error("interrupted before the check had ended, so nothing is known. Run it again")]
    Interrupted,
    /// There is no way to the API server, or it does not answer.
    #[error(
        "the API server{} cannot be reached: {why}. Check the network and the context: `kubectl cluster-info` uses the same",
        .server.as_ref().map(|server| format!(" {server}")).unwrap_or_default()
    )]
    Unreachable {
        /// Where it is.
        server: Option<String>,
        /// The cause, such as a refused connection.
        why: String,
    },
    /// An object does not have the expected form.
    #[error("cannot read the API server's answer: {0}. Use the plugin of the operator's version")]
    Malformed(String),
    /// Everything else.
    #[error("{0}. Check that `kubectl get submissions` works")]
    Api(String),
    /// The runtime could not start.
    #[error("cannot start: {0}. Check the limits of this shell")]
    Runtime(std::io::Error),
}

impl From<kube::Error> for Error {
    fn from(error: kube::Error) -> Self {
        if let Some(why) = credentials(&error) {
            return Self::Credentials(why);
        }
        match &error {
            kube::Error::Api(status) => match status.code {
                401 => Self::Credentials(message(&error)),
                403 => Self::Forbidden(phrase(&status.message)),
                404 => Self::NotInstalled,
                _ => Self::Api(message(&error)),
            },
            kube::Error::SerdeError(_) => Self::Malformed(message(&error)),
            kube::Error::HyperError(_) | kube::Error::Service(_) => Self::Unreachable {
                server: None,
                why: message(&error),
            },
            _ => Self::Api(message(&error)),
        }
    }
}

impl Error {
    /// Adds the API server's address to an error that lacks it; leaves other errors as they are.
    #[must_use]
    pub fn naming(self, api_server: &str) -> Self {
        match self {
            Self::Unreachable { why, server: None } => Self::Unreachable {
                server: Some(api_server.to_owned()),
                why,
            },
            other => other,
        }
    }
}

/// The error of a watch, if a retry does not help.
pub(super) fn permanent(error: watcher::Error) -> Option<Error> {
    match error {
        watcher::Error::InitialListFailed(cause) | watcher::Error::WatchStartFailed(cause) => {
            match Error::from(cause) {
                Error::Api(_) | Error::Unreachable { .. } => None,
                other => Some(other),
            }
        }
        _ => None,
    }
}

/// An error of the client in one line, to be followed by the next step.
fn message(error: &kube::Error) -> String {
    phrase(&text::kube(error))
}

/// Why a command cannot do without Leaderboards.
pub(super) fn no_leaderboards() -> Error {
    Error::Forbidden("Leaderboards cannot be read".to_owned())
}

/// Why there is no log. A Pod that is gone by now is no sign of a missing definition.
pub(super) fn of_log(error: kube::Error) -> Error {
    match &error {
        kube::Error::Api(status) if status.is_not_found() => Error::Api(message(&error)),
        _ => error.into(),
    }
}

/// Why a bucket was not read.
pub(super) fn of_bucket(address: &str, why: &str) -> Error {
    Error::Unfit(format!(
        "cannot read {}: {why}. Check that it was stored, and that your AWS credentials may read the bucket",
        clean(address)
    ))
}

/// Why no cluster is configured. The text of a parser may show a part of the file, and with it perhaps a token.
pub(super) fn of_kubeconfig(error: &(dyn StdError + 'static)) -> Error {
    let mut found = causes(error).filter_map(|cause| cause.downcast_ref::<KubeconfigError>());
    if found.any(|cause| matches!(cause, KubeconfigError::Parse(_))) {
        return Error::Config("the kubeconfig is not one, or not YAML".to_owned());
    }
    Error::Config(phrase(&chain(error)))
}

/// A text of another program in one line and without a full stop.
pub(super) fn phrase(text: &str) -> String {
    clean(text).trim_end_matches('.').to_owned()
}

/// Last line that a failed program printed, else how it ended.
pub(super) fn complaint(stderr: &[u8], status: ExitStatus) -> String {
    let stderr = String::from_utf8_lossy(stderr);
    let last = stderr.lines().rfind(|line| !line.trim().is_empty());
    phrase(&last.map_or_else(|| status.to_string(), str::to_owned))
}

/// The error of the program that a kubeconfig names for credentials. kube's own text would show all its output, and with it
/// perhaps a token.
fn credentials(error: &(dyn StdError + 'static)) -> Option<String> {
    let found = causes(error).find_map(|cause| cause.downcast_ref::<AuthError>())?;
    Some(match found {
        AuthError::AuthExecRun { out, .. } => {
            let why = complaint(&out.stderr, out.status);
            format!("the program that the kubeconfig names for credentials failed: {why}")
        }
        // Its text may show what the program printed.
        AuthError::AuthExecParse(_) => {
            "the program that the kubeconfig names for credentials printed something else".to_owned()
        }
        other => phrase(&chain(other)),
    })
}
