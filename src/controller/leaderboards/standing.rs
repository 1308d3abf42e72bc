//! How a Leaderboard stands with EvalAI: what its token is, and what EvalAI's client has read of its challenge. Reads memory alone.

use std::sync::Arc;

use jiff::Timestamp;

use super::reach::capitalized;
use crate::controller::objects::key_of;
use crate::services::evalai::{Hub, InboxTrouble, Labels};
use crate::services::token::Token;
use leaderboard_api::Leaderboard;
use leaderboard_api::text::sentence;

/// How a Leaderboard stands with EvalAI.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum EvalaiStanding {
    NotRequired,
    NoToken(String),
    TokenRefused(String),
    /// Its queue in EvalAI is not read.
    QueueUnread(InboxTrouble),
    /// Its phases or labels do not fit the challenge.
    Misfit(String),
    /// Not checked yet, or EvalAI does not answer.
    Unchecked(Option<String>),
    Fits {
        /// Something to be shown although it works, such as a token that ends soon.
        note: Option<String>,
    },
}

/// How it stands, with what was found where the Leaderboard names its token.
pub(super) fn standing(
    hub: &Hub,
    leaderboard: &Leaderboard,
    token: Option<&Result<Arc<Token>, String>>,
    now: Timestamp,
) -> EvalaiStanding {
    if leaderboard.spec.evalai.is_none() {
        return EvalaiStanding::NotRequired;
    }
    let token = match token {
        None => return EvalaiStanding::Unchecked(None),
        Some(Err(why)) => return EvalaiStanding::NoToken(why.clone()),
        Some(Ok(token)) => token,
    };
    let key = &key_of(leaderboard);
    let (labels, why) = hub.labels(key);
    if let Some(why) = hub.token_refused(key) {
        return EvalaiStanding::TokenRefused(why);
    }
    match hub.inbox_trouble(key) {
        Some(trouble) if trouble.is_refused => return EvalaiStanding::QueueUnread(trouble),
        Some(trouble) if labels.as_ref().is_none_or(Labels::ok) => {
            return EvalaiStanding::QueueUnread(trouble);
        }
        _ => {}
    }
    let silence = hub.silence(key).map(|(since, why)| silent(since, &why));
    match labels {
        None => EvalaiStanding::Unchecked(silence.or(why)),
        Some(labels) if !labels.ok() => {
            let problems: Vec<String> = labels.problems.iter().map(ToString::to_string).collect();
            EvalaiStanding::Misfit(problems.join("; "))
        }
        Some(labels) => EvalaiStanding::Fits {
            note: note(silence, &labels, ends_soon(token, now)),
        },
    }
}

/// Says that EvalAI does not answer. A run needs it only to start and to be published, so that its Leaderboard stays ready.
fn silent(since: Timestamp, why: &str) -> String {
    format!(
        "EvalAI has not answered since {}: {} Runs go on, and what EvalAI is to get waits until it answers; new submissions start then.",
        since.strftime("%Y-%m-%d %H:%M:%S UTC"),
        sentence(why)
    )
}

/// Notes that are worth a line although results can be published: a server that is away, columns that stay empty, and a token that ends soon.
fn note(silence: Option<String>, labels: &Labels, of_token: Option<String>) -> Option<String> {
    let of_labels = labels.problems.iter().map(|problem| capitalized(&problem.to_string()));
    let notes: Vec<String> = silence.into_iter().chain(of_labels).chain(of_token).collect();
    (!notes.is_empty()).then(|| notes.join(" "))
}

fn ends_soon(token: &Token, now: Timestamp) -> Option<String> {
    let end = token.expires().filter(|_| token.ends_soon(now))?;
    let when = end.strftime("%Y-%m-%d");
    Some(if end <= now {
        format!("EvalAI's token has ended on {when}; put a new one where evalai.token says.")
    } else {
        format!("EvalAI's token ends on {when}; put a new one where evalai.token says before.")
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::services::evalai::Misfit;

    #[test]
    fn columns_that_stay_empty_and_a_token_that_ends_soon_are_shown() {
        let labels = |problems| Labels {
            at: Timestamp::UNIX_EPOCH,
            problems,
        };
        let ends = || Some("EvalAI's token ends on 2027-01-01.".to_owned());
        assert_eq!(note(None, &labels(vec![]), None), None);
        assert_eq!(note(None, &labels(vec![]), ends()), ends());
        let away = silent(Timestamp::UNIX_EPOCH, "EvalAI could not be reached");
        assert!(
            away.starts_with(
                "EvalAI has not answered since 1970-01-01 00:00:00 UTC: EvalAI could not be reached. Runs"
            )
        );
        assert_eq!(note(Some(away.clone()), &labels(vec![]), None), Some(away));
        let unsent = Misfit::Unsent {
            phase: 2,
            labels: vec!["Speed".into(), "Comfort".into()],
        };
        let said = note(None, &labels(vec![unsent]), ends()).unwrap();
        assert_eq!(
            said,
            "The leaderboard of phase 2 also has Speed, Comfort, which the operator never sends and which stay empty; remove them from its schema, or check spec.leaderboardVersion. EvalAI's token ends \
             on 2027-01-01."
        );
    }
}
