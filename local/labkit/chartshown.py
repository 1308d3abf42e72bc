"""Owns how it is written what a value of the chart changes in the objects that it renders. For `chartshows`, which has the values."""

from dataclasses import dataclass
from typing import Any

from .chartcases import RELEASE

# The path does not exist, or the object is not rendered.
ABSENT = "(absent)"
MONITORING = "monitoring.coreos.com/v1"
CONTROLLER = f"Deployment/{RELEASE}-controller"
BRIDGE = f"Deployment/{RELEASE}-bridge"
TEST, TESTED, HOOK = f"Pod/{RELEASE}-test", "spec.containers.0", "helm.sh/hook"
CRD = "CustomResourceDefinition/submissions.leaderboard.carla.org"
ROLE = "arn:aws:iam::123456789012:role/one"
POD = "spec.template.spec"
CONTAINER = f"{POD}.containers.0"
# The chart's own requirement of nodes.
ARCHITECTURES = {
    "requiredDuringSchedulingIgnoredDuringExecution": {
        "nodeSelectorTerms": [
            {"matchExpressions": [{"key": "kubernetes.io/arch", "operator": "In", "values": ["amd64"]}]}
        ]
    }
}


@dataclass(frozen=True)
class Shown:
    """An object holds something: `holds` may name fewer keys of a map than there are. A path's parts are keys or places in a list."""

    object: str
    path: str
    holds: Any


@dataclass(frozen=True)
class Case:
    """Values by their paths, and what they show. `kinds` are those that the cluster has besides Kubernetes' own."""

    values: dict[str, Any]
    shown: tuple[Shown, ...]
    kinds: tuple[str, ...] = ()


def case(values: dict[str, Any], *shown: tuple[str, str, Any], kinds: tuple[str, ...] = ()) -> Case:
    return Case(values, tuple(Shown(*one) for one in shown), tuple(f"{MONITORING}/{kind}" for kind in kinds))


def selector(component: str) -> dict[str, str]:
    return {
        "app.kubernetes.io/name": RELEASE,
        "app.kubernetes.io/instance": RELEASE,
        "app.kubernetes.io/component": component,
    }


def env(name: str, value: str) -> dict[str, str]:
    return {"name": name, "value": value}


def key_of_secret(name: str, **more: bool) -> dict[str, Any]:
    return {"name": name, "valueFrom": {"secretKeyRef": {"name": "aws", "key": name, **more}}}
