//! Barriers between a participant's container, the node and its neighbors: security contexts, disk, name files.

use std::collections::BTreeSet;

use serde_json::{Value, json};

use leaderboard_api::Attempt;

use super::tests::{Case, container, containers};

fn is_own(container: &Value) -> bool {
    container["name"] == "workspace" || container["name"] == "logcopy"
}

#[test]
fn every_container_is_confined_by_default() {
    let jobs = [Case::new("V2", json!({})), Case::container(json!({}), &json!({}))].map(|case| case.json());
    for container in jobs.iter().flat_map(containers) {
        let context = &container["securityContext"];
        assert_eq!(context["allowPrivilegeEscalation"], false);
        assert_eq!(context["capabilities"], json!({"drop": ["ALL"]}));
        assert_eq!(context["seccompProfile"], json!({"type": "RuntimeDefault"}));
        assert_eq!(context.get("runAsUser").is_some(), is_own(container));
        assert_eq!(context.get("readOnlyRootFilesystem").is_some(), is_own(container));
    }
}

fn users(job: &Value) -> [i64; 2] {
    ["workspace", "logcopy"].map(|name| {
        let context = &container(job, name)["securityContext"];
        assert_eq!(context["runAsNonRoot"], true);
        assert_eq!(context["runAsUser"], context["runAsGroup"]);
        context["runAsUser"].as_i64().unwrap()
    })
}

#[test]
fn our_own_containers_run_as_a_user_of_their_job_that_no_image_can_know() {
    let of = |uid: &str, attempt: i64, retry: i32, more: Value| {
        let mut case = Case::new("V2", more);
        case.submission.metadata.uid = Some(uid.to_owned());
        case.number.attempt = Attempt(attempt);
        case.number.retry = retry;
        let [workspace, logcopy] = users(&case.json());
        // The one restores files that the other replaces.
        assert_eq!(workspace, logcopy);
        workspace
    };
    let jobs = [("a", 1, 0), ("b", 1, 0), ("a", 2, 0), ("a", 1, 1)];
    let all = jobs.map(|(uid, attempt, retry)| of(uid, attempt, retry, json!({})));
    assert!(
        all.iter().all(|user| (2_001_000_000..2_147_000_000).contains(user)),
        "{all:?}"
    );
    assert_eq!(BTreeSet::from(all).len(), jobs.len(), "{all:?}");
    assert_eq!(of("a", 1, 0, json!({})), all[0], "a Job is built the same each time");
    // A user namespace has 65,536 of them.
    let namespace = of("a", 1, 0, json!({"podOverrides": {"spec": {"hostUsers": false}}}));
    assert!((33_000..65_000).contains(&namespace), "{namespace}");
    let shared = of("a", 1, 0, json!({"podOverrides": {"spec": {"hostUsers": true}}}));
    assert_eq!(shared, all[0]);
}

#[test]
fn a_platform_or_a_host_may_choose_the_user_of_our_own_containers() {
    for (hosts, expected) in [(json!(1_000_660_000), Some(1_000_660_000)), (Value::Null, None)] {
        let context = json!({"runAsUser": hosts, "runAsGroup": hosts});
        let own = ["workspace", "logcopy"].map(|name| json!({"name": name, "securityContext": context}));
        let job = Case::new("V2", json!({"podOverrides": {"spec": {"initContainers": own}}})).json();
        for name in ["workspace", "logcopy"] {
            let context = &container(&job, name)["securityContext"];
            assert_eq!(context["runAsUser"].as_i64(), expected, "{name}");
            assert_eq!(context["runAsNonRoot"], true, "{name}");
        }
    }
}

/// The default security context with other fields laid over it; null removes one.
fn default_with(more: &Value) -> Value {
    let mut context = json!({
        "allowPrivilegeEscalation": false,
        "capabilities": {"drop": ["ALL"]},
        "seccompProfile": {"type": "RuntimeDefault"},
    });
    for (key, value) in more.as_object().unwrap() {
        context[key] = value.clone();
    }
    context.as_object_mut().unwrap().retain(|_, value| !value.is_null());
    context
}

/// Fails unless a host's context changes the containers of its side alone, to the expected one.
fn assert_laid_over(side: &str, hosts: &Value, expected: &Value) {
    let run = json!({"image": "own:1", "securityContext": hosts});
    let more = match side {
        "agent" => json!({"agent": {"securityContext": hosts}}),
        side => json!({"evaluation": {"carla": {side: run}}}),
    };
    let job = Case::new("V2", more).json();
    for container in containers(&job).into_iter().filter(|container| !is_own(container)) {
        let is_addressed = container["name"].as_str().unwrap().starts_with(side);
        let expected = if is_addressed {
            expected
        } else {
            &default_with(&json!({}))
        };
        assert_eq!(&container["securityContext"], expected, "{side} {hosts}");
    }
}

#[test]
fn a_hosts_security_context_is_laid_over_the_default_field_by_field() {
    let localhost = json!({"seccompProfile": {"type": "Localhost", "localhostProfile": "carla.json"}});
    for (hosts, changed) in [
        (json!({}), None),
        (json!({"runAsUser": 1000}), None),
        (
            json!({"runAsNonRoot": true, "runAsUser": 1000, "readOnlyRootFilesystem": true}),
            None,
        ),
        (
            json!({"capabilities": {"add": ["SYS_NICE"]}}),
            Some(json!({"capabilities": {"drop": ["ALL"], "add": ["SYS_NICE"]}})),
        ),
        (json!({"capabilities": {"drop": []}}), None),
        (localhost, None),
        (json!({"allowPrivilegeEscalation": true}), None),
        // Kubernetes refuses the two together.
        (
            json!({"privileged": true}),
            Some(json!({"privileged": true, "allowPrivilegeEscalation": null})),
        ),
    ] {
        let expected = default_with(changed.as_ref().unwrap_or(&hosts));
        for side in ["contents", "simulator", "agent"] {
            assert_laid_over(side, &hosts, &expected);
        }
    }
}

#[test]
fn an_overlay_lays_its_security_context_over_ours_and_null_removes_a_field() {
    let context = json!({"runAsUser": 7, "seccompProfile": null, "capabilities": {"drop": null, "add": ["KILL"]}});
    let privileged = json!({"name": "simulator", "securityContext": {"privileged": true}});
    let overlay = json!({"spec": {"containers": [{"name": "agent", "securityContext": context}, privileged]}});
    let job = Case::new("V2", json!({"podOverrides": overlay})).json();
    assert_eq!(
        container(&job, "agent-3")["securityContext"],
        json!({"allowPrivilegeEscalation": false, "runAsUser": 7, "capabilities": {"add": ["KILL"]}})
    );
    assert_eq!(
        container(&job, "simulator-2")["securityContext"],
        json!({"privileged": true, "capabilities": {"drop": ["ALL"]}, "seccompProfile": {"type": "RuntimeDefault"}})
    );
}

/// `ephemeral-storage` of a container, as request and limit.
fn disk(job: &Value, name: &str) -> (Option<String>, Option<String>) {
    let amount = |list: &str| {
        let amount = &container(job, name)["resources"][list]["ephemeral-storage"];
        amount.as_str().map(ToOwned::to_owned)
    };
    (amount("requests"), amount("limits"))
}

fn amounts(request: &str, limit: &str) -> (Option<String>, Option<String>) {
    let some = |amount: &str| (!amount.is_empty()).then(|| amount.to_owned());
    (some(request), some(limit))
}

#[test]
fn a_pod_requests_and_may_fill_so_much_of_its_nodes_disk() {
    let gib = 1_u64 << 30;
    // The logs of two pairs with 20Gi of results and 2Gi of each agent's log, 1Gi to spare, and 10Gi of contents.
    let volumes = ((20 + 2 * 2 + 1 + 10) * gib).to_string();
    let of = |simulator: Value, agent: Value| {
        let simulator = json!({"image": "s", "resources": simulator});
        let more =
            json!({"evaluation": {"carla": {"pairs": 2, "simulator": simulator}}, "agent": {"resources": agent}});
        let job = Case::new("V2", more).json();
        assert_eq!(disk(&job, "contents"), (None, None));
        assert_eq!(disk(&job, "workspace"), (None, None));
        assert_eq!(disk(&job, "agent-1"), disk(&job, "agent-2"));
        ["simulator-1", "agent-1", "logcopy"].map(|name| disk(&job, name))
    };
    let named = |list: &str, amount: &str| json!({list: {"ephemeral-storage": amount, "memory": "1Gi"}});
    for (simulator, agent, expected) in [
        // The host names no disk.
        (
            json!({}),
            json!({"limits": {"memory": "1Gi"}}),
            [("2Gi", "10Gi"), ("2Gi", "20Gi"), ("1Gi", &volumes)],
        ),
        // The host's own stay alone: Kubernetes takes a limit for the request too.
        (
            json!({}),
            named("limits", "50Mi"),
            [("2Gi", "10Gi"), ("", "50Mi"), ("1Gi", &volumes)],
        ),
        // A request alone is no limit, for the other side too: the sum would be the limit of both.
        (
            json!({}),
            named("requests", "5Gi"),
            [("2Gi", ""), ("5Gi", ""), ("1Gi", "")],
        ),
        (
            named("requests", "5Gi"),
            named("limits", "9Gi"),
            [("5Gi", ""), ("", "9Gi"), ("1Gi", &volumes)],
        ),
    ] {
        let expected = expected.map(|(request, limit)| amounts(request, limit));
        assert_eq!(of(simulator.clone(), agent.clone()), expected, "{simulator} {agent}");
    }
}

#[test]
fn without_contents_their_disk_is_not_counted() {
    let volumes = ((20 + 2 + 1) * (1_u64 << 30)).to_string();
    let job = Case::container(json!({}), &json!({})).json();
    for (name, expected) in [
        ("evaluator-1", amounts("2Gi", "10Gi")),
        ("agent-1", amounts("2Gi", "20Gi")),
        ("logcopy", amounts("1Gi", &volumes)),
    ] {
        assert_eq!(disk(&job, name), expected, "{name}");
    }
}

#[test]
fn a_tracks_own_resources_and_the_overlay_count_for_the_disk_as_well() {
    let disk_of = |amount: &str| json!({"limits": {"ephemeral-storage": amount}});
    let track = json!({"name": "sensors", "agent": {"resources": {"limits": {"memory": "1Gi"}}}});
    let overlay = json!({"spec": {
        "containers": [{"name": "simulator", "resources": disk_of("1Gi")}],
        "initContainers": [{"name": "logcopy", "resources": disk_of("90Gi")}],
    }});
    let more = json!({"tracks": [track], "agent": {"resources": disk_of("3Gi")}, "podOverrides": overlay});
    let job = Case::new("V2", more).json();
    // The track's take the place of all of the Leaderboard's.
    assert_eq!(disk(&job, "agent-1"), amounts("2Gi", "20Gi"));
    assert_eq!(disk(&job, "simulator-1"), amounts("", "1Gi"));
    assert_eq!(disk(&job, "logcopy"), amounts("", "90Gi"));
    assert_eq!(container(&job, "logcopy")["resources"]["limits"]["memory"], "1Gi");
}

#[test]
fn strangers_cannot_write_to_the_files_by_which_logcopy_resolves_names() {
    let job = Case::new("V1", json!({})).json();
    for container in containers(&job) {
        let name = container["name"].as_str().unwrap();
        let mounts = container["volumeMounts"].as_array().unwrap();
        for path in ["/etc/hosts", "/etc/resolv.conf", "/etc/hostname"] {
            let found = mounts.iter().find(|mount| mount["mountPath"] == path);
            let copy = json!({"name": "tools", "mountPath": path, "subPath": &path[1..], "readOnly": true});
            let is_strangers = name.starts_with("agent") || name.starts_with("simulator");
            assert_eq!(found, is_strangers.then_some(&copy), "{name}");
        }
        let writes = |mount: &&Value| mount["name"] == "tools" && mount["readOnly"] != true;
        assert_eq!(mounts.iter().any(|mount| writes(&mount)), name == "workspace");
    }
}
