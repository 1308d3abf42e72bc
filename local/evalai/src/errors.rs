//! Every error that EvalAI was observed to answer, to the letter: status code, shape and text.
//!
//! The handlers answer from this table and the operator's client tests read it, so that both are about the same server.
//! `{}` in a text stands for a value and is filled in order. Misspelt and run-together words are EvalAI's own.

use serde_json::{Map, Value, json};

/// Where the text stands in the body.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shape {
    /// `{"error": text}`
    Error,
    /// `{"detail": text}`
    Detail,
    /// `{field: [text]}`
    Field(&'static str),
    /// The text is the whole JSON body.
    Json,
    /// The text is a whole HTML page.
    Html,
}

/// One error of the server.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ErrorText {
    /// The constant's name, for the message of a test that fails.
    pub name: &'static str,
    /// HTTP status code.
    pub status: u16,
    /// Where the text stands in the body.
    pub shape: Shape,
    /// The text, with `{}` for each value.
    pub text: &'static str,
}

impl ErrorText {
    /// The text with its values in place, in order; a missing value leaves its `{}`.
    pub fn message(&self, values: &[&str]) -> String {
        let mut parts = self.text.split("{}");
        let mut out = parts.next().unwrap_or_default().to_owned();
        let mut values = values.iter();
        for part in parts {
            out.push_str(values.next().unwrap_or(&"{}"));
            out.push_str(part);
        }
        out
    }

    /// The whole body as the server sends it.
    pub fn body(&self, values: &[&str]) -> String {
        let text = self.message(values);
        match self.shape {
            Shape::Error => json!({ "error": text }).to_string(),
            Shape::Detail => json!({ "detail": text }).to_string(),
            Shape::Field(field) => Value::Object(Map::from_iter([(field.to_owned(), json!([text]))])).to_string(),
            Shape::Json | Shape::Html => text,
        }
    }

    /// The value of the `Content-Type` header.
    pub fn content_type(&self) -> &'static str {
        if self.shape == Shape::Html {
            "text/html; charset=utf-8"
        } else {
            "application/json"
        }
    }
}

macro_rules! error_texts {
    ($($(#[$doc:meta])* $name:ident = $status:literal $shape:expr, $text:expr;)*) => {
        $($(#[$doc])* pub const $name: ErrorText =
            ErrorText { name: stringify!($name), status: $status, shape: $shape, text: $text };)*

        /// The whole table.
        pub fn all() -> &'static [ErrorText] {
            const ALL: &[ErrorText] = &[$($name),*];
            ALL
        }
    };
}

error_texts! {
    /// No `Authorization` header, or a scheme the server does not know.
    NO_CREDENTIALS = 401 Shape::Detail, "Authentication credentials were not provided.";
    /// `Token <key>` with an unknown key.
    INVALID_KEY = 401 Shape::Detail, "Invalid token";
    /// `Token <key>` of a user who is switched off.
    INACTIVE_USER = 401 Shape::Detail, "User inactive or deleted";
    /// `Token <key>` past its 365 days.
    EXPIRED_KEY = 401 Shape::Detail, "Token has expired";
    /// `Bearer` with an access token: only refresh tokens are taken.
    ACCESS_TOKEN = 401 Shape::Json, r#"{"detail":"Given token not valid for any token type","code":"token_not_valid","messages":[{"token_class":"RefreshToken","token_type":"refresh","message":"Token has wrong type"}]}"#;
    /// `Bearer` with an unknown or expired token.
    BAD_BEARER = 401 Shape::Json, r#"{"detail":"Given token not valid for any token type","code":"token_not_valid","messages":[{"token_class":"RefreshToken","token_type":"refresh","message":"Token is invalid or expired"}]}"#;
    /// `Bearer` with a token that its user has renewed since.
    BLACKLISTED = 401 Shape::Json, r#"{"detail":"Given token not valid for any token type","code":"token_not_valid","messages":[{"token_class":"RefreshToken","token_type":"refresh","message":"Token is blacklisted"}]}"#;
    /// `Bearer` without a token, or with more than one.
    BAD_AUTHORIZATION_HEADER = 401 Shape::Json, r#"{"detail":"Authorization header must contain two space-delimited values","code":"bad_authorization_header"}"#;
    /// `Token` without a key.
    KEY_MISSING = 401 Shape::Detail, "Invalid token header. No credentials provided.";
    /// `Token` with more than one key.
    KEY_WITH_SPACES = 401 Shape::Detail, "Invalid token header. Token string should not contain spaces.";
    /// The user has not confirmed the e-mail address.
    UNVERIFIED_EMAIL = 403 Shape::Detail, "Please verify your email!";
    /// More requests in a minute than the throttle lets through; comes with `Retry-After`.
    THROTTLED = 429 Shape::Detail, "Request was throttled. Expected available in {} {}.";
    /// The body is not JSON.
    JSON_PARSE = 400 Shape::Detail, "JSON parse error - {}";
    /// The body is not in the form of its content type.
    MULTIPART_PARSE = 400 Shape::Detail, "Multipart form parse error - {}";
    /// The path exists, with other methods.
    METHOD_NOT_ALLOWED = 405 Shape::Detail, r#"Method "{}" not allowed."#;
    /// A body that is neither JSON nor a form.
    UNSUPPORTED_MEDIA_TYPE = 415 Shape::Detail, r#"Unsupported media type "{}" in request."#;
    /// A body over the 200 MiB of EvalAI's nginx.
    BODY_TOO_LARGE = 413 Shape::Html, "<html>\r\n<head><title>413 Request Entity Too Large</title></head>\r\n<body>\r\n<center><h1>413 Request Entity Too Large</h1></center>\r\n<hr><center>nginx</center>\r\n</body>\r\n</html>\r\n";
    /// An unhandled exception: always this page, never JSON.
    SERVER_ERROR = 500 Shape::Html, "<!DOCTYPE html>\n<html>\n<head>\n\t<title>EvalAI- Home Page</title>\n</head>\n<body>\n<h1>Error 500 - Internal Server Error</h1>\n</body>\n</html>\n";
    /// A path the server does not know.
    PAGE_NOT_FOUND = 404 Shape::Html, "<!DOCTYPE html>\n<html>\n<head>\n\t<title>EvalAI- Home Page</title>\n</head>\n<body>\n<h1>Error 404 - Page Not Found</h1>\n</body>\n</html>\n";

    /// An unknown submission named in a body (`None` when the body names none).
    SUBMISSION_NOT_FOUND = 404 Shape::Detail, "Submission {} does not exist";
    /// An unknown submission named in a path.
    NO_SUCH_SUBMISSION = 404 Shape::Error, "Submission {} does not exist";
    /// Neither the submitter nor a host.
    SUBMISSION_FORBIDDEN = 401 Shape::Error, "Sorry, you are not authorized to access this submission.";
    /// `update_started_at` of an unknown submission.
    STARTED_AT_UNKNOWN = 403 Shape::Error, "Submission does not exist";
    /// Not a host of the challenge, or no such challenge.
    NOT_HOST = 400 Shape::Error, "Sorry, you are not authorized to make this request!";
    /// `submission_count_by_status` by somebody else than a host.
    NOT_HOST_OF_PHASE = 401 Shape::Error, "Sorry, you are not authorized to make this request";
    /// `challenges/{c}/phases/` by somebody else than a host.
    PHASES_FORBIDDEN = 401 Shape::Error, "Sorry, you are not authorized to access these challenge phases.";
    /// A status the endpoint refuses.
    INVALID_STATUS = 400 Shape::Error, "Sorry, submission status is invalid";
    /// A status that is none of the model's.
    INVALID_CHOICE = 400 Shape::Field("status"), r#""{}" is not a valid choice."#;

    /// `result` is no string that holds JSON.
    RESULT_INVALID = 400 Shape::Error, "`result` key contains invalid data with error {}.Please try again with correct format.";
    /// No such split in that phase (sic).
    SPLIT_NOT_FOUND = 400 Shape::Error, "Challenge Phase Split does not exist with phase_id: {} andsplit codename: {}";
    /// Metrics that the leaderboard does not have: the wording is inverted, these are extra (sic).
    METRICS_UNKNOWN = 400 Shape::Error, "Following metrics are missing in theleaderboard data: {}";
    /// Metrics that the leaderboard does not have, on the endpoint for partial results (sic).
    METRICS_UNKNOWN_PARTIAL = 400 Shape::Error, "Following metrics are missing in theleaderboard data: {} of challenge phase: {}";
    /// Values that are not numbers (sic).
    METRICS_MALFORMED = 400 Shape::Error, "Values for following metrics are not offloat/int: {}";
    /// NaN or an infinity.
    RESULT_NOT_FINITE = 400 Shape::Field("result"), "Value must be valid JSON.";
    /// A database constraint was hurt.
    INTEGRITY = 400 Shape::Error, "Failed to update submission_id {} related metadata";
    /// PATCH of partial results before a first PUT (sic).
    NO_LEADERBOARD_DATA = 400 Shape::Error, "Leaderboard Data does not exist with phase_id: {} andsubmission id: {}";

    /// `PATCH leaderboard_data` of an unknown row.
    ROW_NOT_FOUND = 404 Shape::Error, "Leaderboard data does not exist";
    /// `PATCH leaderboard_data` without the field.
    ROW_BLANK = 400 Shape::Error, "leaderboard_data can't be blank";
    /// `PATCH leaderboard_data` with something that is no JSON.
    ROW_INVALID = 400 Shape::Error, "`leaderboard_data` key contains invalid data with error {}.Please try again with correct format.";
    /// `PATCH leaderboard_data` that lacks labels and has others.
    ROW_MISSING_AND_EXTRA = 400 Shape::Error, "Following metrics {} are missing and following metrics are invalid {} in the leaderboard data";
    /// `PATCH leaderboard_data` that lacks labels.
    ROW_MISSING = 400 Shape::Error, "Following metrics are missing in the leaderboard data: {}";
    /// `PATCH leaderboard_data` with labels the leaderboard does not have.
    ROW_EXTRA = 400 Shape::Error, "Following metrics are invalid in the leaderboard data: {}";

    /// Re-run of a deleted submission.
    RERUN_DELETED = 400 Shape::Error, "Deleted submissions can't be re-run";
    /// Re-run by a participant where the challenge does not allow it.
    RERUN_FORBIDDEN = 403 Shape::Error, "Only challenge hosts or admins are allowed to re-run a submission";
    /// Re-run or resume in a challenge that is over.
    CHALLENGE_INACTIVE = 406 Shape::Error, "Challenge {} is not active";
    /// Resume of a deleted submission.
    RESUME_DELETED = 400 Shape::Error, "Deleted submissions can't be resumed";
    /// Resume of a submission that has not failed.
    RESUME_NOT_FAILED = 400 Shape::Error, "Only failed submissions can be resumed";
    /// Resume by a participant where the challenge does not allow it.
    RESUME_FORBIDDEN = 403 Shape::Error, "Only challenge hosts are allowed to resume a submission";
    /// Resume in a challenge that EvalAI evaluates itself.
    RESUME_NOT_REMOTE = 406 Shape::Error, "Challenge {} is not remote. Resuming is only supported for remote challenges.";
    /// Resume in a challenge that has it switched off.
    RESUME_NOT_ALLOWED = 406 Shape::Error, "Challenge {} does not allow resuming submissions.";

    /// Submission to an unknown challenge.
    SUBMIT_NO_CHALLENGE = 400 Shape::Error, "Challenge does not exist";
    /// Submission to an unknown phase.
    SUBMIT_NO_PHASE = 400 Shape::Error, "Challenge Phase does not exist";
    /// Submission to a challenge that is over.
    SUBMIT_INACTIVE = 406 Shape::Error, "Challenge is not active";
    /// Submission to a phase that is over.
    SUBMIT_PHASE_INACTIVE = 406 Shape::Error, "Sorry, cannot accept submissions since challenge phase is not active";
    /// Submission by a participant to a phase that is not public.
    SUBMIT_PHASE_PRIVATE = 403 Shape::Error, "Sorry, cannot accept submissions since challenge phase is not public";
    /// Submission by somebody without a team.
    SUBMIT_NO_TEAM = 403 Shape::Error, "You haven't participated in the challenge";
    /// Too many of the team's submissions under way in this phase; the long gap is EvalAI's.
    SUBMIT_CONCURRENT = 406 Shape::Error, "You have {} submissions that are being processed.                        Please wait for them to finish and then try again.";
    /// Submission without a file.
    SUBMIT_NO_FILE = 400 Shape::Error, "The file URL is missing!";
    /// Submission of a URL that can't be fetched.
    SUBMIT_BAD_URL = 400 Shape::Error, "The file URL does not exists!";
    /// The uploaded file names no image.
    SUBMIT_BAD_FILE = 400 Shape::Error, "Error {} in submitted_image_uri from submission file";

    /// A status that can't be listed by.
    LIST_STATUS = 400 Shape::Error, "Invalid submission status {}";
    /// A date that can't be read.
    LIST_DATE = 400 Shape::Error, "Invalid datetime format for '{}'";
    /// An unknown challenge where the server raises NotFound.
    CHALLENGE_NOT_FOUND = 404 Shape::Detail, "Challenge {} does not exist";
    /// An unknown phase where the server raises NotFound.
    PHASE_NOT_FOUND = 404 Shape::Detail, "ChallengePhase {} does not exist";
    /// An unknown phase split.
    PHASE_SPLIT_NOT_FOUND = 404 Shape::Detail, "ChallengePhaseSplit {} does not exist";
    /// An unknown dataset split.
    DATASET_SPLIT_NOT_FOUND = 404 Shape::Detail, "DatasetSplit {} does not exist";
    /// A user without a team.
    TEAM_NOT_FOUND = 404 Shape::Detail, "ParticipantTeam {} does not exist";
    /// An unknown challenge where the server answers "not acceptable".
    NO_CHALLENGE = 406 Shape::Error, "Challenge does not exist";
    /// A challenge that is asked for by its key, and is unknown.
    UNKNOWN_CHALLENGE = 406 Shape::Error, "Challenge does not exist!";
    /// An unknown phase of a known challenge.
    NO_PHASE_OF_CHALLENGE = 406 Shape::Error, "Challenge phase {} does not exist for challenge {}";
    /// A leaderboard that is not public.
    LEADERBOARD_PRIVATE = 400 Shape::Error, "Sorry, the leaderboard is not public!";
    /// A page that is not there.
    INVALID_PAGE = 404 Shape::Detail, "Invalid page.";

    /// No challenge has a queue of that name.
    QUEUE_UNKNOWN = 400 Shape::Error, "Challenge with queue name {} does not exist";
    /// No challenge has a queue of that name, at the deletion of a message (sic).
    QUEUE_UNKNOWN_DELETE = 400 Shape::Error, "Challenge with queue name {} does not exists";
    /// The queue belongs to somebody else's challenge.
    QUEUE_FORBIDDEN = 401 Shape::Error, "Sorry, you are not authorized to access this resource";
    /// The challenge of the queue belongs to somebody else.
    QUEUE_CHALLENGE_FORBIDDEN = 401 Shape::Error, "Sorry, you are not authorized to access this challenge.";
    /// An empty receipt handle.
    RECEIPT_HANDLE_EMPTY = 400 Shape::Error, "Please add message receipt handle in the body";
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_json_error_is_json_and_every_name_stands_once() {
        let mut names: Vec<_> = all().iter().map(|error| error.name).collect();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), all().len());
        for error in all().iter().filter(|error| error.shape != Shape::Html) {
            let body = error.body(&["a", "b"]);
            assert!(serde_json::from_str::<Value>(&body).is_ok(), "{}: {body}", error.name);
        }
    }

    #[test]
    fn values_are_filled_in_order() {
        assert_eq!(
            SPLIT_NOT_FOUND.body(&["1", "nope"]),
            r#"{"error":"Challenge Phase Split does not exist with phase_id: 1 andsplit codename: nope"}"#
        );
        assert_eq!(
            INVALID_CHOICE.body(&["bogus"]),
            r#"{"status":["\"bogus\" is not a valid choice."]}"#
        );
        assert_eq!(
            RESULT_NOT_FINITE.body(&[]),
            r#"{"result":["Value must be valid JSON."]}"#
        );
    }
}
