//! Why a command could not be carried out: one line each, with the next step.
//!
//! Called by `cluster` and `mod`.

use std::error::Error as StdError;

use kube::client::AuthError;
use kube::config::KubeconfigError;
use kube::runtime::watcher;

use super::text::clean;
use leaderboard_api::client_errors as text;

/// Rights, and who has them, are in the plugin's documentation.
const RIGHTS: &str = "Ask the host for the rights that docs/plugin.md lists";

/// Why a command could not be carried out.
#[derive(thiserror::Error, Debug)]
pub enum Error {
    /// No cluster is known.
    #[error(
        "no cluster is configured: {0}. Set KUBECONFIG, or name a file with --kubeconfig and a context with --context"
    )]
    Config(String),
    /// The person is not known to the cluster.
    #[error(
        "the cluster does not let you in: {0}. Log in as for kubectl, and see whether `kubectl get submissions` works"
    )]
    Credentials(String),
    /// The person lacks a right.
    #[error("you may not do that: {0}. {RIGHTS}")]
    Forbidden(String),
    /// The cluster does not have the kind.
    #[error(
        "this cluster knows no submissions. See whether the context is the right one, and whether the operator's chart is installed"
    )]
    NotInstalled,
    /// No object has the name.
    #[error("there is no submission {name} in namespace {namespace}. {next}")]
    Unknown {
        /// As it was given.
        name: String,
        /// Where it was looked for.
        namespace: String,
        /// Names that may be meant.
        next: String,
    },
    /// The wish does not fit the state; the words hold the next step.
    #[error("{0}")]
    Unfit(String),
    /// The API server does not take the patch.
    #[error("the API server refuses it: {words}. {next}")]
    Refused {
        /// Its words.
        words: String,
        /// What to do instead.
        next: String,
    },
    /// Somebody else kept changing the object.
    #[error("{0} was changed by somebody else again and again. Try again in a moment")]
    Busy(String),
    /// It went while it was being changed or waited for.
    #[error(
        "{0} was deleted in the meantime. Its results stay where they are; apply it again with a higher attempt to take them up"
    )]
    Gone(String),
    /// The API server does not answer.
    #[error("the API server has not answered for {0} s. See whether `kubectl get submissions` works")]
    Silent(u64),
    /// An object does not have the expected form.
    #[error("what the API server sent can't be read: {0}. Use the plugin of the operator's version")]
    Malformed(String),
    /// Everything else.
    #[error("{0}. See whether `kubectl get submissions` works")]
    Api(String),
    /// No threads.
    #[error("no threads can be started: {0}. See the limits of this shell")]
    Runtime(std::io::Error),
}

impl From<kube::Error> for Error {
    fn from(error: kube::Error) -> Self {
        if let Some(why) = credentials(&error) {
            return Self::Credentials(why);
        }
        match &error {
            kube::Error::Api(status) => match status.code {
                401 => Self::Credentials(words(&error)),
                403 => Self::Forbidden(phrase(&status.message)),
                404 => Self::NotInstalled,
                _ => Self::Api(words(&error)),
            },
            kube::Error::SerdeError(_) => Self::Malformed(words(&error)),
            _ => Self::Api(words(&error)),
        }
    }
}

/// The error of a watch, if trying again does not help.
pub(super) fn hopeless(error: watcher::Error) -> Option<Error> {
    match error {
        watcher::Error::InitialListFailed(cause) | watcher::Error::WatchStartFailed(cause) => {
            match Error::from(cause) {
                Error::Api(_) => None,
                other => Some(other),
            }
        }
        _ => None,
    }
}

/// An error of the client in one line, to be followed by the next step.
pub(super) fn words(error: &kube::Error) -> String {
    phrase(&text::kube(error))
}

/// Why no cluster is found. The text of a parser may show a part of the file, and with it perhaps a token.
pub(super) fn of_kubeconfig(error: &(dyn StdError + 'static)) -> Error {
    let mut next = Some(error);
    while let Some(cause) = next {
        if let Some(KubeconfigError::Parse(_)) = cause.downcast_ref() {
            return Error::Config("the kubeconfig is not one, or not YAML".to_owned());
        }
        next = cause.source();
    }
    Error::Config(phrase(&text::chain(error)))
}

/// Somebody else's words in one line and without a full stop.
pub(super) fn phrase(words: &str) -> String {
    let words = clean(words).split_whitespace().collect::<Vec<_>>().join(" ");
    words.trim_end_matches('.').to_owned()
}

/// What the program that a kubeconfig names for credentials has said. kube's own text would show all its output, and with
/// it perhaps a token.
fn credentials(error: &(dyn StdError + 'static)) -> Option<String> {
    let mut next = Some(error);
    while let Some(error) = next {
        if let Some(found) = error.downcast_ref::<AuthError>() {
            return Some(match found {
                AuthError::AuthExecRun { out, .. } => {
                    let said = String::from_utf8_lossy(&out.stderr);
                    let last = said.lines().rfind(|line| !line.trim().is_empty());
                    let why = last.map_or_else(|| out.status.to_string(), str::to_owned);
                    phrase(&format!(
                        "the program that the kubeconfig names for credentials failed: {why}"
                    ))
                }
                // Its text may show what the program has printed.
                AuthError::AuthExecParse(_) => {
                    "the program that the kubeconfig names for credentials printed something else".to_owned()
                }
                other => phrase(&text::chain(other)),
            });
        }
        next = error.source();
    }
    None
}
