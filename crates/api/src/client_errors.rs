//! Errors as sentences for people: what failed, without a dump of data structures.
//!
//! Called wherever an error of a library reaches a log line, a probe's body or a status. Pure.

use crate::text::chain;

/// An error of the API server's client. The server's own words where it has answered.
pub fn kube(error: &kube::Error) -> String {
    match error {
        kube::Error::Api(status) if status.message.is_empty() => {
            format!("the API server answered {} {}", status.code, status.reason)
        }
        kube::Error::Api(status) => format!("the API server answered {}: {}", status.code, status.message),
        other => chain(other),
    }
}

/// An error of a watch.
pub fn watch(error: &kube::runtime::watcher::Error) -> String {
    use kube::runtime::watcher::Error as Watch;
    match error {
        Watch::InitialListFailed(cause) => format!("the list failed: {}", kube(cause)),
        Watch::WatchStartFailed(cause) => format!("the watch could not start: {}", kube(cause)),
        Watch::WatchError(status) => format!(
            "the API server ended the watch with {}: {}",
            status.code, status.message
        ),
        Watch::WatchFailed(cause) => format!("the watch broke: {}", kube(cause)),
        Watch::NoResourceVersion => "the API server sent no resourceVersion; the kind can't be watched".to_owned(),
    }
}

/// The class of such an error, for a metric's label.
pub fn reason(error: &kube::Error) -> &'static str {
    match error {
        kube::Error::Api(status) => match status.code {
            401 => "unauthorized",
            403 => "forbidden",
            404 => "not_found",
            409 => "conflict",
            410 => "gone",
            422 => "invalid",
            429 => "throttled",
            500..=599 => "server",
            _ => "refused",
        },
        kube::Error::HyperError(_) | kube::Error::Service(_) | kube::Error::ReadEvents(_) => "connection",
        kube::Error::SerdeError(_) => "malformed",
        _ => "client",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use kube::core::Status;

    fn refused(code: u16, message: &str, reason: &str) -> kube::Error {
        kube::Error::Api(Status::failure(message, reason).with_code(code).boxed())
    }

    #[test]
    fn an_answer_of_the_api_server_is_shown_in_its_own_words_once() {
        let error = refused(403, "leases is forbidden", "Forbidden");
        assert_eq!(kube(&error), "the API server answered 403: leases is forbidden");
        assert_eq!(
            kube(&refused(504, "", "Timeout")),
            "the API server answered 504 Timeout"
        );
        let error = kube::runtime::watcher::Error::InitialListFailed(error);
        assert_eq!(
            watch(&error),
            "the list failed: the API server answered 403: leases is forbidden"
        );
    }

    #[test]
    fn causes_follow_their_error_and_are_not_repeated() {
        #[derive(Debug, thiserror::Error)]
        #[error("no route to host")]
        struct Cause;
        #[derive(Debug, thiserror::Error)]
        #[error("{text}")]
        struct Outer {
            text: &'static str,
            source: Cause,
        }
        let outer = |text| Outer { text, source: Cause };
        assert_eq!(chain(&outer("can't connect")), "can't connect: no route to host");
        assert_eq!(
            chain(&outer("can't connect, no route to host")),
            "can't connect, no route to host"
        );
    }

    #[test]
    fn reasons_are_a_closed_set() {
        for (code, expected) in [
            (401, "unauthorized"),
            (403, "forbidden"),
            (409, "conflict"),
            (429, "throttled"),
            (503, "server"),
            (418, "refused"),
        ] {
            assert_eq!(reason(&refused(code, "", "")), expected, "{code}");
        }
    }
}
