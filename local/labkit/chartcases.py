"""Owns what the chart must refuse, and what its two accounts must be allowed and not be allowed to do. Data only, read by `charttest`."""

from dataclasses import dataclass
from typing import Any

RELEASE = "leaderboard-operator"
SYSTEM = "leaderboard-system"
NAMESPACES = (SYSTEM, "leaderboard", "carla-10", "carla-20", "other")
# What no rendering is without: the chart knows no image of its own.
IMAGE = {"image.repository": f"registry.example/{RELEASE}"}
# `--set` and every later `--set-json` go before it.
SET_IMAGE = f'--set-json=image.repository="registry.example/{RELEASE}"'
CONTROLLER = f"{RELEASE}-controller"
BRIDGE = f"{RELEASE}-bridge"

# Values that a person may get wrong, and a word that the refusal must hold.
REFUSED: tuple[tuple[tuple[str, ...], str], ...] = (
    (("contoller.replicas=2",), "contoller"),
    (("controller.replica=2",), "replica"),
    (("bridge.enable=false",), "enable"),
    (('bridge.enabled="false"',), "boolean"),
    (('controller.concurrency="16"',), "integer"),
    (("controller.concurrency=0",), "concurrency"),
    (("controller.replicas=-1",), "replicas"),
    (("revisionHistoryLimit=-1",), "revisionHistoryLimit"),
    (("webUI.enable=true",), "enable"),
    (('webUI.enabled="yes"',), "boolean"),
    (('image.repository="registry.example/operator@sha256:0"',), "repository"),
    (('image.digest="0123"',), "digest"),
    (('image.pullPolicy="always"',), "pullPolicy"),
    (('allNamespaces="yes"',), "boolean"),
    (("rbac.clusterRoles=true",), "clusterRoles"),
    (('namespaces="leaderboard"',), "array"),
    (('namespaces=[{"secrets":["evalai"]}]',), "name"),
    (('namespaces=["My_Namespace"]',), "namespaces/0"),
    (('namespaces=["*"]',), "namespaces/0"),
    (('namespaces=[{"name":"leaderboard","queue":["submissions"]}]',), "queue"),
    (('namespaces=["leaderboard",{"name":"leaderboard","queues":["a"]}]',), "there twice"),
    (('allow.queues=["two words"]',), "queues"),
    (('allow.bucket=["results"]',), "bucket"),
    (('allow.buckets=[""]',), "buckets"),
    (('allow.tables="rows"',), "tables"),
    (('allow.logGroups=["logs","logs"]',), "equal"),
    (('allow.secrets=["evalai","evalai"]',), "equal"),
    (("allNamespaces=true", 'allow.secrets=["evalai"]'), "list them in `namespaces`"),
    (('aws.endpointURL="localhost:4566"',), "endpointURL"),
    (('aws.endpointURL="http://user:secret@aws:4566"',), "endpointURL"),
    (('aws.accessKeyId="AKIA"',), "accessKeyId"),
    (('traces.endpoint="collector:4318"',), "endpoint"),
    (('traces.endpoint="http://user:secret@collector:4318"',), "endpoint"),
    (("traces.ratio=2",), "ratio"),
    (('traces.headers="authorization=key"',), "headers"),
    (('controller.roleARN="leaderboard-controller"',), "roleARN"),
    (('log.format="yaml"',), "format"),
    (('crds.enabled="no"',), "boolean"),
    (("crds.install=true",), "install"),
    (('rbac.create="no"',), "boolean"),
    (("serviceAccount.created=true",), "created"),
    (('image.repository=""',), "image.repository=REGISTRY/leaderboard-operator,image.tag=TAG"),
    (('image.registry="https://registry.example"',), "registry"),
    (('image.architectures=["x86_64"]',), "architectures"),
    (("serviceAccount.create=false", 'bridge.roleARN="arn:aws:iam::123456789012:role/one"'), "bridge.roleARN"),
    (
        ('serviceAccount.name="one"', 'bridge.roleARN="arn:aws:iam::123456789012:role/one"'),
        "one role only",
    ),
    (("controller.podLabel.team=a",), "podLabel"),
    (('controller.podLabels={"app.kubernetes.io/component":"bridge"}',), "podLabels"),
    (('commonLabels={"app.kubernetes.io/name":"another"}',), "commonLabels"),
    (('commonLabels={"team":"no label"}',), "commonLabels"),
    (('commonAnnotations={"team":1}',), "string"),
    (('nameOverride="My_Name"',), "nameOverride"),
    ((f'fullnameOverride="{"a" * 49}"',), "fullnameOverride"),
    (('controller.topologySpreadConstraints=[{"maxSkew":1}]',), "topologyKey"),
    (("controller.podDisruptionBudget.maxUnavailable=0",), "maxUnavailable"),
    (('podDisruptionBudget.maxUnavailable="half"',), "maxUnavailable"),
    (("podDisruptionBudget.minAvailable=1", "podDisruptionBudget.maxUnavailable=1"), "not both"),
    (("podDisruptionBudget.minAvailable=2",), "block every drain"),
    (('controller.podDisruptionBudget.minAvailable="100%"',), "block every drain"),
    (("controller.hostNetwrk=true",), "hostNetwrk"),
    (('hostNetwork="yes"',), "boolean"),
    (('dnsPolicy="Cluster"',), "dnsPolicy"),
    (('hostAliases=[{"ip":"10.0.0.1"}]',), "hostnames"),
    (('strategy={"kind":"Recreate"}',), "strategy"),
    (('affinity={"nodeSelector":{}}',), "affinity"),
    (('livenessProbe={"httpGet":{"path":"/"}}',), "livenessProbe"),
    (('readinessProbe.periodSeconds="5"',), "integer"),
    (('extraContainers=[{"name":"side"}]',), "image"),
    (('extraArgs="--log-format=text"',), "array"),
    (('bridge.extraVolumes=[{"name":"ca"}]',), "extraVolumes"),
    (('bridge.extraVolumeMounts=[{"name":"ca"}]',), "mountPath"),
    (('service.type="ExternalName"',), "type"),
    (("service.port=0",), "port"),
    (('networkPolicy.egress.services.cidrs=["10.0.0.1"]',), "cidrs"),
    (("networkPolicy.egress.apiServer.ports=[]",), "ports"),
    (("networkPolicy.egres=true",), "egres"),
    (('podMonitor.interval="30"',), "interval"),
    (("podMonitor.intervall=1",), "intervall"),
    (("prometheusRule.enable=true",), "enable"),
    (('prometheusRule.runbooksURL="docs/runbooks"',), "runbooksURL"),
    (('grafanaDashboard.namespace="My_Namespace"',), "namespace"),
    (('grafanaDashboard.sidecarLabel=""',), "sidecarLabel"),
    (("webUI.service.enabled=true",), "needs webUI.enabled"),
    (("webUI.enabled=true", "webUI.service.enabled=true"), "asks for a login"),
    (("webUI.enabled=true", "webUI.ingress.enabled=true"), "needs webUI.service.enabled"),
    (
        (
            "webUI.enabled=true",
            'webUI.service={"enabled":true,"targetPort":"login"}',
            "webUI.ingress.enabled=true",
            'extraContainers=[{"name":"login","image":"login:1","ports":[{"name":"login","containerPort":1}]}]',
        ),
        "webUI.ingress.host",
    ),
    (('webUI.ingress.host="https://board.example"',), "host"),
    (('extraObjects=[{"kind":"ConfigMap"}]',), "extraObjects"),
    # What the templates refuse: a cluster without the kind, and two values that exclude each other.
    (("podMonitor.enabled=true",), "--api-versions monitoring.coreos.com/v1/PodMonitor"),
    (("serviceMonitor.enabled=true",), "--api-versions monitoring.coreos.com/v1/ServiceMonitor"),
    (("prometheusRule.enabled=true",), "--api-versions monitoring.coreos.com/v1/PrometheusRule"),
    (("podMonitor.enabled=true", "serviceMonitor.enabled=true"), "scraped twice"),
)

# Values, and what the text after an installation then says and does not say.
NOTES: tuple[tuple[dict[str, Any], tuple[str, ...], tuple[str, ...]], ...] = (
    (
        {},
        (
            f"the namespace {SYSTEM}.",
            "Leaderboards elsewhere are left alone",
            f"deployment/{BRIDGE}",
            f"kubectl -n {SYSTEM} apply --filename=-",
            "may name no bucket",
            "--set 'allow.secrets={evalai}'",
            "--set 'allow.buckets={results}'",
            "controller.roleARN and bridge.roleARN",
        ),
        ("all namespaces", "create namespace", "rbac.create", "serviceAccount.create", "evalai:"),
    ),
    (
        {
            "namespaces": ["carla-10"],
            "allow": {
                "secrets": ["evalai"],
                "queues": ["submissions*"],
                "buckets": ["results/*"],
                "tables": ["*"],
                "logGroups": ["logs"],
            },
            "aws": {"secretName": "keys", "region": "eu-central-1"},
        },
        (
            "the namespace carla-10.",
            "namespace carla-10 pod-security",
            "{secretKeyRef: {name: evalai, key: auth_token}}",
            "https://sqs.eu-central-1.amazonaws.com/123456789012/submissionsexample",
            "secretName: keys",
            'bucket: "results", prefix: "example/"',
        ),
        ("left alone", "may name no bucket", "roleARN", "create namespace"),
    ),
    (
        {"namespaces": ["other", {"name": "leaderboard", "secretsManager": ["evalai/*"], "buckets": ["b*"]}]},
        (
            "the namespaces leaderboard, other.",
            "kubectl -n leaderboard apply",
            '{id: "evalai/example"',
            'bucket: "bexample"',
        ),
        (),
    ),
    (
        {"allNamespaces": True, "allow.buckets": ["results"]},
        ("all namespaces", "kubectl create namespace leaderboard", "kubectl -n leaderboard apply"),
        ("left alone", "may name no bucket"),
    ),
    # A stand-in for AWS, which the Pods must be told of too.
    (
        {
            "aws": {"endpointURL": "http://10.77.0.1:4566", "secretName": "aws"},
            "allow": {"secrets": ["evalai"], "queues": ["https://sqs.example/1/submissions"], "buckets": ["results"]},
        },
        ('endpoint: "http://10.77.0.1:4566"', 'url: "https://sqs.example/1/submissions"'),
        ("roleARN",),
    ),
    # Who may not make roles reads which ones are needed.
    (
        {"rbac.create": False, "serviceAccount.create": False, "allow.secrets": ["evalai"], "bridge.enabled": False},
        (
            f"a Role in {SYSTEM} for the service account {CONTROLLER}:",
            f"a ClusterRole for the service account {CONTROLLER}:",
            '{"apiGroups":["batch"],"resources":["jobs"],"verbs":["list","watch","create","delete"]}',
            '{"apiGroups":[""],"resourceNames":["evalai"],"resources":["secrets"],"verbs":["get"]}',
            f"is the service account {CONTROLLER} in {SYSTEM}",
        ),
        ("roleARN", f"{BRIDGE}:"),
    ),
    ({"controller.roleARN": "arn:aws:iam::123456789012:role/one"}, ("bridge.roleARN",), ("controller.roleARN",)),
    ({"bridge.enabled": False}, ("controller.roleARN",), (f"deployment/{BRIDGE}", "bridge.roleARN")),
)


@dataclass(frozen=True)
class Access:
    """A question to the authorizer and its right answer. `resource` is `[group/]resource[:subresource]`."""

    account: str
    allowed: bool
    verb: str
    resource: str
    namespace: str = "leaderboard"
    name: str = ""


def may(account: str, verbs: str, resource: str, namespace: str = "leaderboard", name: str = "") -> list[Access]:
    return [Access(account, True, verb, resource, namespace, name) for verb in verbs.split()]


def may_not(account: str, verbs: str, resource: str, namespace: str = "leaderboard", name: str = "") -> list[Access]:
    return [Access(account, False, verb, resource, namespace, name) for verb in verbs.split()]


OWN = "leaderboard.carla.org"


def work(controller: str, namespace: str) -> list[Access]:
    """What the controller can't work without, in one namespace."""
    return [
        *may(controller, "list watch patch", f"{OWN}/leaderboards", namespace),
        *may(controller, "get list watch create patch delete", f"{OWN}/submissions", namespace),
        *may(controller, "patch", f"{OWN}/submissions:status", namespace),
        *may(controller, "patch", f"{OWN}/leaderboards:status", namespace),
        *may(controller, "update", f"{OWN}/submissions:finalizers", namespace),
        *may(controller, "list watch create delete", "batch/jobs", namespace),
        *may(controller, "list watch patch delete", "pods", namespace),
        *may(controller, "get", "pods:log", namespace),
        *may(controller, "list watch", "events", namespace),
        *may(controller, "create patch", "events.k8s.io/events", namespace),
        *may(controller, "list watch create patch", "networking.k8s.io/networkpolicies", namespace),
        *may(controller, "get list create patch delete", "resource.k8s.io/resourceclaimtemplates", namespace),
    ]


def outside(controller: str, bridge: str, namespace: str) -> list[Access]:
    """What neither may do in a namespace that is not served."""
    return [
        *may_not(controller, "get list watch create patch delete", f"{OWN}/submissions", namespace),
        *may_not(controller, "get list watch patch", f"{OWN}/leaderboards", namespace),
        *may_not(controller, "get list watch create delete", "batch/jobs", namespace),
        *may_not(controller, "get list watch patch delete", "pods", namespace),
        *may_not(controller, "get", "pods:log", namespace),
        *may_not(controller, "get", "secrets", namespace, "evalai"),
        *may_not(controller, "create patch", "networking.k8s.io/networkpolicies", namespace),
        *may_not(controller, "get list create patch delete", "resource.k8s.io/resourceclaimtemplates", namespace),
        *may_not(bridge, "get list watch", f"{OWN}/leaderboards", namespace),
        *may_not(bridge, "get create patch", f"{OWN}/submissions", namespace),
    ]


def people(namespace: str) -> list[Access]:
    """What the cluster's own roles give: `charttest` binds each to a group of its name."""
    return [
        *may("view", "get list watch", f"{OWN}/leaderboards", namespace),
        *may("view", "get list watch", f"{OWN}/submissions", namespace),
        *may_not("view", "create patch delete", f"{OWN}/submissions", namespace),
        *may("edit", "get create patch delete", f"{OWN}/submissions", namespace),
        *may("edit", "get list watch", f"{OWN}/leaderboards", namespace),
        *may_not("edit", "create update patch delete", f"{OWN}/leaderboards", namespace),
        *may_not("admin", "create update patch delete", f"{OWN}/leaderboards", namespace),
        *may_not("edit", "patch", f"{OWN}/submissions:status", namespace),
        *may("host", "get create update patch delete", f"{OWN}/leaderboards", namespace),
        *may_not("host", "patch", f"{OWN}/leaderboards:status", namespace),
        *may("host", "get list watch", "pods", namespace),
        *may("host", "get", "pods:log", namespace),
        *may("host", "list", "events", namespace),
        *may("host", "list", "batch/jobs", namespace),
        *may_not("host", "create patch delete", "pods", namespace),
        *may_not("host", "create", "pods:exec", namespace),
        *may_not("host", "create delete", "batch/jobs", namespace),
        *may_not("host", "get", "secrets", namespace, "evalai"),
    ]


def intake(bridge: str, namespace: str) -> list[Access]:
    """What the bridge can't work without, in one namespace."""
    return [
        *may(bridge, "list watch", f"{OWN}/leaderboards", namespace),
        *may(bridge, "get create patch", f"{OWN}/submissions", namespace),
        *may(bridge, "create patch", "events.k8s.io/events", namespace),
    ]


def never(controller: str, bridge: str) -> list[Access]:
    """What neither may do, whatever the values."""
    return [
        *may_not(controller, "create update delete", f"{OWN}/leaderboards"),
        *may_not(controller, "update deletecollection", f"{OWN}/submissions"),
        *may_not(controller, "create update", "pods"),
        *may_not(controller, "create", "pods:exec"),
        *may_not(controller, "deletecollection", "batch/jobs"),
        *may_not(controller, "delete", "networking.k8s.io/networkpolicies"),
        *may_not(controller, "list watch create patch delete", "secrets"),
        *may_not(controller, "get", "secrets", name="another"),
        *may_not(controller, "get", "secrets", "other", "evalai"),
        *may_not(controller, "get", "secrets", SYSTEM, "aws"),
        *may_not(controller, "update", "coordination.k8s.io/leases", SYSTEM, "another"),
        *may_not(controller, "create", "coordination.k8s.io/leases", "leaderboard"),
        *may_not(controller, "create", "serviceaccounts:token", SYSTEM),
        *may_not(controller, "patch delete", "nodes", ""),
        *may_not(bridge, "get", "pods:log"),
        *may_not(bridge, "get", "nodes", ""),
        *may_not(bridge, "list watch update delete", f"{OWN}/submissions"),
        *may_not(bridge, "patch", f"{OWN}/submissions:status"),
        *may_not(bridge, "patch", f"{OWN}/leaderboards"),
        *may_not(bridge, "get list create", "pods"),
        *may_not(bridge, "get list create", "batch/jobs"),
        *may_not(bridge, "get", "secrets", name="evalai"),
        *may_not(bridge, "get create update", "coordination.k8s.io/leases", SYSTEM, RELEASE),
    ]


def lease(controller: str) -> list[Access]:
    return [
        *may(controller, "create", "coordination.k8s.io/leases", SYSTEM),
        *may(controller, "get update", "coordination.k8s.io/leases", SYSTEM, RELEASE),
        *may_not(controller, "get", "coordination.k8s.io/leases", SYSTEM, "another"),
    ]


# Of the ClusterRole, unless rbac.clusterRole is false.
WHOLE = (
    *may(CONTROLLER, "list watch", "nodes", ""),
    *may_not(CONTROLLER, "get", "nodes", ""),
    *may_not(CONTROLLER, "get list watch", "coordination.k8s.io/leases", ""),
    *may_not(CONTROLLER, "list", "pods", ""),
)
# One leaderboard's namespace, with the values' defaults.
DEFAULT = (
    *work(CONTROLLER, "leaderboard"),
    *intake(BRIDGE, "leaderboard"),
    *outside(CONTROLLER, BRIDGE, "other"),
    *outside(CONTROLLER, BRIDGE, SYSTEM),
    *never(CONTROLLER, BRIDGE),
    *lease(CONTROLLER),
    *WHOLE,
    *may(CONTROLLER, "get", "secrets", name="evalai"),
)
# ci/all-namespaces.yaml.
CLUSTER_WIDE = (
    *work(CONTROLLER, "leaderboard"),
    *work(CONTROLLER, "other"),
    *intake(BRIDGE, "leaderboard"),
    *intake(BRIDGE, "other"),
    *never(CONTROLLER, BRIDGE),
    *lease(CONTROLLER),
    *may(CONTROLLER, "get", "secrets", name="evalai"),
    *may(CONTROLLER, "list watch", "nodes", ""),
    *may_not(CONTROLLER, "get", "nodes", ""),
)
# ci/roles.yaml: another account, secrets in two namespaces.
WITH_ROLES = (
    *work("controller", "carla-10"),
    *work("controller", "carla-20"),
    *intake(BRIDGE, "carla-10"),
    *intake(BRIDGE, "carla-20"),
    *outside("controller", BRIDGE, "leaderboard"),
    *lease("controller"),
    *never("controller", BRIDGE),
    *may("controller", "get", "secrets", "carla-10", "evalai"),
    *may("controller", "get", "secrets", "carla-10", "evalai-old"),
    *may("controller", "get", "secrets", "carla-20", "evalai"),
    *may_not("controller", "get", "secrets", "carla-20", "evalai-old"),
    *may_not(CONTROLLER, "get", f"{OWN}/submissions", "carla-10"),
)
# ci/namespaced.yaml.
NAMESPACED = (
    *work(CONTROLLER, "leaderboard"),
    *intake(BRIDGE, "leaderboard"),
    *never(CONTROLLER, BRIDGE),
    *lease(CONTROLLER),
    *may(CONTROLLER, "get", "secrets", name="evalai"),
    *outside(CONTROLLER, BRIDGE, "other"),
    *may_not(CONTROLLER, "list", "pods", ""),
    *may_not(CONTROLLER, "get list watch", "nodes", ""),
    *may_not(CONTROLLER, "get", "coordination.k8s.io/leases", "other", "another"),
)
