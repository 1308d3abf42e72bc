"""Owns what each value of the chart changes in the objects that it renders. Data only, read by `chartrender`.

Every value of values.yaml has a case here, and every template renders an object in one: `chartrender` refuses a gap.
"""

from . import chartpods
from .chartcases import RELEASE, SYSTEM
from .chartshown import (
    ABSENT,
    BRIDGE,
    CONTAINER,
    CONTROLLER,
    CRD,
    HOOK,
    POD,
    TEST,
    TESTED,
    Case,
    case,
    env,
    key_of_secret,
    selector,
)

NAMES = [
    case(
        {"nameOverride": "boards"},
        (f"Deployment/{RELEASE}-boards-controller", "spec.selector.matchLabels", {"app.kubernetes.io/name": "boards"}),
        (
            f"Deployment/{RELEASE}-boards-controller",
            "spec.template.metadata.labels",
            {"app.kubernetes.io/name": "boards"},
        ),
        (f"Service/{RELEASE}-boards-bridge", "spec.selector", {"app.kubernetes.io/name": "boards"}),
    ),
    case(
        {"fullnameOverride": "boards"},
        ("Deployment/boards-controller", f"{POD}.serviceAccountName", "boards-controller"),
        ("Deployment/boards-controller", f"{CONTAINER}.env", [env("LEADERBOARD_LEASE", "boards")]),
        ("ServiceAccount/boards-bridge", "metadata.namespace", SYSTEM),
        ("Role/boards-lease", "rules.1.resourceNames", ["boards"]),
        ("ClusterRole/boards-view", "metadata.labels", {"app.kubernetes.io/part-of": RELEASE}),
        ("PodDisruptionBudget/boards-controller", "metadata.namespace", SYSTEM),
    ),
    case(
        {"commonLabels": {"team": "one"}},
        (CONTROLLER, "metadata.labels", {"team": "one"}),
        (CONTROLLER, "spec.template.metadata.labels", {"team": "one"}),
        (CONTROLLER, "spec.selector.matchLabels.team", ABSENT),
        (f"Role/{RELEASE}-lease", "metadata.labels", {"team": "one"}),
        (f"Role/{RELEASE}-bridge", "metadata.labels", {"team": "one"}),
        (f"Service/{RELEASE}-bridge", "metadata.labels", {"team": "one"}),
        (f"Service/{RELEASE}-bridge", "spec.selector.team", ABSENT),
        (CRD, "metadata.labels", ABSENT),
    ),
    case(
        {"commonAnnotations": {"team": "one"}, "namespaces": [{"name": "a", "secrets": ["b"]}]},
        (CONTROLLER, "metadata.annotations", {"team": "one"}),
        (CONTROLLER, "spec.template.metadata.annotations.team", ABSENT),
        (f"Role/{RELEASE}-secrets", "metadata.annotations", {"team": "one"}),
        (f"RoleBinding/{RELEASE}-bridge", "metadata.annotations", {"team": "one"}),
        (f"ServiceAccount/{RELEASE}-bridge", "metadata.annotations", {"team": "one"}),
    ),
    # What is the object's own goes before what is common to all.
    case(
        {"commonLabels": {"team": "one"}, "controller.podLabels": {"team": "two"}, "service.labels": {"team": "three"}},
        (CONTROLLER, "spec.template.metadata.labels", {"team": "two"}),
        (f"Service/{RELEASE}-bridge", "metadata.labels", {"team": "three"}),
    ),
]

IMAGE = [
    case(
        {"image": {"repository": "registry.example/operator", "tag": "v1", "pullPolicy": "Always"}},
        (CONTROLLER, f"{CONTAINER}.image", "registry.example/operator:v1"),
        (BRIDGE, f"{CONTAINER}.imagePullPolicy", "Always"),
        (
            CONTROLLER,
            f"{CONTAINER}.env",
            [env("LEADERBOARD_IMAGE", "registry.example/operator:v1"), env("LEADERBOARD_IMAGE_PULL_POLICY", "Always")],
        ),
    ),
    case(
        {"image.digest": f"sha256:{'0' * 64}", "image.tag": "v1"},
        (CONTROLLER, f"{CONTAINER}.image", f"registry.example/leaderboard-operator:v1@sha256:{'0' * 64}"),
    ),
    # A mirror has the images of several charts; a registry of the chart's own goes before it.
    case(
        {
            "image": {"repository": "boards/operator", "tag": "1"},
            "global": {"imageRegistry": "mirror.example", "other": 1},
        },
        (CONTROLLER, f"{CONTAINER}.image", "mirror.example/boards/operator:1"),
        (TEST, f"{TESTED}.image", "mirror.example/boards/operator:1"),
    ),
    case(
        {
            "image": {"registry": "own.example", "repository": "operator", "tag": "1"},
            "global.imageRegistry": "mirror.example",
        },
        (BRIDGE, f"{CONTAINER}.image", "own.example/operator:1"),
        (CONTROLLER, f"{CONTAINER}.env", [env("LEADERBOARD_IMAGE", "own.example/operator:1")]),
    ),
    case(
        {"global.imagePullSecrets": [{"name": "all"}], "imagePullSecrets": [{"name": "one"}, {"name": "all"}]},
        (BRIDGE, f"{POD}.imagePullSecrets.0", {"name": "all"}),
        (BRIDGE, f"{POD}.imagePullSecrets.1", {"name": "one"}),
        (BRIDGE, f"{POD}.imagePullSecrets.2", ABSENT),
        (TEST, "spec.imagePullSecrets.1", {"name": "one"}),
    ),
]

LOGIN = {"name": "login", "image": "registry.example/oauth2-proxy:1"}
# Every role and binding of an installation with the page.
GRANTS = (
    *((kind, name) for name in ("controller", "bridge", "lease", "secrets") for kind in ("Role", "RoleBinding")),
    *(("Role", "page"), ("ClusterRole", "cluster"), ("ClusterRoleBinding", "cluster")),
    *(("ClusterRole", name) for name in ("view", "edit", "host")),
)
ALLOWED = (
    '{"buckets":["results/boards/*"],"logGroups":["logs"],"queues":["submissions*"],'
    '"secretsManager":["evalai/*"],"tables":["rows"]}'
)

PROGRAMS = [
    case(
        {"allNamespaces": True, "allow.queues": ["shared-*"], "namespaces": [{"name": "a", "queues": ["own"]}]},
        (CONTROLLER, f"{CONTAINER}.env", [env("LEADERBOARD_NAMESPACES", "")]),
        (
            BRIDGE,
            f"{CONTAINER}.env",
            [env("LEADERBOARD_ALLOWED", '{"*":{"queues":["shared-*"]},"a":{"queues":["shared-*","own"]}}')],
        ),
        (f"ClusterRoleBinding/{RELEASE}-bridge", "roleRef.kind", "ClusterRole"),
        (f"Role/{RELEASE}-controller", "", ABSENT),
    ),
    case(
        {},
        (
            CONTROLLER,
            f"{CONTAINER}.env",
            [env("LEADERBOARD_NAMESPACES", SYSTEM), env("LEADERBOARD_ALLOWED", f'{{"{SYSTEM}":{{}}}}')],
        ),
        (f"Role/{RELEASE}-controller", "metadata.namespace", SYSTEM),
        (f"ClusterRole/{RELEASE}-controller", "", ABSENT),
    ),
    case({"rbac.clusterRole": True}, (f"ClusterRole/{RELEASE}-cluster", "rules.0.resources", ["nodes"])),
    case(
        {"rbac.clusterRole": False},
        (f"ClusterRole/{RELEASE}-cluster", "", ABSENT),
        (f"ClusterRoleBinding/{RELEASE}-cluster", "", ABSENT),
        (CONTROLLER, f"{CONTAINER}.env", [env("LEADERBOARD_CLUSTER_RIGHTS", "false")]),
    ),
    # A list of names, and what all of them may name.
    case(
        {
            "namespaces": ["boards", "arena"],
            "allow": {
                "secrets": ["evalai"],
                "secretsManager": ["evalai/*"],
                "queues": ["submissions*"],
                "buckets": ["results/boards/*"],
                "tables": ["rows"],
                "logGroups": ["logs"],
            },
        },
        (
            CONTROLLER,
            f"{CONTAINER}.env",
            [
                env("LEADERBOARD_NAMESPACES", "arena,boards"),
                env("LEADERBOARD_CLUSTER_RIGHTS", "true"),
                env("LEADERBOARD_ALLOWED", f'{{"arena":{ALLOWED},"boards":{ALLOWED}}}'),
            ],
        ),
        (f"Role/boards/{RELEASE}-controller", "rules.0.resources", ["leaderboards"]),
        (f"RoleBinding/arena/{RELEASE}-bridge", "roleRef.kind", "Role"),
        (f"Role/arena/{RELEASE}-secrets", "rules.0.resourceNames", ["evalai"]),
        (f"RoleBinding/boards/{RELEASE}-secrets", "subjects.0.namespace", SYSTEM),
        (f"Role/{SYSTEM}/{RELEASE}-controller", "", ABSENT),
    ),
    # An entry of its own adds to them, for its namespace alone.
    case(
        {
            "namespaces": ["arena", {"name": "boards", "secrets": ["own"], "buckets": ["own", "shared"]}],
            "allow": {"secrets": ["evalai"], "buckets": ["shared"]},
        },
        (
            BRIDGE,
            f"{CONTAINER}.env",
            [env("LEADERBOARD_ALLOWED", '{"arena":{"buckets":["shared"]},"boards":{"buckets":["shared","own"]}}')],
        ),
        (f"Role/boards/{RELEASE}-secrets", "rules.0.resourceNames", ["evalai", "own"]),
        (f"Role/arena/{RELEASE}-secrets", "rules.0.resourceNames.1", ABSENT),
    ),
    case(
        {"aws": {"region": "eu-central-1", "endpointURL": "http://aws.example:4566", "secretName": "aws"}},
        (
            BRIDGE,
            f"{CONTAINER}.env",
            [
                env("AWS_REGION", "eu-central-1"),
                env("AWS_ENDPOINT_URL", "http://aws.example:4566"),
                key_of_secret("AWS_ACCESS_KEY_ID"),
                key_of_secret("AWS_SESSION_TOKEN", optional=True),
            ],
        ),
    ),
    case(
        {"traces": {"endpoint": "http://collector.example:4318", "ratio": 0.25, "headersSecret": "collector"}},
        (
            CONTROLLER,
            f"{CONTAINER}.env",
            [
                env("OTEL_EXPORTER_OTLP_ENDPOINT", "http://collector.example:4318"),
                env("OTEL_TRACES_SAMPLER", "traceidratio"),
                env("OTEL_TRACES_SAMPLER_ARG", "0.25"),
                {
                    "name": "OTEL_EXPORTER_OTLP_HEADERS",
                    "valueFrom": {"secretKeyRef": {"name": "collector", "key": "OTEL_EXPORTER_OTLP_HEADERS"}},
                },
            ],
        ),
    ),
    case(
        {"webUI.enabled": True},
        (CONTROLLER, f"{CONTAINER}.env", [env("LEADERBOARD_DASHBOARD", "8081")]),
        (CONTROLLER, f"{CONTAINER}.ports.1", {"name": "page", "containerPort": 8081}),
        (BRIDGE, f"{CONTAINER}.ports.1", ABSENT),
        # It is read through the API server alone, on loopback of its Pod.
        (f"Service/{RELEASE}-controller", "spec.ports.1", ABSENT),
        (f"Service/{RELEASE}-page", "", ABSENT),
        (f"Ingress/{RELEASE}-page", "", ABSENT),
        (f"Role/{RELEASE}-page", "metadata.namespace", SYSTEM),
        (f"Role/{RELEASE}-page", "rules.1.resources", ["pods/portforward"]),
    ),
    case(
        {"webUI": {"enabled": True, "title": "eu-1"}},
        (CONTROLLER, f"{CONTAINER}.env", [env("LEADERBOARD_PAGE_TITLE", "eu-1")]),
    ),
    case({"webUI.enabled": False}, (f"Role/{RELEASE}-page", "", ABSENT), (CONTROLLER, f"{CONTAINER}.ports.1", ABSENT)),
    # Only to a container that asks for a login.
    case(
        {
            "webUI": {
                "enabled": True,
                "service": {
                    "enabled": True,
                    "targetPort": "login",
                    "type": "NodePort",
                    "port": 8000,
                    "labels": {"a": "b"},
                    "annotations": {"c": "d"},
                },
                "ingress": {
                    "enabled": True,
                    "className": "nginx",
                    "host": "board.example",
                    "tlsSecretName": "board",
                    "labels": {"e": "f"},
                    "annotations": {"g": "h"},
                },
            },
            "networkPolicy.enabled": True,
            "controller.extraContainers": [{**LOGIN, "ports": [{"name": "login", "containerPort": 4180}]}],
        },
        (f"Service/{RELEASE}-page", "spec.ports", [{"name": "page", "port": 8000, "targetPort": "login"}]),
        (f"Service/{RELEASE}-page", "spec.selector", selector("controller")),
        (f"Service/{RELEASE}-page", "spec.type", "NodePort"),
        (f"Service/{RELEASE}-page", "metadata", {"labels": {"a": "b"}, "annotations": {"c": "d"}}),
        (f"Ingress/{RELEASE}-page", "metadata", {"labels": {"e": "f"}, "annotations": {"g": "h"}}),
        (f"Ingress/{RELEASE}-page", "spec.ingressClassName", "nginx"),
        (f"Ingress/{RELEASE}-page", "spec.tls.0", {"hosts": ["board.example"], "secretName": "board"}),
        (f"Ingress/{RELEASE}-page", "spec.rules.0.host", "board.example"),
        (
            f"Ingress/{RELEASE}-page",
            "spec.rules.0.http.paths.0",
            {"path": "/", "backend": {"service": {"name": f"{RELEASE}-page", "port": {"name": "page"}}}},
        ),
        (f"NetworkPolicy/{RELEASE}", "spec.ingress.1.ports", [{"port": "login", "protocol": "TCP"}]),
    ),
    case({"controller.concurrency": 32}, (CONTROLLER, f"{CONTAINER}.env", [env("LEADERBOARD_CONCURRENCY", "32")])),
    case(
        {"bridge.enabled": False},
        (BRIDGE, "", ABSENT),
        (f"ServiceAccount/{RELEASE}-bridge", "", ABSENT),
        (f"Role/{RELEASE}-bridge", "", ABSENT),
        (f"Service/{RELEASE}-bridge", "", ABSENT),
    ),
    case(
        {"log": {"format": "text", "level": "debug"}},
        (CONTROLLER, f"{CONTAINER}.env", [env("LEADERBOARD_LOG_FORMAT", "text"), env("RUST_LOG", "debug")]),
    ),
    case({"crds.enabled": False}, (CRD, "", ABSENT)),
    case({"crds.keep": True}, (CRD, "metadata.annotations", {"helm.sh/resource-policy": "keep"})),
    case({"crds.keep": False}, (CRD, "metadata.annotations", ABSENT)),
    case(
        {"rbac.create": False, "webUI.enabled": True, "allow.secrets": ["evalai"]},
        *((f"{kind}/{RELEASE}-{name}", "", ABSENT) for kind, name in GRANTS),
        (f"ServiceAccount/{RELEASE}-controller", "metadata.namespace", SYSTEM),
    ),
    case(
        {"rbac.create": True, "webUI.enabled": True, "allow.secrets": ["evalai"]},
        *((f"{kind}/{RELEASE}-{name}", "metadata.name", f"{RELEASE}-{name}") for kind, name in GRANTS),
    ),
    case({"rbac.aggregate": False}, (f"ClusterRole/{RELEASE}-edit", "", ABSENT)),
    case(
        {"rbac.aggregate": True},
        (
            f"ClusterRole/{RELEASE}-edit",
            "metadata.labels",
            {
                "rbac.authorization.k8s.io/aggregate-to-edit": "true",
                "rbac.authorization.k8s.io/aggregate-to-admin": "true",
            },
        ),
    ),
]

NETWORK = [
    case(
        {
            "service.type": "NodePort",
            "service.port": 80,
            "service.labels": {"a": "b"},
            "service.annotations": {"c": "d"},
        },
        (f"Service/{RELEASE}-controller", "spec.type", "NodePort"),
        (f"Service/{RELEASE}-controller", "spec.ports", [{"name": "http", "port": 80, "targetPort": "http"}]),
        (f"Service/{RELEASE}-controller", "spec.selector", selector("controller")),
        (f"Service/{RELEASE}-bridge", "metadata", {"labels": {"a": "b"}, "annotations": {"c": "d"}}),
    ),
    case({"service.enabled": False}, (f"Service/{RELEASE}-controller", "", ABSENT), (TEST, f"{TESTED}.args", ABSENT)),
    case({"bridge.enabled": False}, (TEST, f"{TESTED}.args", [f"--ready={RELEASE}-controller"])),
    case({}, (TEST, f"{TESTED}.args", [f"--ready={RELEASE}-bridge"]), (TEST, "metadata.annotations", {HOOK: "test"})),
    case({"allNamespaces": True}, (TEST, f"{TESTED}.env", [env("LEADERBOARD_NAMESPACES", "")])),
    case({}, (f"NetworkPolicy/{RELEASE}", "", ABSENT)),
    case(
        {"networkPolicy.enabled": True},
        (f"NetworkPolicy/{RELEASE}", "spec.policyTypes", ["Ingress", "Egress"]),
        (f"NetworkPolicy/{RELEASE}", "spec.podSelector.matchLabels", {"app.kubernetes.io/instance": RELEASE}),
        (f"NetworkPolicy/{RELEASE}", "spec.podSelector.matchLabels", {"app.kubernetes.io/name": RELEASE}),
        (f"NetworkPolicy/{RELEASE}", "spec.ingress", [{"ports": [{"port": "http", "protocol": "TCP"}]}]),
        (f"NetworkPolicy/{RELEASE}", "spec.ingress.0.from", ABSENT),
        (f"NetworkPolicy/{RELEASE}", "spec.egress.0.ports", [{"port": 53, "protocol": "UDP"}]),
        (f"NetworkPolicy/{RELEASE}", "spec.egress.1.ports", [{"port": 443, "protocol": "TCP"}, {"port": 6443}]),
        (f"NetworkPolicy/{RELEASE}", "spec.egress.2.ports", [{"port": 443, "protocol": "TCP"}]),
        (f"NetworkPolicy/{RELEASE}", "spec.egress.2.to", ABSENT),
    ),
    case(
        {
            "networkPolicy.enabled": True,
            "networkPolicy.ingressFrom": [{"podSelector": {}}],
            "networkPolicy.egress.dnsTo": [{"namespaceSelector": {}}],
            "networkPolicy.egress.apiServer": {"cidrs": ["10.0.0.1/32"], "ports": [6443]},
            "networkPolicy.egress.services": {"cidrs": ["10.1.0.0/16", "fd00::/8"], "ports": [443]},
            "networkPolicy.egress.extra": [{"to": [{"ipBlock": {"cidr": "10.2.0.1/32"}}], "ports": [{"port": 3128}]}],
        },
        (f"NetworkPolicy/{RELEASE}", "spec.ingress.0.from.0", {"podSelector": {}}),
        # `helm test` gets in too, and is not held by the policy itself.
        (f"NetworkPolicy/{RELEASE}", "spec.ingress.0.from.1.podSelector.matchLabels", selector("test")),
        (f"NetworkPolicy/{RELEASE}", "spec.podSelector.matchExpressions.0.values", ["controller", "bridge"]),
        (f"NetworkPolicy/{RELEASE}", "spec.egress.0.to", [{"namespaceSelector": {}}]),
        (f"NetworkPolicy/{RELEASE}", "spec.egress.1.to", [{"ipBlock": {"cidr": "10.0.0.1/32"}}]),
        (f"NetworkPolicy/{RELEASE}", "spec.egress.1.ports", [{"port": 6443, "protocol": "TCP"}]),
        (
            f"NetworkPolicy/{RELEASE}",
            "spec.egress.2.to",
            [{"ipBlock": {"cidr": "10.1.0.0/16"}}, {"ipBlock": {"cidr": "fd00::/8"}}],
        ),
        (f"NetworkPolicy/{RELEASE}", "spec.egress.3.ports", [{"port": 3128}]),
    ),
]


def of_monitor(value: str, kind: str, endpoints: str) -> Case:
    given = {
        "enabled": True,
        "labels": {"release": "prometheus"},
        "annotations": {"a": "b"},
        "interval": "30s",
        "scrapeTimeout": "10s",
        "relabelings": [{"targetLabel": "cluster", "replacement": "one"}],
        "metricRelabelings": [{"action": "labeldrop", "regex": "pod"}],
    }
    return case(
        {f"{value}.{key}": one for key, one in given.items()},
        (f"{kind}/{RELEASE}", "metadata.labels", {"release": "prometheus", "app.kubernetes.io/part-of": RELEASE}),
        (f"{kind}/{RELEASE}", "metadata.annotations", {"a": "b"}),
        (f"{kind}/{RELEASE}", "spec.selector.matchLabels", {"app.kubernetes.io/instance": RELEASE}),
        (f"{kind}/{RELEASE}", "spec.jobLabel", "app.kubernetes.io/component"),
        (
            f"{kind}/{RELEASE}",
            f"spec.{endpoints}",
            [
                {
                    "port": "http",
                    "path": "/metrics",
                    "honorLabels": True,
                    "interval": "30s",
                    "scrapeTimeout": "10s",
                    "relabelings": given["relabelings"],
                    "metricRelabelings": given["metricRelabelings"],
                }
            ],
        ),
        kinds=(kind,),
    )


WATCHING = [
    case(
        {},
        (f"PodMonitor/{RELEASE}", "", ABSENT),
        (f"ServiceMonitor/{RELEASE}", "", ABSENT),
        (f"PrometheusRule/{RELEASE}", "", ABSENT),
        (f"ConfigMap/{RELEASE}-dashboard", "", ABSENT),
        kinds=("PodMonitor", "ServiceMonitor", "PrometheusRule"),
    ),
    of_monitor("podMonitor", "PodMonitor", "podMetricsEndpoints"),
    of_monitor("serviceMonitor", "ServiceMonitor", "endpoints"),
    case(
        {"prometheusRule": {"enabled": True, "labels": {"release": "prometheus"}, "annotations": {"a": "b"}}},
        (f"PrometheusRule/{RELEASE}", "metadata", {"labels": {"release": "prometheus"}, "annotations": {"a": "b"}}),
        (f"PrometheusRule/{RELEASE}", "spec.groups.0.rules.0", {"alert": "LeaderboardOperatorAbsent"}),
        (f"PrometheusRule/{RELEASE}", "spec.groups.0.rules.0.annotations.runbook_url", ABSENT),
        kinds=("PrometheusRule",),
    ),
    case(
        {"prometheusRule": {"enabled": True, "runbooksURL": "https://docs.example/runbooks/"}},
        (
            f"PrometheusRule/{RELEASE}",
            "spec.groups.0.rules.0.annotations.runbook_url",
            "https://docs.example/runbooks/LeaderboardOperatorAbsent.md",
        ),
        kinds=("PrometheusRule",),
    ),
    case(
        {
            "grafanaDashboard": {
                "enabled": True,
                "namespace": "grafana",
                "sidecarLabel": "boards",
                "sidecarLabelValue": "yes",
                "folder": "Leaderboards",
                "folderAnnotation": "example.org/folder",
                "labels": {"team": "one"},
                "annotations": {"a": "b"},
            }
        },
        (f"ConfigMap/{RELEASE}-dashboard", "metadata.namespace", "grafana"),
        (f"ConfigMap/{RELEASE}-dashboard", "metadata.labels", {"boards": "yes", "team": "one"}),
        (f"ConfigMap/{RELEASE}-dashboard", "metadata.labels.grafana_dashboard", ABSENT),
        (f"ConfigMap/{RELEASE}-dashboard", "metadata.annotations", {"a": "b", "example.org/folder": "Leaderboards"}),
    ),
    # As kube-prometheus-stack's sidecar looks for it.
    case(
        {"grafanaDashboard.enabled": True},
        (f"ConfigMap/{RELEASE}-dashboard", "metadata.namespace", SYSTEM),
        (f"ConfigMap/{RELEASE}-dashboard", "metadata.labels", {"grafana_dashboard": "1"}),
        (f"ConfigMap/{RELEASE}-dashboard", "metadata.annotations", ABSENT),
    ),
    case(
        {"grafanaDashboard.enabled": True, "grafanaDashboard.folder": "Leaderboards"},
        (f"ConfigMap/{RELEASE}-dashboard", "metadata.annotations", {"grafana_folder": "Leaderboards"}),
    ),
    case(
        {
            "extraObjects": [
                {"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": "one"}, "data": {"a": "b"}},
                'apiVersion: v1\nkind: ConfigMap\nmetadata:\n  name: {{ .Release.Name }}-two\ndata: {a: "c"}\n',
            ]
        },
        ("ConfigMap/one", "data", {"a": "b"}),
        (f"ConfigMap/{RELEASE}-two", "data", {"a": "c"}),
    ),
]

CASES: tuple[Case, ...] = (
    *NAMES,
    *IMAGE,
    *PROGRAMS,
    *chartpods.CASES,
    *NETWORK,
    *WATCHING,
)
