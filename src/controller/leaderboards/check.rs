//! Which check of a Leaderboard ended last, and what its condition `Checked` shows of it. Pure.

use kube::ResourceExt;

use leaderboard_api::conditions::Truth;
use leaderboard_api::{CheckEnd, CheckResult, LastCheck, Leaderboard, reasons};

/// The check that ended last. One that is noted stays as it was noted, though the Leaderboard may have got ready since.
pub(super) fn last(
    noted: Option<LastCheck>,
    seen: Option<&CheckEnd>,
    fault: Option<&str>,
    generation: Option<i64>,
) -> Option<LastCheck> {
    let is_new = |seen: &&CheckEnd| {
        let is_same = |noted: &LastCheck| noted.submission_name == seen.name || noted.time.0 > seen.time;
        !noted.as_ref().is_some_and(is_same)
    };
    match seen.filter(is_new) {
        Some(seen) => Some(seen.noted(fault, generation.unwrap_or_default())),
        None => noted,
    }
}

/// Whether the Leaderboard was checked as it is.
pub(super) fn condition(leaderboard: &Leaderboard, last: Option<&LastCheck>) -> (Truth, &'static str, String) {
    let command = format!(
        "kubectl leaderboard check {} -n {}",
        leaderboard.name_any(),
        leaderboard.namespace().unwrap_or_default()
    );
    let Some(last) = last else {
        let message =
            format!("No check of this Leaderboard has ended yet. Run `{command}` before participants submit.");
        return (Truth::Unknown, reasons::NEVER_CHECKED, message);
    };
    let (name, reason) = (&last.submission_name, &last.reason);
    let time = last.time.0.strftime("%Y-%m-%d %H:%M:%S UTC");
    if last.result == CheckResult::Failed {
        let meaning = reasons::of(reason).map(|reason| reasons::plain(reason.meaning));
        let message = format!(
            "Check {name} failed at {time} with {reason}: {} Correct this, then run `{command}` again.",
            meaning
                .as_deref()
                .unwrap_or("the operator's version has no text for this reason.")
        );
        return (Truth::False, reasons::CHECK_FAILED, message);
    }
    let present = leaderboard.metadata.generation.unwrap_or_default();
    if present != last.leaderboard_generation {
        let message = format!(
            "Check {name} passed at {time}, but the spec has changed since: it was generation {}, and is {present}. Run \
             `{command}` again.",
            last.leaderboard_generation
        );
        return (Truth::Unknown, reasons::CHECK_OUTDATED, message);
    }
    let message = format!("Check {name} passed at {time}.");
    (Truth::True, reasons::CHECK_PASSED, message)
}

#[cfg(test)]
mod tests {
    use super::*;
    use jiff::Timestamp;
    use serde_json::json;

    fn end(name: &str, second: i64, has_finished: bool) -> CheckEnd {
        CheckEnd {
            time: Timestamp::from_second(second).unwrap(),
            name: name.into(),
            reason: if has_finished { "Finished" } else { "ImagePull" }.into(),
            has_finished,
            generation: Some(3),
        }
    }

    fn leaderboard(generation: i64) -> Leaderboard {
        let spec = json!({"tracks": [{"name": "sensors", "codename": "SENSORS"}], "leaderboardVersion": "V2",
                          "contents": {"image": "c"}, "simulator": {"image": "s"}, "storage": {"bucket": "b"}});
        let mut object = Leaderboard::new("lb", serde_json::from_value(spec).unwrap());
        object.metadata.namespace = Some("ns".into());
        object.metadata.generation = Some(generation);
        object
    }

    #[test]
    fn the_newest_check_is_noted_once() {
        let noted = |name: &str, second, has_finished| end(name, second, has_finished).noted(None, 3);
        let first = noted("check-lb-1", 10, true);
        assert_eq!(last(None, None, None, Some(3)), None);
        let seen = end("check-lb-1", 10, true);
        assert_eq!(last(None, Some(&seen), None, Some(3)), Some(first.clone()));
        // Noted as passed, and the Leaderboard is not Ready any more.
        let kept = last(Some(first.clone()), Some(&seen), Some("TokenRefused"), Some(3));
        assert_eq!(kept, Some(first.clone()));
        // An older one that the watch shows to a new leader.
        let old = end("check-lb-0", 5, false);
        assert_eq!(
            last(Some(first.clone()), Some(&old), None, Some(3)),
            Some(first.clone())
        );
        let newer = end("check-lb-2", 20, false);
        let found = last(Some(first), Some(&newer), None, Some(3)).unwrap();
        assert_eq!(
            (found.submission_name.as_str(), found.result),
            ("check-lb-2", CheckResult::Failed)
        );
    }

    #[test]
    fn the_condition_compares_the_check_with_the_present_spec() {
        let passed = end("check-lb-1", 10, true).noted(None, 3);
        let failed = end("check-lb-1", 10, false).noted(None, 3);
        let unready = end("check-lb-1", 10, true).noted(Some("TokenRefused"), 3);
        let cases = [
            (
                None,
                3,
                Truth::Unknown,
                "NeverChecked",
                "Run `kubectl leaderboard check lb -n ns` before",
            ),
            (
                Some(&passed),
                3,
                Truth::True,
                "CheckPassed",
                "Check check-lb-1 passed at 1970-01-01 00:00:10 UTC.",
            ),
            (
                Some(&passed),
                4,
                Truth::Unknown,
                "CheckOutdated",
                "it was generation 3, and is 4. Run `kubectl",
            ),
            (
                Some(&failed),
                3,
                Truth::False,
                "CheckFailed",
                "with ImagePull: An image cannot be pulled.",
            ),
            (
                Some(&failed),
                4,
                Truth::False,
                "CheckFailed",
                "with ImagePull: An image cannot be pulled.",
            ),
            (
                Some(&unready),
                3,
                Truth::False,
                "CheckFailed",
                "with TokenRefused: EvalAI refuses the token",
            ),
        ];
        for (last, generation, truth, reason, words) in cases {
            let (found, why, message) = condition(&leaderboard(generation), last);
            assert_eq!((found, why), (truth, reason));
            assert!(message.contains(words), "{message}");
        }
    }
}
