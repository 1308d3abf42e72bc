//! Each error, and what is shown while something is followed: in one line for a program, and on narrow and wide terminals.

use std::fmt::Write as _;

use kube::core::Status;
use serde_json::{Value, json};

use super::golden::{WIDTHS, assert_fits, assert_golden};
use super::{crashed, finished, frame, leaderboard, node_lost, running, submission, waiting};
use crate::board::Observed;
use crate::change::{Request, after_refusal, plan};
use crate::error::Error;
use crate::logs::{begins_again, begins_later, end};
use crate::near;
use crate::output::noted;

/// Compares what is shown with its file.
fn assert_noted(name: &str, messages: &[(&str, String)]) {
    let mut text = String::new();
    for (what, message) in messages {
        writeln!(text, "=== {what}").unwrap();
        let lines = noted(message, None);
        assert_eq!(lines.len(), 1, "a program reads one line: {lines:#?}");
        writeln!(text, "{}", lines[0]).unwrap();
        for width in WIDTHS {
            let lines = noted(message, Some(width));
            assert_fits(name, &lines, width);
            writeln!(text, "--- {width} columns").unwrap();
            for line in lines {
                writeln!(text, "{line}").unwrap();
            }
        }
    }
    assert_golden(name, &text);
}

fn answered(code: u16, reason: &str, message: &str) -> Error {
    kube::Error::Api(Status::failure(message, reason).with_code(code).boxed()).into()
}

fn unknown(name: &str, known: &[&str], elsewhere: &[&str]) -> String {
    let texts = |texts: &[&str]| texts.iter().map(|text| (*text).to_owned()).collect::<Vec<_>>();
    let next = near::next("submissions", name, "carla", &texts(known), &texts(elsewhere));
    let error = Error::Unknown {
        kind: "submission",
        name: name.to_owned(),
        namespace: "carla".to_owned(),
        next,
    };
    error.to_string()
}

#[test]
fn of_a_name_or_a_namespace() {
    let known = ["submission-42", "submission-43", "baseline"];
    assert_noted(
        "error-names",
        &[
            (
                "a wrong namespace",
                unknown("submission-42", &[], &["carla-20", "test"]),
            ),
            ("a typing error", unknown("submision-42", &known, &[])),
            ("half a name", unknown("42", &known, &[])),
            ("nothing like it", unknown("something-else", &known, &[])),
            ("deleted meanwhile", Error::Gone("submission-42".to_owned()).to_string()),
        ],
    );
}

#[test]
fn errors_of_a_cluster_are_printed_as_their_files_show() {
    let refused = "tcp connect error: Connection refused (os error 111)".to_owned();
    let unreachable = |why| Error::Unreachable { server: None, why }.naming("https://10.0.0.1:6443");
    let forbidden = "submissions.leaderboard.carla.org is forbidden: User \"person\" cannot list resource \"submissions\" in API \
                     group \"leaderboard.carla.org\" in the namespace \"carla\"";
    let missing =
        "failed to read kubeconfig from '/home/host/.kube/config': No such file or directory (os error 2)".to_owned();
    assert_noted(
        "error-cluster",
        &[
            ("no kubeconfig", Error::Config(missing).to_string()),
            ("no way there", unreachable(refused).to_string()),
            ("no answer", unreachable("no answer within 30 s".to_owned()).to_string()),
            ("no right", answered(403, "Forbidden", forbidden).to_string()),
            (
                "not logged in",
                answered(401, "Unauthorized", "Unauthorized").to_string(),
            ),
            (
                "another cluster",
                answered(404, "NotFound", "the server could not find it").to_string(),
            ),
            (
                "overloaded",
                answered(503, "ServiceUnavailable", "apiserver is shutting down").to_string(),
            ),
        ],
    );
}

#[test]
fn of_a_request_that_does_not_fit() {
    let board = leaderboard();
    let refused =
        |request, status: &Value| plan(request, &submission(status), Observed::Found(&board), frame()).unwrap_err();
    let rejected = |request| {
        let error = Error::Refused {
            message:
                "submissions.leaderboard.carla.org \"submission-42\" is invalid: spec.attempt: Invalid value: 9999"
                    .to_owned(),
            next: after_refusal(request, &submission(&crashed())),
        };
        error.to_string()
    };
    assert_noted(
        "error-requests",
        &[
            ("cancel of what has ended", refused(Request::Cancel, &crashed())),
            ("resume of what runs", refused(Request::Resume, &running())),
            ("resume of what is new", refused(Request::Resume, &Value::Null)),
            ("resume of what has finished", refused(Request::Resume, &finished())),
            ("resume of what waits", refused(Request::Resume, &waiting())),
            ("restart of what waits", refused(Request::Restart, &waiting())),
            ("a rule of the API server", rejected(Request::Resume)),
            ("the same for a cancel", rejected(Request::Cancel)),
            ("a conflict", Error::Conflict("submission-42".to_owned()).to_string()),
            ("Ctrl-C during a check", Error::Interrupted.to_string()),
        ],
    );
}

#[test]
fn of_a_log_that_is_followed() {
    assert_noted(
        "logs-followed",
        &[
            ("before its Pod runs", begins_later(&submission(&waiting()))),
            (
                "before the operator has seen it",
                begins_later(&submission(&json!(null))),
            ),
            ("a crash", begins_again("agent-2", 1)),
            ("its end", end(&submission(&crashed()))),
            ("an end that is the host's", end(&submission(&node_lost()))),
            ("a good end", end(&submission(&finished()))),
        ],
    );
}
