//! How much of a node's disk a Pod requests and may fill, where its host names nothing. Pure, and on the finished template.
//!
//! Kubernetes adds up the limits of a Pod's containers, counts the volumes too, and evicts a Pod that is above the sum. So the
//! volumes have a share of their own in it, in `logcopy`'s name: without one an agent within its own limit could be evicted
//! for what its logs hold.

use serde_json::{Value, json};

use super::gpu::member;
use leaderboard_api::names;
use leaderboard_protocol::files::Side;

const DISK: &str = "ephemeral-storage";
/// Request and limit of an agent. The layers of its image do not count.
const AGENT: [&str; 2] = ["2Gi", "20Gi"];
/// Request and limit of a host's container.
const HOST: [&str; 2] = ["2Gi", "10Gi"];
/// Request for the volumes: the usual size of their content.
const VOLUMES_REQUEST: &str = "1Gi";

/// Fills in what is missing. `volumes` is the limit of all volumes in bytes.
///
/// A container whose host names a disk stays as it is, with nothing added. A request alone is the choice to have no limit. Then the
/// other containers get no limit either, since the sum would limit the whole Pod. An agent that is an init container counts as those beside
/// the hosts' do: Kubernetes takes the larger of its limit and their sum.
pub(super) fn fill(pod: &mut Value, volumes: u64) {
    let (mut workers, others): (Vec<_>, Vec<_>) = containers(pod).partition(|container| member(container).is_some());
    let is_unlimited = |container: &Value| names_disk(container, "requests") && !names_disk(container, "limits");
    let unlimited = workers.iter().any(|container| is_unlimited(container));
    for container in workers.iter_mut().filter(|container| !is_settled(container)) {
        let is_agent = member(container).is_some_and(|member| member.side == Side::Agent);
        let [request, limit] = if is_agent { AGENT } else { HOST };
        set(container, "requests", request);
        if !unlimited {
            set(container, "limits", limit);
        }
    }
    let limited = workers.iter().any(|container| names_disk(container, "limits"));
    let is_logcopy = |container: &Value| container["name"] == names::CONTAINER_LOGCOPY;
    for logcopy in others
        .into_iter()
        .filter(|found| is_logcopy(found) && !is_settled(found))
    {
        set(logcopy, "requests", VOLUMES_REQUEST);
        // Alone it would be the limit of the whole Pod.
        if limited {
            set(logcopy, "limits", &volumes.to_string());
        }
    }
}

/// All containers of a Pod.
fn containers(pod: &mut Value) -> impl Iterator<Item = &mut Value> {
    let fields = pod.as_object_mut().into_iter().flatten();
    let lists = fields.filter(|(field, _)| ["initContainers", "containers"].contains(&field.as_str()));
    lists.filter_map(|(_, list)| list.as_array_mut()).flatten()
}

fn is_settled(container: &Value) -> bool {
    names_disk(container, "requests") || names_disk(container, "limits")
}

fn names_disk(container: &Value, list: &str) -> bool {
    container["resources"][list]
        .get(DISK)
        .is_some_and(|amount| !amount.is_null())
}

fn set(container: &mut Value, list: &str, amount: &str) {
    for (object, key) in [("", "resources"), ("/resources", list)] {
        if let Some(object) = container.pointer_mut(object).and_then(Value::as_object_mut)
            && object.get(key).is_none_or(Value::is_null)
        {
            object.insert(key.to_owned(), json!({}));
        }
    }
    container["resources"][list][DISK] = amount.into();
}
