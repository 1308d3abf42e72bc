//! The PriorityClasses of a Leaderboard's Pods: they have to be there, and a run must not end another one.
//!
//! Asks the API server for the classes if `rbac.clusterRole` allows it; otherwise the classes go unchecked. `judge` is pure.

use std::collections::BTreeMap;

use k8s_openapi::api::scheduling::v1::PriorityClass;
use kube::{Api, Client};
use serde_json::Value;

use super::pod_findings::TriedPods;
use crate::kubernetes::call;
use leaderboard_api::Track;
use leaderboard_pod_spec::notes::TrackPods;

/// A class, and who asks for it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Asked {
    tracks: Vec<String>,
    /// By `priorityClassName` of a track; else by `podOverrides`.
    is_of_track: bool,
}

/// The classes that the Pods of the tracks have.
pub(super) fn asked(tracks: &[Track], pods: &[TrackPods]) -> BTreeMap<String, Asked> {
    let mut found: BTreeMap<String, Asked> = BTreeMap::new();
    for pods in pods {
        let Some(class) = pods.template.pointer("/spec/priorityClassName").and_then(Value::as_str) else {
            continue;
        };
        let mut own = tracks.iter().filter(|track| track.name == pods.track);
        let asked = found.entry(class.to_owned()).or_default();
        asked.tracks.push(pods.track.clone());
        asked.is_of_track |= own.any(|track| track.priority_class_name.as_deref() == Some(class));
    }
    found
}

/// Reads the classes. One is refused if no Pod could be made, or if it would preempt against the rule of the field.
pub(super) async fn look(client: &Client, asked: &BTreeMap<String, Asked>, tried: &mut TriedPods) {
    let api: Api<PriorityClass> = Api::all(client.clone());
    for (class, asked) in asked {
        if let Ok(found) = call("reading the PriorityClass", class, api.get_opt(class)).await {
            judge(class, asked, found.as_ref(), tried);
        }
    }
}

fn judge(class: &str, asked: &Asked, found: Option<&PriorityClass>, tried: &mut TriedPods) {
    let named = if asked.tracks.len() == 1 { "track" } else { "tracks" };
    let tracks = asked.tracks.join(", ");
    let what = format!("PriorityClass {class} of the {named} {tracks}");
    let text = match found {
        Some(found) if found.preemption_policy.as_deref() == Some("Never") => return,
        None => format!("{what} does not exist. Create it, or correct its name."),
        Some(_) => format!(
            "{what} preempts: one run would end another, which then repeats some work of each worker. Set preemptionPolicy: Never \
             in the class."
        ),
    };
    if found.is_none() || asked.is_of_track {
        tried.refused.get_or_insert(text);
    } else {
        tried.notes.push(text);
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn track(name: &str, class: Option<&str>) -> Track {
        serde_json::from_value(json!({"name": name, "priorityClassName": class})).unwrap()
    }

    fn pods(track: &str, class: Option<&str>) -> TrackPods {
        TrackPods {
            track: track.to_owned(),
            template: json!({"spec": {"priorityClassName": class}}),
        }
    }

    #[test]
    fn a_class_is_asked_for_by_a_track_or_by_the_overrides_of_all() {
        let tracks = [track("a", Some("high")), track("b", None), track("c", None)];
        let all = [pods("a", Some("high")), pods("b", Some("low")), pods("c", None)];
        let found = asked(&tracks, &all);
        let of = |track: &str, is_of_track| Asked {
            tracks: vec![track.to_owned()],
            is_of_track,
        };
        assert_eq!(
            found,
            [("high".into(), of("a", true)), ("low".into(), of("b", false))].into()
        );
    }

    #[test]
    fn a_class_that_preempts_is_refused_where_a_track_names_it_and_noted_where_the_overrides_do() {
        let class = |policy: Option<&str>| PriorityClass {
            preemption_policy: policy.map(str::to_owned),
            ..PriorityClass::default()
        };
        let (waits, preempts) = (class(Some("Never")), class(None));
        for (is_of_track, seen, is_refused, has_note) in [
            (true, Some(&waits), false, false),
            (true, Some(&preempts), true, false),
            (false, Some(&preempts), false, true),
            (true, None, true, false),
            (false, None, true, false),
        ] {
            let asked = Asked {
                tracks: vec!["a".into(), "b".into()],
                is_of_track,
            };
            let mut problems = TriedPods::default();
            judge("high", &asked, seen, &mut problems);
            let found = (problems.refused.is_some(), !problems.notes.is_empty());
            assert_eq!(found, (is_refused, has_note), "{seen:?} {is_of_track}");
            let texts = problems.refused.iter().chain(&problems.notes);
            assert!(
                texts
                    .into_iter()
                    .all(|text| text.starts_with("PriorityClass high of the tracks a, b "))
            );
        }
    }
}
