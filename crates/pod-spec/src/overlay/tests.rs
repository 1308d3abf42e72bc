//! Tables of what an overlay does and what it may not say.

use serde_json::{Value, json};

use super::*;

pub(super) fn carla() -> LeaderboardSpec {
    let spec = json!({
        "evaluation": {"carla": {"version": "V2", "contents": {"image": "c"}, "simulator": {"image": "s"}}},
        "tracks": [{"name": "t"}], "storage": {"s3": {"bucket": "bucket"}}, "agent": {},
    });
    serde_json::from_value(spec).unwrap()
}

fn base() -> Value {
    json!({
        "metadata": {"labels": {"a": "1"}, "annotations": {"b": "2"}},
        "spec": {
            "restartPolicy": "OnFailure",
            "tolerations": [{"key": "t"}],
            "volumes": [{"name": "logs", "emptyDir": {}}],
            "initContainers": [{"name": "contents"}, {"name": "logcopy", "resources": {"limits": {"memory": "1Gi"}, "requests": {"cpu": "1"}}}],
            "containers": [
                {"name": "simulator-1", "securityContext": {"privileged": false}, "env": [{"name": "X", "value": "x"}]},
                {"name": "simulator-2"},
                {"name": "agent-1", "volumeMounts": [{"name": "v", "mountPath": "/a", "readOnly": true}], "command": ["a", "b"]},
                {"name": "agent-2"},
            ],
        },
    })
}

/// The base with `overlay` over it; `pointer` is compared.
#[track_caller]
#[allow(clippy::needless_pass_by_value, reason = "the tables below read better")]
fn check(overlay: Value, pointer: &str, expected: Value) {
    let mut template = base();
    apply(&mut template, &overlay);
    assert_eq!(
        template.pointer(pointer).cloned().unwrap_or_default(),
        expected,
        "{overlay}"
    );
}

#[test]
fn an_overlay_adds_replaces_and_removes() {
    let spec = |spec: Value| json!({"spec": spec});
    check(
        json!({"metadata": {"labels": {"c": "3"}}}),
        "/metadata/labels",
        json!({"a": "1", "c": "3"}),
    );
    check(
        json!({"metadata": {"annotations": {"b": null, "d": "4"}}}),
        "/metadata/annotations",
        json!({"d": "4"}),
    );
    check(
        spec(json!({"tolerations": [{"key": "t"}, {"key": "u"}]})),
        "/spec/tolerations",
        json!([{"key": "t"}, {"key": "u"}]),
    );
    check(
        spec(json!({"volumes": [{"name": "shm", "emptyDir": {"medium": "Memory", "sizeLimit": null}}]})),
        "/spec/volumes",
        json!([{"name": "logs", "emptyDir": {}}, {"name": "shm", "emptyDir": {"medium": "Memory"}}]),
    );
    check(
        spec(
            json!({"initContainers": [{"name": "logcopy", "resources": {"limits": {"memory": "2Gi"}, "requests": null}}]}),
        ),
        "/spec/initContainers/1/resources",
        json!({"limits": {"memory": "2Gi"}}),
    );
    check(
        spec(json!({"initContainers": [{"name": "new", "image": "i"}]})),
        "/spec/initContainers/2",
        json!({"name": "new", "image": "i"}),
    );
    check(
        spec(json!({"affinity": {"nodeAffinity": {"x": 1, "y": null}}})),
        "/spec/affinity",
        json!({"nodeAffinity": {"x": 1}}),
    );
    check(
        spec(json!({"containers": [{"name": "agent-1", "command": ["c"]}]})),
        "/spec/containers/2/command",
        json!(["c"]),
    );
    check(
        spec(json!({"dnsConfig": {"nameservers": ["192.0.2.1"]}})),
        "/spec/dnsConfig/nameservers",
        json!(["192.0.2.1"]),
    );
}

#[test]
fn mounts_are_found_by_path_and_variables_replaced_whole() {
    let agent = |fields: Value| {
        let mut item = fields;
        item["name"] = "agent-1".into();
        json!({"spec": {"containers": [item]}})
    };
    check(
        agent(json!({"volumeMounts": [{"name": "w", "mountPath": "/a"}, {"name": "w", "mountPath": "/b"}]})),
        "/spec/containers/2/volumeMounts",
        json!([{"name": "w", "mountPath": "/a", "readOnly": true}, {"name": "w", "mountPath": "/b"}]),
    );
    check(
        agent(json!({"env": [{"name": "Y", "value": "y"}]})),
        "/spec/containers/2/env",
        json!([{"name": "Y", "value": "y"}]),
    );
    let source = json!({"name": "X", "valueFrom": {"fieldRef": {"fieldPath": "status.hostIP"}}});
    check(
        json!({"spec": {"containers": [{"name": "simulator", "env": [source]}]}}),
        "/spec/containers/0/env",
        json!([source]),
    );
}

#[test]
fn aliases_address_every_pair_and_single_names_win() {
    let overlay = json!({"spec": {"containers": [
        {"name": "simulator-2", "securityContext": {"privileged": false}},
        {"name": "simulator", "securityContext": {"privileged": true}},
        {"name": "agent", "resources": {"limits": {"memory": "8Gi"}}},
        {"name": "agent-9", "resources": {}},
    ]}});
    check(
        overlay.clone(),
        "/spec/containers/0/securityContext",
        json!({"privileged": true}),
    );
    check(
        overlay.clone(),
        "/spec/containers/1",
        json!({"name": "simulator-2", "securityContext": {"privileged": false}}),
    );
    check(overlay.clone(), "/spec/containers/2/name", json!("agent-1"));
    check(
        overlay.clone(),
        "/spec/containers/3",
        json!({"name": "agent-2", "resources": {"limits": {"memory": "8Gi"}}}),
    );
    check(overlay, "/spec/containers/4", Value::Null);
}

#[test]
fn an_empty_overlay_changes_nothing() {
    for overlay in [
        json!({}),
        json!({"spec": {}}),
        json!({"metadata": {"labels": {}}, "spec": {"containers": []}}),
    ] {
        assert_eq!(validate_overlay(&overlay, &carla()), Ok(()));
        check(overlay, "", base());
    }
}

#[test]
fn what_an_overlay_may_set_is_accepted() {
    let cases = [
        json!({"metadata": {"labels": {"team": "x"}, "annotations": {"karpenter.sh/do-not-disrupt": null}}}),
        json!({"spec": {"priorityClassName": "high", "imagePullSecrets": [{"name": "registry"}], "terminationGracePeriodSeconds": 700}}),
        json!({"spec": {"volumes": [{"name": "shm", "emptyDir": {"medium": "Memory"}}, {"name": "x11", "hostPath": {"path": "/tmp/.X11-unix"}}],
            "containers": [{"name": "agent", "volumeMounts": [{"name": "shm", "mountPath": "/dev/shm"}]},
                           {"name": "simulator", "env": [{"name": "DISPLAY", "value": ":0"}], "volumeMounts": [{"name": "x11", "mountPath": "/tmp/.X11-unix"}]}]}}),
        json!({"spec": {"containers": [{"name": "simulator-16", "securityContext": {"privileged": true}, "volumeMounts": [{"name": "carla-python-api", "mountPath": "/api", "readOnly": true}]}]}}),
        json!({"spec": {"initContainers": [{"name": "logcopy", "resources": null, "env": [{"name": "RUST_LOG", "value": "debug"}]}, {"name": "metrics", "image": "m", "command": ["m"], "restartPolicy": "Always"}]}}),
        json!({"spec": {"containers": [{"name": "agent", "volumeMounts": [{"name": "scratch", "mountPath": "/tmp"}, {"name": "scratch", "mountPath": "/tmp/agents"}]}]}}),
        json!({"spec": {"tolerations": null, "fieldOfTheFuture": [1]}}),
    ];
    for case in cases {
        assert_eq!(validate_overlay(&case, &carla()), Ok(()), "{case}");
    }
}

/// Each overlay, written as JSON, with how the message starts.
#[track_caller]
fn refused(cases: &[(&str, &str)]) {
    refused_by(&carla(), cases);
}

#[track_caller]
pub(super) fn refused_by(spec: &LeaderboardSpec, cases: &[(&str, &str)]) {
    for (overlay, expected) in cases {
        let error = validate_overlay(&serde_json::from_str(overlay).unwrap(), spec)
            .expect_err(overlay)
            .to_string();
        assert!(error.starts_with(expected), "{overlay}\n  {error}\n  {expected}");
    }
}

/// Overlays with one entry in `list`, each with how the message goes on behind that list's path.
#[track_caller]
fn refused_in(list: &str, cases: &[(&str, &str)]) {
    for (entry, expected) in cases {
        let overlay = format!(r#"{{"spec": {{"{list}": [{entry}]}}}}"#);
        refused(&[(&overlay, &format!("podOverrides.spec.{list}{expected}"))]);
    }
}

#[test]
fn what_a_template_may_not_set_is_refused() {
    refused(&[
        ("[]", "podOverrides is not an object"),
        (
            r#"{"kind": "Pod"}"#,
            "podOverrides.kind cannot be overridden: a template has metadata and spec",
        ),
        (
            r#"{"metadata": {"name": "x"}}"#,
            "podOverrides.metadata.name cannot be overridden: the Job names its Pods",
        ),
        (
            r#"{"metadata": {"labels": null}}"#,
            "podOverrides.metadata.labels is not an object",
        ),
        (
            r#"{"metadata": {"labels": {"leaderboard.carla.org/run": "1"}}}"#,
            "podOverrides.metadata.labels[leaderboard.carla.org/run] cannot be overridden: the operator finds",
        ),
        (
            r#"{"metadata": {"labels": {"app.kubernetes.io/managed-by": null}}}"#,
            "podOverrides.metadata.labels[app.kubernetes.io/managed-by] cannot",
        ),
        (
            r#"{"metadata": {"labels": {"batch.kubernetes.io/job-name": "x"}}}"#,
            "podOverrides.metadata.labels[batch.kubernetes.io/job-name] cannot",
        ),
        (
            r#"{"metadata": {"annotations": {"leaderboard.carla.org/stop": "Cancel"}}}"#,
            "podOverrides.metadata.annotations[leaderboard.carla.org/stop] cannot",
        ),
        (
            r#"{"metadata": {"annotations": {"eks.amazonaws.com/skip-containers": null}}}"#,
            "podOverrides.metadata.annotations[eks.amazonaws.com/skip-containers] cannot",
        ),
        (
            r#"{"spec": {"nodeSelector": {"a": 5}}}"#,
            "podOverrides is not a partial Pod template: invalid type: integer `5`, expected a string",
        ),
    ]);
}

#[test]
fn what_a_pod_may_not_set_is_refused() {
    for (field, value) in [
        ("restartPolicy", "null"),
        ("serviceAccountName", r#""x""#),
        ("serviceAccount", r#""x""#),
        ("automountServiceAccountToken", "true"),
        ("shareProcessNamespace", "true"),
        ("hostPID", "true"),
        ("hostIPC", "true"),
        ("hostNetwork", "true"),
        ("activeDeadlineSeconds", "1"),
        ("runtimeClassName", "null"),
        ("ephemeralContainers", "[]"),
    ] {
        let overlay = format!(r#"{{"spec": {{"{field}": {value}}}}}"#);
        refused(&[(&overlay, &format!("podOverrides.spec.{field} cannot be overridden: "))]);
    }
    refused(&[
        (
            r#"{"spec": {"volumes": null}}"#,
            "podOverrides.spec.volumes is not a list",
        ),
        (
            r#"{"spec": {"containers": null}}"#,
            "podOverrides.spec.containers is not a list",
        ),
    ]);
    refused_in(
        "volumes",
        &[
            (
                r#"{"name": "logs"}"#,
                "[logs] cannot be overridden: the operator fills this volume",
            ),
            (r#"{"name": "leaderboard"}"#, "[leaderboard] cannot"),
            (
                r#"{"name": "t", "projected": {"sources": [{"serviceAccountToken": {"path": "t"}}]}}"#,
                "[t] cannot be overridden: strangers' images",
            ),
            (r#"{"emptyDir": {}}"#, "[0].name is not a name"),
        ],
    );
}

#[test]
fn what_a_container_may_not_set_is_refused() {
    refused_in(
        "containers",
        &[
            (r#""agent""#, "[0] is not an object"),
            (
                r#"{"name": "metrics"}"#,
                "[metrics] cannot be overridden: a further container would keep the Pod",
            ),
            (r#"{"name": "agent-01"}"#, "[agent-01] cannot"),
            (
                r#"{"name": "logcopy"}"#,
                "[logcopy] cannot be overridden: it is an init container",
            ),
            (
                r#"{"name": "agent", "image": "mine"}"#,
                "[agent].image cannot be overridden: it is pinned with the run",
            ),
            (
                r#"{"name": "agent", "command": null}"#,
                "[agent].command cannot be overridden: the runner stands",
            ),
            (r#"{"name": "simulator-1", "args": []}"#, "[simulator-1].args cannot"),
            (
                r#"{"name": "agent", "terminationMessagePath": "/x"}"#,
                "[agent].terminationMessagePath cannot",
            ),
            (
                r#"{"name": "agent", "restartPolicy": "Never"}"#,
                "[agent].restartPolicy cannot",
            ),
            (
                r#"{"name": "agent", "env": [{"name": "ROUTES", "value": "x"}]}"#,
                "[agent].env[ROUTES] cannot be overridden: it follows from the plan",
            ),
        ],
    );
}

#[test]
fn what_an_init_container_may_not_set_is_refused() {
    refused_in(
        "initContainers",
        &[
            (
                r#"{"name": "agent"}"#,
                "[agent] cannot be overridden: it belongs to containers",
            ),
            (
                r#"{"name": "logcopy", "restartPolicy": null}"#,
                "[logcopy].restartPolicy cannot",
            ),
            (r#"{"name": "workspace", "image": "x"}"#, "[workspace].image cannot"),
            (r#"{"name": "logcopy", "env": null}"#, "[logcopy].env is not a list"),
            (
                r#"{"name": "workspace", "env": [{"name": "LEADERBOARD_RUN"}]}"#,
                "[workspace].env[LEADERBOARD_RUN] cannot",
            ),
            (
                r#"{"name": "logcopy", "env": [{"name": "AWS_SECRET_ACCESS_KEY", "value": "x"}]}"#,
                "[logcopy].env[AWS_SECRET_ACCESS_KEY] cannot be overridden: it is the container's task or identity",
            ),
        ],
    );
}

#[test]
fn what_may_not_be_mounted_is_refused() {
    for (mount, why) in [
        (
            r#"{"name": "x", "mountPath": "/tmp/status/agent-2"}"#,
            "the operator mounts /tmp/status",
        ),
        (
            r#"{"name": "x", "mountPath": "/tmp//x/../status/./"}"#,
            "the operator mounts /tmp/status",
        ),
        (
            r#"{"name": "x", "mountPath": "/leaderboard-tools"}"#,
            "the operator mounts /leaderboard-tools",
        ),
        (
            r#"{"name": "x", "mountPath": "/logs/agent"}"#,
            "the operator mounts /logs",
        ),
        (
            r#"{"name": "x", "mountPath": "/etc/hosts"}"#,
            "the operator mounts /etc/hosts",
        ),
        (
            r#"{"name": "logs", "mountPath": "/all"}"#,
            "volume logs is mounted by the operator alone",
        ),
        (
            r#"{"name": "identity", "mountPath": "/i"}"#,
            "volume identity is mounted by the operator alone",
        ),
        (
            r#"{"name": "leaderboard", "mountPath": "/lb"}"#,
            "volume leaderboard holds the contents; mount it with readOnly true",
        ),
    ] {
        for (list, container) in [
            ("containers", "agent"),
            ("initContainers", "logcopy"),
            ("initContainers", "mine"),
        ] {
            let entry = format!(r#"{{"name": "{container}", "volumeMounts": [{mount}]}}"#);
            let expected = format!("[{container}].volumeMounts[0] cannot be overridden: {why}");
            refused_in(list, &[(&entry, &expected)]);
        }
    }
}

#[test]
fn mounts_of_another_shape_are_refused() {
    refused_in(
        "containers",
        &[
            (
                r#"{"name": "agent", "volumeMounts": null}"#,
                "[agent].volumeMounts is not a list",
            ),
            (
                r#"{"name": "agent", "volumeMounts": [{"name": "x"}]}"#,
                "[agent].volumeMounts[0].mountPath is not a path",
            ),
        ],
    );
}

#[test]
fn a_leaderboards_own_variables_are_checked_too() {
    let spec = |side: &str, name: &str| {
        let mut spec = json!({
            "evaluation": {"carla": {
                "version": "V2", "contents": {"image": "c"}, "simulator": {"image": "s"},
            }}, "tracks": [{"name": "t"}], "storage": {"s3": {"bucket": "bucket"}}, "agent": {},
        });
        let own = match side {
            "agent" => &mut spec["agent"],
            side => &mut spec["evaluation"]["carla"][side],
        };
        own["env"] = json!([{"name": "FINE", "value": "1"}, {"name": name, "value": "2"}]);
        serde_json::from_value(spec).unwrap()
    };
    assert_eq!(validate(&spec("agent", "RECORD_PATH")), Ok(()));
    assert_eq!(validate(&spec("contents", "LEADERBOARD_ROOT")), Ok(()));
    for (side, path) in [("agent", "agent"), ("simulator", "evaluation.carla.simulator")] {
        let error = validate(&spec(side, "CARLA_PORT")).unwrap_err().to_string();
        assert!(
            error.starts_with(&format!(
                "{path}.env[CARLA_PORT] cannot be overridden: it follows from the plan"
            )),
            "{error}"
        );
    }
}
