//! Which submissions hold GPUs at present, and how much each has used until now. Pure.
//!
//! Called by `counts`, as the cache changes and as the gauges are shown. Only what runs is here, so the cluster's GPUs bound it.

use std::collections::BTreeMap;

use jiff::Timestamp;
use kube::ResourceExt;

use crate::controller::objects::board_name;
use crate::observability::metrics::{OTHERS, OfSubmission};
use leaderboard_api::{Submission, Use, conditions};

/// Submissions of a Leaderboard that have a sample of their own.
const MAX_SHOWN: usize = 500;

/// By Leaderboard, as `namespace/name`.
#[derive(Default)]
pub(super) struct Holders(BTreeMap<String, BTreeMap<Place, Use>>);

/// The earliest first, so that a submission keeps its sample when others come.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Place {
    since: Timestamp,
    /// When its Pod was lost, where that is known: what the next Pod brings is counted from that one's node on.
    until: Option<Timestamp>,
    submission: String,
}

/// A submission whose Pod has GPUs.
#[derive(PartialEq)]
pub(super) struct Holder {
    board: String,
    place: Place,
    used: Use,
}

impl Holder {
    pub(super) fn of(submission: &Submission) -> Option<Self> {
        let status = submission.status.as_ref()?;
        let used = status.usage.filter(|used| used.gpus > 0)?;
        let since = status.times.scheduled.as_ref()?.0;
        let is_over = conditions::is_true(&status.conditions, conditions::FINISHED);
        if is_over {
            return None;
        }
        let running = status.condition(conditions::RUNNING);
        let stopped = running.filter(|running| running.status != "True");
        let until = stopped.map(|running| running.last_transition_time.0);
        Some(Self {
            board: board_name(submission.namespace(), &submission.spec.leaderboard_name),
            place: Place {
                since,
                until: until.filter(|until| *until > since),
                submission: submission.name_any(),
            },
            used,
        })
    }
}

impl Holders {
    /// One more holds GPUs, or one less.
    pub(super) fn take(&mut self, holder: Holder, is_there: bool) {
        let of_board = self.0.entry(holder.board.clone()).or_default();
        if is_there {
            of_board.insert(holder.place, holder.used);
        } else {
            of_board.remove(&holder.place);
        }
        if of_board.is_empty() {
            self.0.remove(&holder.board);
        }
    }

    /// What the submissions of a Leaderboard have used that hold GPUs.
    pub(super) fn gpu_use(&self, board: &str, now: Timestamp) -> BTreeMap<OfSubmission, i64> {
        let mut found = BTreeMap::new();
        for (index, (place, used)) in self.0.get(board).into_iter().flatten().enumerate() {
            let mut used = *used;
            let end = place.until.unwrap_or(now);
            used.add(end.duration_since(place.since).as_secs());
            let name = if index < MAX_SHOWN { &place.submission } else { OTHERS };
            let of = OfSubmission {
                leaderboard: board.to_owned(),
                submission: name.to_owned(),
            };
            let sum: &mut i64 = found.entry(of).or_default();
            *sum = sum.saturating_add(used.gpu_seconds);
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    const NOW: &str = "2026-01-01T01:00:00Z";

    fn submission(name: &str, status: &Value) -> Submission {
        let object = json!({
            "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Submission",
            "metadata": {"name": name, "namespace": "one"},
            "spec": {"leaderboardName": "a", "track": "map", "image": "agent:1"},
            "status": status,
        });
        serde_json::from_value(object).unwrap()
    }

    /// The Pod has had four GPUs for so many minutes, and Jobs before it used 100 GPU seconds.
    fn running(minutes: u32, running: &str, stopped: &str) -> Value {
        let condition = |name: &str, status: &str, since: &str| json!({"type": name, "status": status, "reason": "R", "message": "", "lastTransitionTime": since});
        json!({
            "use": {"gpus": 4, "gpuSeconds": 100},
            "times": {"scheduled": format!("2026-01-01T00:{:02}:00Z", 60 - minutes)},
            "conditions": [condition("Finished", "False", "2026-01-01T00:00:00Z"), condition("Running", running, stopped)],
        })
    }

    fn holders(all: &[Submission]) -> Holders {
        let mut holders = Holders::default();
        for holder in all.iter().filter_map(Holder::of) {
            holders.take(holder, true);
        }
        holders
    }

    fn shown(holders: &Holders) -> Vec<(String, i64)> {
        let found = holders.gpu_use("one/a", NOW.parse().unwrap());
        found
            .into_iter()
            .map(|(of, seconds)| (of.submission, seconds))
            .collect()
    }

    #[test]
    fn one_that_holds_gpus_has_what_it_has_used_until_now() {
        let begun = "2026-01-01T00:00:00Z";
        let started = submission("drives", &running(10, "True", "2026-01-01T00:51:00Z"));
        let pulls = submission("pulls", &running(5, "False", begun));
        let lost = submission("lost", &running(30, "False", "2026-01-01T00:40:00Z"));
        let all = holders(&[started, pulls, lost]);
        let expected = [
            ("drives", 100 + 4 * 600),
            ("lost", 100 + 4 * 600),
            ("pulls", 100 + 4 * 300),
        ];
        assert_eq!(shown(&all), expected.map(|(name, seconds)| (name.to_owned(), seconds)));
        assert!(all.gpu_use("one/b", NOW.parse().unwrap()).is_empty());
    }

    #[test]
    fn what_has_ended_waits_or_has_no_gpu_is_not_shown() {
        let live = running(10, "True", NOW);
        let with = |key: &str, value: Value| {
            let mut status = live.clone();
            status[key] = value;
            submission("one", &status)
        };
        let ended = json!([{"type": "Finished", "status": "True", "reason": "Finished", "message": "", "lastTransitionTime": NOW}]);
        let none = [
            with("conditions", ended),
            with("times", json!({})),
            with("use", json!({"gpus": 0, "gpuSeconds": 100})),
            with("use", Value::Null),
            submission("one", &Value::Null),
        ];
        assert_eq!(none.iter().filter_map(Holder::of).count(), 0);
    }

    #[test]
    fn five_hundred_of_a_leaderboard_have_a_sample_each_and_the_others_one() {
        let minute = |number: u32| if number == 0 { 59 } else { 10 };
        let all: Vec<Submission> = (0..502)
            .rev()
            .map(|number| submission(&format!("s-{number:03}"), &running(minute(number), "True", NOW)))
            .collect();
        let mut holders = holders(&all);
        let found = shown(&holders);
        assert_eq!(found.len(), MAX_SHOWN + 1);
        assert_eq!(found[0], ("other".to_owned(), 2 * (100 + 4 * 600)));
        assert_eq!(found[1], ("s-000".to_owned(), 100 + 4 * 3540));
        for holder in all.iter().filter_map(Holder::of) {
            holders.take(holder, false);
        }
        assert!(holders.0.is_empty());
    }
}
