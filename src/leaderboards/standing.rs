//! How a Leaderboard stands with EvalAI: what its token is, and what EvalAI's client has read of its challenge. Reads memory alone.

use std::collections::BTreeSet;
use std::sync::Arc;

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;

use super::reach::capitalized;
use crate::runtime::objects::key_of;
use leaderboard_api::text::sentence;
use leaderboard_api::{EvalaiBacklog, EvalaiUse, Leaderboard, names};
use leaderboard_base::object_key::ObjectKey;
use leaderboard_evalai::token::Token;
use leaderboard_evalai::{Hub, InboxTrouble, Labels, Usage};
use leaderboard_policy::ask::Failure;
use leaderboard_policy::leaderboards::view::EvalaiStanding;

/// How it stands, with what was found where the Leaderboard names its token.
pub(super) fn standing(
    hub: &Hub,
    leaderboard: &Leaderboard,
    token: Option<&Result<Arc<Token>, Failure>>,
    now: Timestamp,
) -> EvalaiStanding {
    if leaderboard.spec.evalai.is_none() {
        return EvalaiStanding::NotRequired;
    }
    let token = match token {
        None => return EvalaiStanding::Unchecked(None),
        Some(Err(failure)) => return EvalaiStanding::NoToken(failure.why.clone()),
        Some(Ok(token)) => token,
    };
    let key = &key_of(leaderboard);
    let (labels, why) = hub.labels(key);
    if let Some(why) = hub.token_refused(key) {
        return EvalaiStanding::TokenRefused(why);
    }
    match hub.inbox_trouble(key) {
        Some(InboxTrouble { is_refused, why }) if is_refused || labels.as_ref().is_none_or(Labels::ok) => {
            return EvalaiStanding::QueueUnread { is_refused, why };
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

/// Notes beside published results: a server that is away, columns that stay empty, and a token that ends soon. None if there is none.
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

/// How the requests of its token are used, as the status shows it.
pub(super) fn evalai_use(usage: Usage) -> EvalaiUse {
    let waiting = i32::try_from(usage.waiting).unwrap_or(i32::MAX);
    EvalaiUse {
        requests_last_minute: i32::try_from(usage.used).unwrap_or(i32::MAX),
        requests_per_minute: i32::try_from(usage.limit).unwrap_or(i32::MAX),
        backlog: usage.last_expected.map(|at| EvalaiBacklog {
            waiting,
            last_expected_time: Time(at),
        }),
    }
}

/// Submissions of stored rows that EvalAI shows as cancelled, deleted ones included: retention takes those out of the cache.
pub(super) fn cancelled(hub: &Hub, key: &ObjectKey, leaderboard: &Leaderboard) -> BTreeSet<String> {
    if leaderboard.spec.evalai.is_none() {
        return BTreeSet::new();
    }
    let tracks = leaderboard.status.iter().flat_map(|status| &status.tracks);
    let names = tracks
        .flat_map(|track| &track.standings)
        .map(|row| row.submission.as_str());
    let is_cancelled =
        |name: &&str| names::id_of_submission(name).is_some_and(|id| hub.cancelled_as_of(key, id).is_some());
    names.filter(is_cancelled).map(str::to_owned).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use leaderboard_evalai::Misfit;

    #[test]
    fn columns_that_stay_empty_and_a_token_that_ends_soon_are_shown() {
        let labels = |problems| Labels {
            at: Timestamp::UNIX_EPOCH,
            problems,
            rankings: std::collections::BTreeMap::new(),
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
            "The leaderboard of phase 2 also has Speed, Comfort, which the operator never sends and which stay empty; remove them from its schema, or check evaluation.carla.version. EvalAI's token ends \
             on 2027-01-01."
        );
    }

    #[test]
    fn the_status_shows_how_many_results_wait_for_evalai_and_when_the_last_is_expected() {
        let at = Timestamp::from_second(3600).unwrap();
        let idle = Usage {
            used: 3,
            limit: 54,
            waiting: 0,
            last_expected: None,
        };
        let busy = Usage {
            waiting: 812,
            last_expected: Some(at),
            ..idle
        };
        let backlog = EvalaiBacklog {
            waiting: 812,
            last_expected_time: Time(at),
        };
        assert_eq!(evalai_use(busy).backlog, Some(backlog));
        assert_eq!(evalai_use(idle).backlog, None);
    }
}
