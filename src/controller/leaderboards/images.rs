//! Images that several teams lack, as a note of a Leaderboard: its nodes are the likeliest cause. Pure.

use std::collections::BTreeSet;
use std::sync::Arc;

use leaderboard_api::{Leaderboard, Submission, reasons};

/// The note about those of the namespace's Submissions whose images cannot be pulled at present.
pub(super) fn note(leaderboard: &Leaderboard, submissions: &[Arc<Submission>]) -> Option<String> {
    let board = leaderboard.metadata.name.as_deref();
    let is_ours = |one: &&Arc<Submission>| Some(one.spec.leaderboard_name.as_str()) == board;
    let lacking: Vec<_> = submissions
        .iter()
        .filter(is_ours)
        .filter(|one| lacks_image(one))
        .collect();
    let teams: BTreeSet<_> = lacking.iter().map(|one| one.team()).collect();
    let first = lacking.iter().filter_map(|one| one.metadata.name.as_deref()).min()?;
    (teams.len() > 1).then(|| {
        format!(
            "Images of {} teams cannot be pulled, such as that of {first}: look at the rights of the nodes in the registry, and at their \
             way to it.",
            teams.len()
        )
    })
}

fn lacks_image(submission: &Submission) -> bool {
    let status = submission.status.as_ref().filter(|status| !status.has_ended());
    status.is_some_and(|status| status.reason.as_deref() == Some(reasons::IMAGE_PULL))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn a_pull_that_fails_for_two_teams_is_shown_while_they_wait() {
        let board = |name: &str| {
            let spec = json!({
                "tracks": [{"name": "sensors", "codename": "SENSORS"}], "leaderboardVersion": "V2",
                "contents": {"image": "c"}, "simulator": {"image": "s"}, "storage": {"bucket": "b"},
            });
            Leaderboard::new(name, serde_json::from_value(spec).unwrap())
        };
        let submission = |name: &str, team: &str, reason: &str, is_over: bool| {
            let spec = json!({"leaderboardName": "lb", "image": "i", "track": "sensors", "team": {"id": team}});
            let mut submission = Submission::new(name, serde_json::from_value(spec).unwrap());
            let finished = json!({"type": "Finished", "status": if is_over { "True" } else { "False" },
                                  "lastTransitionTime": "2026-01-01T00:00:00Z"});
            let status = json!({"attempt": 1, "reason": reason, "conditions": [finished]});
            submission.status = serde_json::from_value(status).unwrap();
            Arc::new(submission)
        };
        let lacks = |name: &str, team: &str| submission(name, team, "ImagePull", false);
        let shown = |all: &[Arc<Submission>]| note(&board("lb"), all);
        let both = [lacks("s-2", "b"), lacks("s-1", "a"), lacks("s-3", "b")];
        let expected = "Images of 2 teams cannot be pulled, such as that of s-1: look at the rights of the nodes in the registry, and \
                        at their way to it.";
        assert_eq!(shown(&both).as_deref(), Some(expected));
        assert_eq!(note(&board("other"), &both), None);
        for other in [
            lacks("s-2", "a"),
            submission("s-2", "b", "Preparing", false),
            submission("s-2", "b", "ImagePull", true),
        ] {
            assert_eq!(shown(&[lacks("s-1", "a"), other]), None);
        }
    }
}
