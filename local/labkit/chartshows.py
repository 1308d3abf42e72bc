"""Owns what each value of the chart changes in the objects that it renders. Data only, read by `chartrender`.

Every value of values.yaml has a case here, and every template renders an object in one: `chartrender` refuses a gap.
"""

from .chartcases import RELEASE, SYSTEM
from .chartshown import (
    ABSENT,
    BRIDGE,
    CONTAINER,
    CONTROLLER,
    CRD,
    HOOK,
    POD,
    ROLE,
    TEST,
    TESTED,
    Case,
    both,
    case,
    env,
    key_of_secret,
    selector,
)


def of_program(component: str, deployment: str) -> list[Case]:
    """Values that both programs have, with defaults in the rendering without them."""
    return [*replicas(component, deployment), *placement(component, deployment), *own_objects(component, deployment)]


def replicas(component: str, deployment: str) -> list[Case]:
    budget = f"PodDisruptionBudget/{RELEASE}-{component}"
    return [
        case(
            {f"{component}.replicas": 3},
            (deployment, "spec.replicas", 3),
            (deployment, "spec.strategy.rollingUpdate", {"maxSurge": 1, "maxUnavailable": 0}),
            (budget, "spec.selector.matchLabels", selector(component)),
        ),
        case(
            {f"{component}.replicas": 1},
            (deployment, "spec.strategy.rollingUpdate", {"maxSurge": 0, "maxUnavailable": 1}),
            # It would block the drain of the node.
            (budget, "", ABSENT),
        ),
        case(
            {
                f"{component}.replicas": 3,
                f"{component}.podDisruptionBudget": {"enabled": True, "maxUnavailable": "50%"},
            },
            (budget, "spec.maxUnavailable", "50%"),
            (budget, "spec.unhealthyPodEvictionPolicy", "AlwaysAllow"),
        ),
        case(
            {f"{component}.replicas": 3, f"{component}.podDisruptionBudget.enabled": False},
            (budget, "", ABSENT),
        ),
    ]


def placement(component: str, deployment: str) -> list[Case]:
    affinity = {"nodeAffinity": {"preferredDuringSchedulingIgnoredDuringExecution": []}}
    spread = {"maxSkew": 1, "topologyKey": "topology.kubernetes.io/zone", "whenUnsatisfiable": "ScheduleAnyway"}
    own = {"matchLabels": selector(component)}
    foreign = {"matchExpressions": [{"key": "app", "operator": "Exists"}]}
    apart = f"{POD}.affinity.podAntiAffinity.preferredDuringSchedulingIgnoredDuringExecution.0.podAffinityTerm"
    return [
        case(
            {},
            (deployment, f"{apart}.topologyKey", "kubernetes.io/hostname"),
            (deployment, f"{apart}.labelSelector.matchLabels", selector(component)),
        ),
        case(
            {f"{component}.affinity": affinity},
            (deployment, f"{POD}.affinity", affinity),
            (deployment, f"{POD}.affinity.podAntiAffinity", ABSENT),
        ),
        case(
            {f"{component}.topologySpreadConstraints": [{**spread, "labelSelector": foreign}, spread]},
            (deployment, f"{POD}.topologySpreadConstraints.0", {**spread, "labelSelector": foreign}),
            (deployment, f"{POD}.topologySpreadConstraints.0.labelSelector.matchLabels", ABSENT),
            (deployment, f"{POD}.topologySpreadConstraints.1", {**spread, "labelSelector": own}),
            (deployment, f"{POD}.topologySpreadConstraints.1.labelSelector.matchExpressions", ABSENT),
        ),
    ]


def own_objects(component: str, deployment: str) -> list[Case]:
    """Its account, what it may use, and what its Pods are marked with."""
    name = f"{RELEASE}-{component}"
    return [
        case(
            {
                f"{component}.roleARN": ROLE,
                f"{component}.serviceAccount": {"name": "own", "annotations": {"team": "one"}},
            },
            ("ServiceAccount/own", "metadata.annotations", {"eks.amazonaws.com/role-arn": ROLE, "team": "one"}),
            (deployment, f"{POD}.serviceAccountName", "own"),
            (f"RoleBinding/{name}", "subjects.0.name", "own"),
        ),
        case(
            {f"{component}.resources": {"requests": {"cpu": "1"}, "limits": {"memory": "1Gi"}}},
            (deployment, f"{CONTAINER}.resources", {"requests": {"cpu": "1"}, "limits": {"memory": "1Gi"}}),
        ),
        case(
            {f"{component}.podAnnotations": {"team": "one"}},
            (deployment, "spec.template.metadata.annotations", {"team": "one"}),
            (deployment, "metadata.annotations", ABSENT),
        ),
        case(
            {f"{component}.podLabels": {"team": "one"}},
            (deployment, "spec.template.metadata.labels", {"team": "one", **selector(component)}),
            (deployment, "metadata.labels.team", ABSENT),
            (deployment, "spec.selector.matchLabels.team", ABSENT),
        ),
    ]


POD_VALUES = [
    *both("nodeSelector", {"pool": "system"}, f"{POD}.nodeSelector", {"pool": "system"}),
    *both("tolerations", [{"operator": "Exists"}], f"{POD}.tolerations", [{"operator": "Exists"}]),
    *both("priorityClassName", "system-cluster-critical", f"{POD}.priorityClassName", "system-cluster-critical"),
    *both(
        "extraVolumes",
        [{"name": "ca", "configMap": {"name": "ca"}}],
        f"{POD}.volumes",
        [{"name": "ca", "configMap": {"name": "ca"}}],
    ),
    *both(
        "extraVolumeMounts",
        [{"name": "ca", "mountPath": "/etc/ca"}],
        f"{CONTAINER}.volumeMounts",
        [{"name": "ca", "mountPath": "/etc/ca"}],
    ),
]

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
        {"commonAnnotations": {"team": "one"}, "leaderboards": [{"namespace": "a", "secrets": ["b"]}]},
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
        (CONTROLLER, f"{CONTAINER}.image", f"leaderboard-operator:v1@sha256:{'0' * 64}"),
    ),
    case({"imagePullSecrets": [{"name": "one"}]}, (BRIDGE, f"{POD}.imagePullSecrets", [{"name": "one"}])),
    # The user is the platform's to choose.
    case(
        {"podSecurityContext": {"runAsUser": None, "runAsGroup": None, "fsGroup": None}},
        (CONTROLLER, f"{POD}.securityContext", {"runAsNonRoot": True, "seccompProfile": {"type": "RuntimeDefault"}}),
        (CONTROLLER, f"{POD}.securityContext.runAsUser", ABSENT),
    ),
    case(
        {"podSecurityContext": {"runAsNonRoot": True, "seccompProfile": {"type": "Unconfined"}}},
        (BRIDGE, f"{POD}.securityContext", {"runAsUser": 60973, "seccompProfile": {"type": "Unconfined"}}),
    ),
    case(
        {
            "securityContext": {
                "allowPrivilegeEscalation": False,
                "readOnlyRootFilesystem": False,
                "capabilities": {"drop": ["NET_RAW"]},
            }
        },
        (
            BRIDGE,
            f"{CONTAINER}.securityContext",
            {"readOnlyRootFilesystem": False, "capabilities": {"drop": ["NET_RAW"]}},
        ),
    ),
]

PROGRAMS = [
    case(
        {"allNamespaces": True, "leaderboards": [{"namespace": "*", "queues": ["shared-*"]}]},
        (CONTROLLER, f"{CONTAINER}.env", [env("LEADERBOARD_NAMESPACES", "")]),
        (
            BRIDGE,
            f"{CONTAINER}.env",
            [env("LEADERBOARD_ALLOWED", '{"*":{"queues":["shared-*"]}}')],
        ),
        (f"ClusterRoleBinding/{RELEASE}-bridge", "roleRef.kind", "ClusterRole"),
        (f"Role/{RELEASE}-controller", "", ABSENT),
    ),
    case(
        {},
        (CONTROLLER, f"{CONTAINER}.env", [env("LEADERBOARD_NAMESPACES", SYSTEM), env("LEADERBOARD_ALLOWED", "{}")]),
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
    case(
        {
            "leaderboards": [
                {
                    "namespace": "boards",
                    "secrets": ["evalai"],
                    "secretsManager": ["evalai/*"],
                    "queues": ["submissions*"],
                    "buckets": ["results/boards/*"],
                    "tables": ["rows"],
                    "logGroups": ["logs"],
                }
            ]
        },
        (
            CONTROLLER,
            f"{CONTAINER}.env",
            [
                env("LEADERBOARD_NAMESPACES", "boards"),
                env("LEADERBOARD_CLUSTER_RIGHTS", "true"),
                env(
                    "LEADERBOARD_ALLOWED",
                    '{"boards":{"buckets":["results/boards/*"],"logGroups":["logs"],"queues":["submissions*"],'
                    '"secretsManager":["evalai/*"],"tables":["rows"]}}',
                ),
            ],
        ),
        (f"Role/{RELEASE}-controller", "metadata.namespace", "boards"),
        (f"RoleBinding/{RELEASE}-bridge", "roleRef.kind", "Role"),
        (f"RoleBinding/{RELEASE}-bridge", "metadata.namespace", "boards"),
        (f"Role/{RELEASE}-secrets", "metadata.namespace", "boards"),
        (f"Role/{RELEASE}-secrets", "rules.0.resourceNames", ["evalai"]),
        (f"RoleBinding/{RELEASE}-secrets", "subjects.0.namespace", SYSTEM),
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
        {"controller.page.enabled": True},
        (CONTROLLER, f"{CONTAINER}.env", [env("LEADERBOARD_DASHBOARD", "8081")]),
        (CONTROLLER, f"{CONTAINER}.ports.1", {"name": "page", "containerPort": 8081}),
        (BRIDGE, f"{CONTAINER}.ports.1", ABSENT),
        # It is read through the API server alone, on loopback of its Pod.
        (f"Service/{RELEASE}-controller", "spec.ports.1", ABSENT),
        (f"Role/{RELEASE}-page", "metadata.namespace", SYSTEM),
        (f"Role/{RELEASE}-page", "rules.1.resources", ["pods/portforward"]),
    ),
    case({"controller.concurrency": 32}, (CONTROLLER, f"{CONTAINER}.env", [env("LEADERBOARD_CONCURRENCY", "32")])),
    case(
        {"revisionHistoryLimit": 3},
        (CONTROLLER, "spec.revisionHistoryLimit", 3),
        (BRIDGE, "spec.revisionHistoryLimit", 3),
    ),
    case({"controller.extraEnv": [env("A", "1")]}, (CONTROLLER, f"{CONTAINER}.env", [env("A", "1")])),
    case({"bridge.extraEnv": [env("A", "1")]}, (BRIDGE, f"{CONTAINER}.env", [env("A", "1")])),
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
    case({"crds.install": False}, (CRD, "", ABSENT)),
    case({"crds.keep": True}, (CRD, "metadata.annotations", {"helm.sh/resource-policy": "keep"})),
    case({"crds.keep": False}, (CRD, "metadata.annotations", ABSENT)),
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
        {"dashboard": {"enabled": True, "namespace": "grafana", "labels": {"grafana": "1"}, "annotations": {"a": "b"}}},
        (f"ConfigMap/{RELEASE}-dashboard", "metadata.namespace", "grafana"),
        (f"ConfigMap/{RELEASE}-dashboard", "metadata.labels", {"grafana": "1", "grafana_dashboard": "1"}),
        (f"ConfigMap/{RELEASE}-dashboard", "metadata.annotations", {"a": "b"}),
    ),
    case({"dashboard.enabled": True}, (f"ConfigMap/{RELEASE}-dashboard", "metadata.namespace", SYSTEM)),
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
    *of_program("controller", CONTROLLER),
    *of_program("bridge", BRIDGE),
    *POD_VALUES,
    *NETWORK,
    *WATCHING,
)
