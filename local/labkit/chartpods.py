"""Owns what the chart's values of Pods change: for both programs, and for one of them. Data only, read by `chartshows`."""

from typing import Any

from .chartcases import RELEASE, SYSTEM
from .chartshown import (
    ABSENT,
    ARCHITECTURES,
    BRIDGE,
    CONTAINER,
    CONTROLLER,
    POD,
    ROLE,
    TEST,
    TESTED,
    Case,
    case,
    env,
    selector,
)

PROGRAMS = {"controller": CONTROLLER, "bridge": BRIDGE}
SIDE = {"name": "side", "image": "registry.example/side:1"}
NODES = {"key": "pool", "operator": "In", "values": ["system"]}
APART = f"{POD}.affinity.podAntiAffinity"
PREFERRED = "preferredDuringSchedulingIgnoredDuringExecution"
SPREAD = {"maxSkew": 1, "topologyKey": "topology.kubernetes.io/zone", "whenUnsatisfiable": "ScheduleAnyway"}
RECREATE = {"type": "Recreate"}
# Value, what is given, where it is seen in a Deployment, and what is seen there.
POD_VALUES: tuple[tuple[str, Any, str, Any], ...] = (
    ("serviceAccount.automount", False, f"{POD}.automountServiceAccountToken", False),
    ("deploymentAnnotations", {"a": "b"}, "metadata.annotations", {"a": "b"}),
    ("podAnnotations", {"a": "b"}, "spec.template.metadata.annotations", {"a": "b"}),
    ("podLabels", {"a": "b"}, "spec.template.metadata.labels", {"a": "b"}),
    ("podSecurityContext", {"fsGroup": 7}, f"{POD}.securityContext", {"fsGroup": 7, "runAsUser": 60973}),
    (
        "securityContext",
        {"readOnlyRootFilesystem": False},
        f"{CONTAINER}.securityContext",
        {"readOnlyRootFilesystem": False, "capabilities": {"drop": ["ALL"]}},
    ),
    ("imagePullSecrets", [{"name": "one"}], f"{POD}.imagePullSecrets", [{"name": "one"}]),
    ("nodeSelector", {"pool": "system"}, f"{POD}.nodeSelector", {"pool": "system"}),
    ("tolerations", [{"operator": "Exists"}], f"{POD}.tolerations", [{"operator": "Exists"}]),
    ("priorityClassName", "system-cluster-critical", f"{POD}.priorityClassName", "system-cluster-critical"),
    ("runtimeClassName", "gvisor", f"{POD}.runtimeClassName", "gvisor"),
    ("schedulerName", "own", f"{POD}.schedulerName", "own"),
    ("hostNetwork", True, f"{POD}.hostNetwork", True),
    ("dnsPolicy", "Default", f"{POD}.dnsPolicy", "Default"),
    ("dnsConfig", {"searches": ["example"]}, f"{POD}.dnsConfig", {"searches": ["example"]}),
    (
        "hostAliases",
        [{"ip": "10.0.0.1", "hostnames": ["s3"]}],
        f"{POD}.hostAliases",
        [{"ip": "10.0.0.1", "hostnames": ["s3"]}],
    ),
    ("strategy", RECREATE, "spec.strategy", RECREATE),
    ("strategy", RECREATE, "spec.strategy.rollingUpdate", ABSENT),
    (
        "livenessProbe",
        {"failureThreshold": 9},
        f"{CONTAINER}.livenessProbe",
        {
            "failureThreshold": 9,
            "periodSeconds": 10,
            "timeoutSeconds": 5,
            "httpGet": {"path": "/livez", "port": "http"},
        },
    ),
    (
        "readinessProbe",
        {"initialDelaySeconds": 3},
        f"{CONTAINER}.readinessProbe",
        {"initialDelaySeconds": 3, "periodSeconds": 5, "timeoutSeconds": 5, "httpGet": {"path": "/readyz"}},
    ),
    ("extraArgs", ["--log-format=text"], f"{CONTAINER}.args", ["--log-format=text"]),
    ("extraEnv", [env("A", "1")], f"{CONTAINER}.env", [env("A", "1"), env("LEADERBOARD_HTTP", "0.0.0.0:8080")]),
    (
        "extraVolumes",
        [{"name": "ca", "configMap": {"name": "ca"}}],
        f"{POD}.volumes",
        [{"name": "ca", "configMap": {"name": "ca"}}],
    ),
    (
        "extraVolumeMounts",
        [{"name": "ca", "mountPath": "/etc/ca"}],
        f"{CONTAINER}.volumeMounts",
        [{"name": "ca", "mountPath": "/etc/ca"}],
    ),
    ("extraContainers", [SIDE], f"{POD}.containers.1", SIDE),
    ("extraInitContainers", [SIDE], f"{POD}.initContainers", [SIDE]),
    ("revisionHistoryLimit", 3, "spec.revisionHistoryLimit", 3),
    (
        "affinity",
        {"podAffinity": {PREFERRED: []}},
        f"{POD}.affinity",
        {"podAffinity": {PREFERRED: []}, "nodeAffinity": ARCHITECTURES},
    ),
    ("affinity", {"podAffinity": {PREFERRED: []}}, APART, ABSENT),
    ("topologySpreadConstraints", [SPREAD], f"{POD}.topologySpreadConstraints", [SPREAD]),
)
# As the chart has them without any value, where that is more than nothing.
DEFAULTS = {
    f"{POD}.automountServiceAccountToken": True,
    "metadata.annotations": ABSENT,
    f"{POD}.securityContext": {"fsGroup": 60973},
    f"{CONTAINER}.securityContext": {"readOnlyRootFilesystem": True},
    "spec.strategy": {"type": "RollingUpdate"},
    f"{CONTAINER}.livenessProbe": {"failureThreshold": 6},
    f"{CONTAINER}.readinessProbe": {"periodSeconds": 5},
    f"{CONTAINER}.env": [env("LEADERBOARD_HTTP", "0.0.0.0:8080")],
    "spec.revisionHistoryLimit": 10,
    f"{POD}.affinity": {"nodeAffinity": ARCHITECTURES},
    APART: {},
    "spec.strategy.rollingUpdate": {},
    "spec.template.metadata.labels": {"app.kubernetes.io/part-of": RELEASE},
}


def default_of(component: str, path: str) -> Any:
    if path == "spec.template.metadata.annotations":
        return {"kubectl.kubernetes.io/default-container": component}
    return DEFAULTS.get(path, ABSENT)


def of_both() -> list[Case]:
    """All values for both programs, and all for one of them, which leave the other as it is."""
    shown = [(deployment, path, holds) for deployment in PROGRAMS.values() for _, _, path, holds in POD_VALUES]
    return [case({value: given for value, given, _, _ in POD_VALUES}, *shown), *map(of_one, PROGRAMS)]


def of_one(component: str) -> Case:
    (other,) = PROGRAMS.keys() - {component}
    changed = [(PROGRAMS[component], path, holds) for _, _, path, holds in POD_VALUES]
    kept = [(PROGRAMS[other], path, default_of(other, path)) for _, _, path, _ in POD_VALUES]
    return case({f"{component}.{value}": given for value, given, _, _ in POD_VALUES}, *changed, *kept)


# Of both and of one together.
TOGETHER = [
    case(
        {"nodeSelector": {"pool": "system", "zone": "a"}, "controller.nodeSelector": {"zone": "b"}},
        (CONTROLLER, f"{POD}.nodeSelector", {"pool": "system", "zone": "b"}),
        (BRIDGE, f"{POD}.nodeSelector", {"pool": "system", "zone": "a"}),
        (TEST, "spec.nodeSelector", {"pool": "system", "zone": "b"}),
    ),
    case(
        {"tolerations": [{"key": "a"}], "bridge.tolerations": [{"key": "b"}], "hostNetwork": True},
        (BRIDGE, f"{POD}.tolerations", [{"key": "b"}]),
        (BRIDGE, f"{POD}.tolerations.1", ABSENT),
        (CONTROLLER, f"{POD}.tolerations", [{"key": "a"}]),
        (TEST, "spec.tolerations", [{"key": "a"}]),
    ),
    case({"hostNetwork": True}, (CONTROLLER, f"{POD}.dnsPolicy", "ClusterFirstWithHostNet")),
    # What is off for one program stays off.
    case(
        {"hostNetwork": True, "bridge.hostNetwork": False},
        (BRIDGE, f"{POD}.hostNetwork", ABSENT),
        (BRIDGE, f"{POD}.dnsPolicy", ABSENT),
        (CONTROLLER, f"{POD}.hostNetwork", True),
    ),
    case(
        {"hostNetwork": True, "dnsPolicy": "Default"},
        (CONTROLLER, f"{POD}.dnsPolicy", "Default"),
    ),
    # The user is the platform's to choose.
    case(
        {"podSecurityContext": {"runAsUser": None, "runAsGroup": None, "fsGroup": None}},
        (CONTROLLER, f"{POD}.securityContext", {"runAsNonRoot": True, "seccompProfile": {"type": "RuntimeDefault"}}),
        (CONTROLLER, f"{POD}.securityContext.runAsUser", ABSENT),
        (TEST, "spec.securityContext.runAsUser", ABSENT),
    ),
    case(
        {
            "podSecurityContext": {"runAsNonRoot": True, "seccompProfile": {"type": "Unconfined"}},
            "securityContext": {"allowPrivilegeEscalation": False, "capabilities": {"drop": ["NET_RAW"]}},
        },
        (BRIDGE, f"{POD}.securityContext", {"runAsUser": 60973, "seccompProfile": {"type": "Unconfined"}}),
        (TEST, f"{TESTED}.securityContext.capabilities", {"drop": ["NET_RAW"]}),
    ),
    case(
        {
            "livenessProbe": {"periodSeconds": 20, "timeoutSeconds": 9, "failureThreshold": 2},
            "readinessProbe": {"periodSeconds": 9, "timeoutSeconds": 2},
        },
        (CONTROLLER, f"{CONTAINER}.livenessProbe", {"periodSeconds": 20, "timeoutSeconds": 9, "failureThreshold": 2}),
        (CONTROLLER, f"{CONTAINER}.readinessProbe", {"periodSeconds": 9, "timeoutSeconds": 2}),
    ),
    case(
        {"podLabels": {"team": "one"}},
        (CONTROLLER, "metadata.labels.team", ABSENT),
        (CONTROLLER, "spec.selector.matchLabels.team", ABSENT),
    ),
]


def nodes(*expressions: dict[str, Any]) -> dict[str, Any]:
    return {
        "requiredDuringSchedulingIgnoredDuringExecution": {
            "nodeSelectorTerms": [{"matchExpressions": list(expressions)}]
        }
    }


TERMS = f"{POD}.affinity.nodeAffinity.requiredDuringSchedulingIgnoredDuringExecution.nodeSelectorTerms"
WHERE = [
    case(
        {"image.architectures": ["amd64", "arm64"]},
        (CONTROLLER, f"{TERMS}.0.matchExpressions.0.values", ["amd64", "arm64"]),
        (BRIDGE, f"{TERMS}.0.matchExpressions.0", {"key": "kubernetes.io/arch", "operator": "In"}),
        (TEST, f"{TERMS.removeprefix('spec.template.')}.0.matchExpressions.0.values", ["arm64"]),
    ),
    case(
        {"image.architectures": []},
        (CONTROLLER, f"{POD}.affinity.nodeAffinity", ABSENT),
        (CONTROLLER, APART, {}),
        (TEST, "spec.affinity", ABSENT),
    ),
    # Beside what is required of nodes already, in each of its terms.
    case(
        {"affinity.nodeAffinity": nodes(NODES)},
        (CONTROLLER, f"{TERMS}.0.matchExpressions.0", NODES),
        (CONTROLLER, f"{TERMS}.0.matchExpressions.1", {"key": "kubernetes.io/arch", "values": ["amd64"]}),
        (CONTROLLER, f"{TERMS}.1", ABSENT),
    ),
    # Who selects the architecture knows it.
    case(
        {"nodeSelector": {"kubernetes.io/arch": "arm64"}},
        (BRIDGE, f"{POD}.nodeSelector", {"kubernetes.io/arch": "arm64"}),
        (BRIDGE, f"{POD}.affinity.nodeAffinity", ABSENT),
    ),
]


def replicas(component: str, deployment: str) -> list[Case]:
    budget, own = f"PodDisruptionBudget/{RELEASE}-{component}", f"{component}.podDisruptionBudget"
    three = {f"{component}.replicas": 3}
    return [
        case(
            three,
            (deployment, "spec.replicas", 3),
            (deployment, "spec.strategy.rollingUpdate", {"maxSurge": 1, "maxUnavailable": 0}),
            (budget, "spec.selector.matchLabels", selector(component)),
            (budget, "spec.maxUnavailable", 1),
            (budget, "spec.minAvailable", ABSENT),
            (budget, "spec.unhealthyPodEvictionPolicy", "AlwaysAllow"),
        ),
        case(
            {f"{component}.replicas": 1},
            (deployment, "spec.strategy.rollingUpdate", {"maxSurge": 0, "maxUnavailable": 1}),
            # It would block the drain of the node.
            (budget, "", ABSENT),
        ),
        case({**three, "podDisruptionBudget.maxUnavailable": "50%"}, (budget, "spec.maxUnavailable", "50%")),
        case({**three, f"{own}.maxUnavailable": 2}, (budget, "spec.maxUnavailable", 2)),
        case(
            {**three, "podDisruptionBudget.minAvailable": 1},
            (budget, "spec.minAvailable", 1),
            (budget, "spec.maxUnavailable", ABSENT),
        ),
        case({**three, f"{own}.minAvailable": "30%"}, (budget, "spec.minAvailable", "30%")),
        case({**three, "podDisruptionBudget.enabled": False}, (budget, "", ABSENT)),
        case(
            {**three, "podDisruptionBudget.unhealthyPodEvictionPolicy": "IfHealthyBudget"},
            (budget, "spec.unhealthyPodEvictionPolicy", "IfHealthyBudget"),
        ),
    ]


def placement(component: str, deployment: str) -> list[Case]:
    own = {"matchLabels": selector(component)}
    foreign = {"matchExpressions": [{"key": "app", "operator": "Exists"}]}
    apart = f"{APART}.{PREFERRED}.0.podAffinityTerm"
    return [
        case(
            {},
            (deployment, f"{apart}.topologyKey", "kubernetes.io/hostname"),
            (deployment, f"{apart}.labelSelector.matchLabels", selector(component)),
        ),
        case(
            {f"{component}.topologySpreadConstraints": [{**SPREAD, "labelSelector": foreign}, SPREAD]},
            (deployment, f"{POD}.topologySpreadConstraints.0", {**SPREAD, "labelSelector": foreign}),
            (deployment, f"{POD}.topologySpreadConstraints.0.labelSelector.matchLabels", ABSENT),
            (deployment, f"{POD}.topologySpreadConstraints.1", {**SPREAD, "labelSelector": own}),
            (deployment, f"{POD}.topologySpreadConstraints.1.labelSelector.matchExpressions", ABSENT),
        ),
    ]


def account(component: str, deployment: str) -> list[Case]:
    """The account of a program, and what it may use."""
    name = f"{RELEASE}-{component}"
    return [
        case(
            {
                f"{component}.roleARN": ROLE,
                f"{component}.serviceAccount": {"name": "own", "annotations": {"team": "one"}, "labels": {"a": "b"}},
            },
            ("ServiceAccount/own", "metadata.annotations", {"eks.amazonaws.com/role-arn": ROLE, "team": "one"}),
            ("ServiceAccount/own", "metadata.labels", {"a": "b", "app.kubernetes.io/component": component}),
            (deployment, f"{POD}.serviceAccountName", "own"),
            (f"RoleBinding/{name}", "subjects.0.name", "own"),
        ),
        case(
            {f"{component}.serviceAccount": {"create": False, "name": "made-by-terraform"}},
            ("ServiceAccount/made-by-terraform", "", ABSENT),
            (f"ServiceAccount/{name}", "", ABSENT),
            (deployment, f"{POD}.serviceAccountName", "made-by-terraform"),
            (f"RoleBinding/{name}", "subjects.0.name", "made-by-terraform"),
        ),
        case(
            {"serviceAccount": {"annotations": {"team": "one"}, "labels": {"a": "b"}, "automount": False}},
            (f"ServiceAccount/{name}", "metadata", {"annotations": {"team": "one"}}),
            (f"ServiceAccount/{name}", "metadata.labels", {"a": "b"}),
            (f"ServiceAccount/{name}", "automountServiceAccountToken", False),
            # `helm test` asks the API server too.
            (TEST, "spec.automountServiceAccountToken", True),
        ),
        case({"serviceAccount.create": False}, (f"ServiceAccount/{name}", "", ABSENT)),
        case({"serviceAccount.create": True}, (f"ServiceAccount/{name}", "automountServiceAccountToken", True)),
        # One for both is rendered once.
        case(
            {"serviceAccount.name": "one"},
            ("ServiceAccount/one", "metadata.namespace", SYSTEM),
            (deployment, f"{POD}.serviceAccountName", "one"),
            (f"RoleBinding/{name}", "subjects.0.name", "one"),
        ),
        case(
            {f"{component}.resources": {"requests": {"cpu": "1"}, "limits": {"memory": "1Gi"}}},
            (deployment, f"{CONTAINER}.resources", {"requests": {"cpu": "1"}, "limits": {"memory": "1Gi"}}),
        ),
    ]


CASES: tuple[Case, ...] = (
    *of_both(),
    *(
        one
        for component, deployment in PROGRAMS.items()
        for group in (replicas, placement, account)
        for one in group(component, deployment)
    ),
    *TOGETHER,
    *WHERE,
)
