//! A Leaderboard's `podOverrides`: a partial PodTemplateSpec laid over ours, and what it may not say.
//!
//! Pure, and on JSON, so that Pod fields newer than this client survive. Called by `job` (lay) and by the check of a
//! Leaderboard (validate). The rules, for people too: objects are merged deep; lists by `name`, volumeMounts by
//! `mountPath`; variables are replaced whole, tolerations added, all other lists replaced; `null` removes;
//! the names of the two roles stand for the containers of every worker, `agent-2` for one, whichever comes first in the list. They do so
//! among the init containers for an agent that runs first; what a host adds there comes before it.

#[cfg(test)]
mod kind_tests;
mod rules;
#[cfg(test)]
mod tests;

use leaderboard_api::LeaderboardSpec;
use leaderboard_protocol::files::{Host, Member, Side};
use serde_json::{Map, Value};

pub use rules::{OverlayError, validate, validate_overlay};

/// Names that stand for the containers of all workers, of any kind of evaluation.
const ALIASES: [&str; 3] = [Host::Simulator.name(), Host::Evaluator.name(), Side::Agent.name()];

/// Lays a Leaderboard's overlay over a template. One that the rules refuse is not applied at all, so that nothing gets around them.
pub(super) fn lay(template: &mut Value, spec: &LeaderboardSpec) {
    let overlay = spec.pod_overrides.as_ref();
    if let Some(overlay) = overlay.filter(|pod| validate_overlay(pod, spec).is_ok()) {
        apply(template, overlay);
    }
}

/// Lays `overlay` over a PodTemplateSpec, or a part of one. Only for overlays that [`validate_overlay`] accepts.
pub(super) fn apply(base: &mut Value, overlay: &Value) {
    match (base, overlay) {
        (Value::Object(base), Value::Object(overlay)) => merge_objects(base, overlay),
        (base, overlay) => *base = without_nulls(overlay),
    }
}

fn merge_objects(base: &mut Map<String, Value>, overlay: &Map<String, Value>) {
    for (key, value) in overlay {
        match (base.get_mut(key), value) {
            (_, Value::Null) => {
                base.remove(key);
            }
            (Some(Value::Array(known)), Value::Array(added)) => merge_lists(key, known, added),
            (Some(known), value) => apply(known, value),
            (None, value) => {
                base.insert(key.clone(), without_nulls(value));
            }
        }
    }
}

fn merge_lists(field: &str, base: &mut Vec<Value>, overlay: &[Value]) {
    let named = |list: &[Value]| list.iter().all(|item| item["name"].is_string());
    match field {
        "tolerations" => {
            let added: Vec<Value> = overlay.iter().filter(|item| !base.contains(item)).cloned().collect();
            base.extend(added);
        }
        "containers" => merge_containers(base, overlay),
        "initContainers" => merge_init_containers(base, overlay),
        "volumeMounts" => merge_by("mountPath", base, overlay, apply),
        // Merged deep, a variable could end up with both a value and a source.
        "env" => merge_by("name", base, overlay, |known, item| *known = without_nulls(item)),
        _ if named(base) && named(overlay) => merge_by("name", base, overlay, apply),
        _ => *base = overlay.iter().map(without_nulls).collect(),
    }
}

fn merge_by(key: &str, base: &mut Vec<Value>, overlay: &[Value], join: impl Fn(&mut Value, &Value)) {
    for item in overlay {
        match base.iter_mut().find(|known| known[key] == item[key]) {
            Some(known) => join(known, item),
            None => base.push(without_nulls(item)),
        }
    }
}

/// As among the containers for an agent that runs first, and by name for all others.
fn merge_init_containers(base: &mut Vec<Value>, overlay: &[Value]) {
    let is_of_worker = |item: &Value| ALIASES.contains(&name(item)) || Member::parse(name(item)).is_some();
    let (of_workers, others): (Vec<Value>, Vec<Value>) = overlay.iter().cloned().partition(is_of_worker);
    merge_containers(base, &of_workers);
    let known = base.len();
    merge_by("name", base, &others, apply);
    // In every Pod a host's own ones start before the agents.
    let first = base.iter().take(known).position(is_of_worker).unwrap_or(known);
    let added = base.len().saturating_sub(known);
    if let Some(tail) = base.get_mut(first..) {
        tail.rotate_right(added);
    }
}

fn name(item: &Value) -> &str {
    item["name"].as_str().unwrap_or_default()
}

/// Aliases go first, so that what is shown of one container wins over what is shown of all. A pair that this track does
/// not have is passed over: the overlay is the same for all tracks.
fn merge_containers(base: &mut [Value], overlay: &[Value]) {
    let (aliases, single): (Vec<&Value>, Vec<&Value>) = overlay.iter().partition(|item| ALIASES.contains(&name(item)));
    for item in aliases.into_iter().chain(single) {
        for known in base.iter_mut() {
            let own = name(known).to_owned();
            if addresses(name(item), &own) {
                apply(known, item);
                known["name"] = own.into();
            }
        }
    }
}

fn addresses(addressed: &str, container: &str) -> bool {
    addressed == container
        || (ALIASES.contains(&addressed)
            && container
                .strip_prefix(addressed)
                .is_some_and(|number| number.starts_with('-')))
}

/// The value without the fields that are null.
fn without_nulls(value: &Value) -> Value {
    let mut kept = value.clone();
    drop_nulls(&mut kept);
    kept
}

/// Takes the fields that are null out of a value.
pub(super) fn drop_nulls(value: &mut Value) {
    match value {
        Value::Object(object) => {
            object.retain(|_, value| !value.is_null());
            object.values_mut().for_each(drop_nulls);
        }
        Value::Array(list) => list.iter_mut().for_each(drop_nulls),
        _ => {}
    }
}
