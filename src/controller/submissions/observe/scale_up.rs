//! Whether a node is on its way for a Pod that none accepts: what cluster-autoscaler and Karpenter say in events of the Pod. Pure.

use jiff::Timestamp;
use k8s_openapi::api::core::v1::Event;

use crate::controller::submissions::view::ScaleUp;
use leaderboard_api::text::{LONGEST_MESSAGE, one_line};

/// The latest report of an autoscaler. The scheduler's own events show nothing of nodes that are not there yet.
pub(super) fn of(events: Vec<Event>) -> Option<ScaleUp> {
    let known = events
        .into_iter()
        .filter_map(|event| Some((at(&event), reported(&event)?)));
    known.max_by_key(|(at, _)| *at).map(|(_, report)| report)
}

fn reported(event: &Event) -> Option<ScaleUp> {
    let words = one_line(event.message.as_deref().unwrap_or_default(), LONGEST_MESSAGE);
    match event.reason.as_deref()? {
        "TriggeredScaleUp" | "Nominated" => Some(ScaleUp::Coming(words)),
        "NotTriggerScaleUp" => Some(ScaleUp::Refused(words)),
        // The scheduler's has the same reason.
        "FailedScheduling" if is_karpenters(event) => Some(ScaleUp::Refused(words)),
        _ => None,
    }
}

fn is_karpenters(event: &Event) -> bool {
    let source = event.source.as_ref().and_then(|source| source.component.as_deref());
    let names = [source, event.reporting_component.as_deref()];
    let known = ["karpenter", "eks-auto-mode/compute"];
    names.into_iter().flatten().any(|name| known.contains(&name))
}

fn at(event: &Event) -> Option<Timestamp> {
    let times = [event.last_timestamp.as_ref(), event.first_timestamp.as_ref()];
    let legacy = times.into_iter().flatten().next().map(|time| time.0);
    let repeated = event
        .series
        .as_ref()
        .and_then(|series| series.last_observed_time.as_ref());
    legacy.or_else(|| repeated.or(event.event_time.as_ref()).map(|time| time.0))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn event(reason: &str, component: &str, second: i64, message: &str) -> Event {
        let time = Timestamp::from_second(second).unwrap().to_string();
        serde_json::from_value(json!({
            "metadata": {}, "involvedObject": {}, "reason": reason, "message": message,
            "source": {"component": component}, "lastTimestamp": time,
        }))
        .unwrap()
    }

    #[test]
    fn an_autoscalers_last_message_differs_from_the_schedulers() {
        let scheduler = || event("FailedScheduling", "default-scheduler", 900, "0/3 nodes are available.");
        let triggered = "pod triggered scale-up: [{gpu-nodes 0->1 (max: 2)}]";
        let full = "pod didn't trigger scale-up: 1 max node group size reached";
        let nominated = "Pod should schedule on: nodeclaim/gpu-abc";
        let incompatible = "Failed to schedule pod, incompatible with nodepool \"gpu\"";
        let coming = |words: &str| Some(ScaleUp::Coming(words.into()));
        let refused = |words: &str| Some(ScaleUp::Refused(words.into()));
        let autoscaler = "cluster-autoscaler";
        let cases = [
            (vec![], None),
            (vec![scheduler()], None),
            (
                vec![event("TriggeredScaleUp", autoscaler, 10, triggered), scheduler()],
                coming(triggered),
            ),
            (
                vec![event("NotTriggerScaleUp", autoscaler, 10, full), scheduler()],
                refused(full),
            ),
            (
                vec![
                    event("TriggeredScaleUp", autoscaler, 30, triggered),
                    event("NotTriggerScaleUp", autoscaler, 20, full),
                ],
                coming(triggered),
            ),
            (vec![event("Nominated", "karpenter", 10, nominated)], coming(nominated)),
            (
                vec![event("Nominated", "eks-auto-mode/compute", 10, nominated)],
                coming(nominated),
            ),
            (
                vec![
                    event("Nominated", "karpenter", 10, nominated),
                    event("FailedScheduling", "karpenter", 60, incompatible),
                ],
                refused(incompatible),
            ),
            (vec![event("Scheduled", "default-scheduler", 10, "")], None),
        ];
        for (events, expected) in cases {
            let shown = format!("{:?}", events.iter().map(|event| &event.reason).collect::<Vec<_>>());
            assert_eq!(of(events), expected, "{shown}");
        }
    }

    #[test]
    fn a_word_without_a_time_is_older_than_any_other() {
        let mut timeless = event("TriggeredScaleUp", "cluster-autoscaler", 0, "once");
        timeless.last_timestamp = None;
        let known = event("NotTriggerScaleUp", "cluster-autoscaler", 5, "full");
        assert_eq!(of(vec![timeless, known]), Some(ScaleUp::Refused("full".into())));
    }
}
