//! How many GPUs a Pod takes from its node. Pure: read off what the host requests, as the scheduler does.

use leaderboard_protocol::files::Member;
use serde_json::{Value, json};

use super::{gpu, members, workers};
use crate::gpu_claims::source;
use crate::overlay as pod_overlay;
use leaderboard_api::{GpuSource, LeaderboardSpec, RunPlan, Track};

/// GPUs that the Pod of a plan requests or claims; shares of GPUs and MIG slices count as one each. Those of an agent that runs first are free
/// again for the other containers.
pub fn gpus(spec: &LeaderboardSpec, track: Option<&Track>, plan: &RunPlan) -> i64 {
    let source = source(spec);
    let of_member = |member: Member| {
        let hosts = spec.given(track, workers::part(member.side));
        let hosts = hosts.and_then(|hosts| hosts.resources);
        let resources = gpu::resources(spec, plan, member, hosts.as_ref());
        json!({"name": member.to_string(), "resources": resources})
    };
    let (first, beside): (Vec<Member>, Vec<Member>) =
        members::members(plan).partition(|member| members::is_first(plan, *member));
    let [first, beside] = [first, beside].map(|list| list.into_iter().map(of_member).collect::<Vec<Value>>());
    let mut template = json!({"spec": {"initContainers": first, "containers": beside}});
    pod_overlay::lay(&mut template, spec);
    let sum = |list: &str| {
        let containers = template["spec"][list].as_array().into_iter().flatten();
        let of_workers = containers.filter(|container| gpu::member(container).is_some());
        let each = of_workers.map(|container| requested(&container["resources"], source));
        each.fold(0, i64::saturating_add)
    };
    let requested = sum("initContainers").max(sum("containers"));
    requested.saturating_add(claimed(source, plan))
}

/// One device for each worker that shares the work.
fn claimed(source: GpuSource<'_>, plan: &RunPlan) -> i64 {
    match source {
        GpuSource::Claim(_) => i64::try_from(plan.sharing()).unwrap_or(i64::MAX),
        GpuSource::None | GpuSource::PerContainer(_) | GpuSource::NodeIndex(_) => 0,
    }
}

/// Number of GPUs that a container requests. The limit of such a resource is its request.
fn requested(resources: &Value, source: GpuSource<'_>) -> i64 {
    let of_list = |list: &str| {
        let named = resources[list].as_object().into_iter().flatten();
        let amounts = named
            .filter(|(name, _)| gpu::is_gpu(name, source))
            .map(|(_, amount)| amount.as_i64().or_else(|| amount.as_str()?.parse().ok()).unwrap_or(0));
        amounts.fold(0, |sum: i64, amount: i64| sum.saturating_add(amount.max(0)))
    };
    of_list("limits").max(of_list("requests"))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::job::tests::{Case, lay};
    use leaderboard_api::effective;

    /// GPUs of a Leaderboard of four pairs with these fields.
    fn counted(fields: &Value) -> i64 {
        let mut spec = json!({
            "tracks": [{"name": "sensors"}],
            "evaluation": {"carla": {
                "version": "V2", "contents": {"image": "contents:1"}, "simulator": {}, "pairs": 4, "routes": 20,
            }},
            "agent": {},
            "storage": {"s3": {"bucket": "results"}},
        });
        lay(&mut spec, fields);
        spec["evaluation"]["carla"]["simulator"]["image"] = json!("simulator:1");
        let spec: LeaderboardSpec = serde_json::from_value(spec).unwrap();
        let track = spec.tracks[0].clone();
        let plan = effective::plan(&spec, &track, "77".parse().unwrap(), Some("a:1".into()), false).unwrap();
        gpus(&spec, Some(&track), &plan)
    }

    /// The resources of a container with one GPU.
    fn one() -> Value {
        json!({"limits": {"nvidia.com/gpu": "1", "cpu": "4"}})
    }

    fn assert_counted<const N: usize>(cases: [(&str, Value, i64); N]) {
        for (what, fields, expected) in cases {
            assert_eq!(counted(&fields), expected, "{what}");
        }
    }

    #[test]
    fn gpus_are_counted_by_the_mode() {
        assert_counted([
            ("nothing is requested", json!({}), 0),
            (
                "one for each container",
                json!({"gpu": {"resourceName": "nvidia.com/gpu"}}),
                8,
            ),
            (
                "one for both of a pair",
                json!({"gpu": {"mode": "NodeIndex", "resourceName": "nvidia.com/gpu"}}),
                4,
            ),
            ("another vendor's", json!({"gpu": {"resourceName": "amd.com/gpu"}}), 8),
            (
                "one claim for each pair",
                json!({"gpu": {"mode": "Claim", "claim": {"deviceClassName": "gpu.nvidia.com"}}}),
                4,
            ),
        ]);
    }

    #[test]
    fn gpus_are_counted_as_containers_request_them() {
        assert_counted([
            (
                "one a simulator",
                json!({"evaluation": {"carla": {"simulator": {"resources": one()}}}}),
                4,
            ),
            (
                "as a number",
                json!({"evaluation": {"carla": {"simulator": {"resources": {"requests": {"nvidia.com/gpu": 1}}}}}}),
                4,
            ),
            (
                "limits and requests are one",
                json!({"evaluation": {"carla": {"simulator": {
                    "resources": {"limits": {"nvidia.com/gpu": "1"}, "requests": {"nvidia.com/gpu": "1"}},
                }}}}),
                4,
            ),
            (
                "both sides",
                json!({"evaluation": {"carla": {"simulator": {"resources": one()}}}, "agent": {"resources": one()}}),
                8,
            ),
            (
                "a track of its own",
                json!({"tracks": [{"name": "sensors", "carla": {"simulator": {"resources": one()}}}]}),
                4,
            ),
            (
                "slices",
                json!({"evaluation": {"carla": {"simulator": {"resources": {"limits": {"nvidia.com/mig-1g.5gb": "2"}}}}}}),
                8,
            ),
            (
                "other resources",
                json!({"evaluation": {"carla": {"simulator": {"resources": {"limits": {"cpu": "2"}}}}}}),
                0,
            ),
        ]);
    }

    #[test]
    fn gpus_of_evaluators_are_counted_as_those_of_simulators() {
        let overlay = json!({"spec": {"containers": [{"name": "evaluator-1", "resources": null}]}});
        for (container, more, expected) in [
            (json!({}), json!({}), 0),
            (json!({"resources": one()}), json!({}), 3),
            (json!({}), json!({"gpu": {"resourceName": "nvidia.com/gpu"}}), 6),
            (json!({"resources": one()}), json!({"podOverrides": overlay}), 2),
        ] {
            let mut container = container;
            container["workers"] = json!(3);
            let case = Case::container(container, &more);
            let spec = &case.leaderboard.spec;
            assert_eq!(gpus(spec, spec.tracks.first(), &case.plan), expected, "{more}");
        }
    }

    /// One of three evaluators, of an agent that ends before them, and of no agent.
    #[test]
    fn gpus_of_an_agent_that_runs_first_are_free_again() {
        let four = json!({"limits": {"nvidia.com/gpu": "4"}});
        for (mode, fields, expected) in [
            ("Batch", json!({"gpu": {"resourceName": "nvidia.com/gpu"}}), 3),
            (
                "Batch",
                json!({"gpu": {"mode": "NodeIndex", "resourceName": "nvidia.com/gpu"}}),
                3,
            ),
            (
                "Batch",
                json!({"gpu": {"mode": "Claim", "claim": {"deviceClassName": "gpu.nvidia.com"}}}),
                3,
            ),
            (
                "Batch",
                json!({"podOverrides": {"spec": {"initContainers": [{"name": "agent", "resources": four}]}}}),
                4,
            ),
            ("Predictions", json!({"gpu": {"resourceName": "nvidia.com/gpu"}}), 3),
            ("Predictions", json!({"agent": {"resources": one()}}), 0),
        ] {
            let case = Case::container(json!({"mode": mode, "workers": 3}), &fields);
            let spec = &case.leaderboard.spec;
            assert_eq!(gpus(spec, spec.tracks.first(), &case.plan), expected, "{mode} {fields}");
        }
    }

    #[test]
    fn an_overlay_changes_what_is_requested() {
        let one_each = || json!({"resources": one()});
        let overlay = |container: Value| json!({"spec": {"containers": [container]}});
        let three = json!({"name": "simulator-1", "resources": {"limits": {"nvidia.com/gpu": "3"}}});
        let cases = [
            ("another number for one pair", one_each(), three, 6),
            (
                "without a GPU",
                one_each(),
                json!({"name": "simulator-1", "env": []}),
                4,
            ),
            (
                "for all agents",
                json!({}),
                json!({"name": "agent", "resources": one()}),
                4,
            ),
            (
                "none for any simulator",
                one_each(),
                json!({"name": "simulator", "resources": null}),
                0,
            ),
        ];
        for (what, simulator, container, expected) in cases {
            let fields = json!({"evaluation": {"carla": {"simulator": simulator}}, "podOverrides": overlay(container)});
            assert_eq!(counted(&fields), expected, "{what}");
        }
    }
}
