//! Mistakes in Submissions.

use serde_json::{Value, json};

use super::super::objects::Kind::Submission;
use super::{Case, Step, create, update};

pub(super) fn all() -> Vec<Case> {
    [immutable(), checks(), attempts()].into_iter().flatten().collect()
}

fn immutable() -> Vec<Case> {
    let ids = |submission: i64| json!({"challenge": 1, "phase": 7, "submission": submission});
    let theirs = json!({"track": null, "image": null, "evalai": ids(42)});
    let first = json!({"priority": 5});
    let file = |digit: &str| json!({"sha256": digit.repeat(64), "size": 12});
    let of_file = json!({"image": null, "input": file("a")});
    let keeps = |message, from: &Value, bad: &Value| update(Submission, message, from, bad, &first);
    vec![
        keeps(
            "leaderboardName is immutable",
            &json!({}),
            &json!({"leaderboardName": "other"}),
        ),
        keeps("image is immutable", &json!({}), &json!({"image": "agent:2"})),
        keeps("image is immutable", &theirs, &json!({"image": "agent:2"})),
        keeps("evalai is immutable", &theirs, &json!({"evalai": ids(43)})),
        keeps("track is immutable", &json!({}), &json!({"track": "map"})),
        create(
            Submission,
            "not both and not neither",
            &json!({}),
            &json!({"track": null}),
        ),
        create(
            Submission,
            "not both and not neither",
            &theirs,
            &json!({"track": "sensors"}),
        ),
        keeps("input is immutable", &of_file, &json!({"input": file("b")})),
        create(
            Submission,
            "leave input out beside image or evalai",
            &of_file,
            &json!({"image": "agent:1"}),
        ),
        create(
            Submission,
            "leave input out beside image or evalai",
            &theirs,
            &json!({"input": file("a")}),
        ),
        create(
            Submission,
            "without evalai needs an image",
            &json!({}),
            &json!({"image": null}),
        ),
        create(
            Submission,
            "team needs an id or a name",
            &json!({"team": {"name": "a"}}),
            &json!({"team": {"name": null}}),
        ),
    ]
}

fn checks() -> Vec<Case> {
    let check = json!({"check": true});
    let named = |name: &str, spec: &Value| json!({"metadata": {"name": name}, "spec": spec});
    let evalai = json!({"track": null, "evalai": {"challenge": 1, "phase": 7, "submission": 42}});
    let create = |message, good, bad| Case {
        kind: Submission,
        message,
        step: Step::Create { good, bad },
    };
    vec![
        create(
            "the name of a check begins with check-",
            named("check-a", &check),
            named("a", &check),
        ),
        create(
            "a check has neither evalai nor team",
            named("check-a", &check),
            named("check-a", &evalai),
        ),
        update(
            Submission,
            "a check has neither evalai nor team",
            &check,
            &json!({"team": {"id": "7"}}),
            &json!({"priority": 5}),
        ),
        update(
            Submission,
            "check is immutable",
            &json!({}),
            &check,
            &json!({"priority": 5}),
        ),
    ]
}

fn attempts() -> Vec<Case> {
    let second = json!({"attempt": 2, "cancel": false});
    let ended = |reason, message, bad: &Value, good: &Value| {
        let mut case = update(Submission, message, &json!({}), bad, good);
        if let Step::Update { end, .. } = &mut case.step {
            *end = Some(reason);
        }
        case
    };
    let again = "a finished submission is not resumed";
    vec![
        update(
            Submission,
            "attempt may only grow",
            &json!({"attempt": 2}),
            &json!({"attempt": 1}),
            &json!({"attempt": 4}),
        ),
        update(
            Submission,
            "to resume, set cancel to false",
            &json!({"cancel": true}),
            &json!({"attempt": 2}),
            &second,
        ),
        update(
            Submission,
            "undone only by a higher attempt",
            &json!({"cancel": true}),
            &json!({"cancel": false}),
            &second,
        ),
        ended("Finished", again, &json!({"attempt": 2}), &json!({"priority": 5})),
        ended(
            "AgentCrashed",
            "to resume, set cancel to false",
            &json!({"attempt": 2, "cancel": true}),
            &second,
        ),
    ]
}
