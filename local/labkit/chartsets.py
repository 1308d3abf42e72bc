"""Owns what people type who know the charts of cert-manager, External Secrets and CloudNativePG: `--set` by `--set`, with its effect.

Data, and the check that `charttest` calls. The values are texts of `helm`'s command line, as a shell would hand them over.
"""

from pathlib import Path
from typing import Any

from . import chartrender
from .chartcases import RELEASE, SET_IMAGE, SYSTEM
from .chartshown import ABSENT, BRIDGE, CONTAINER, CONTROLLER, CRD, POD, Shown
from .errors import LabError
from .kube import Kube, at_once

ACCOUNT = f"ServiceAccount/{RELEASE}-controller"
# What is typed, and an object, a path in it and what stands there.
TYPED: tuple[tuple[str, str, str, Any], ...] = (
    ("serviceAccount.create=false", ACCOUNT, "", ABSENT),
    ("controller.serviceAccount.name=made-by-terraform", CONTROLLER, f"{POD}.serviceAccountName", "made-by-terraform"),
    ("serviceAccount.automount=false", ACCOUNT, "automountServiceAccountToken", False),
    ("serviceAccount.labels.team=carla", ACCOUNT, "metadata.labels.team", "carla"),
    ("serviceAccount.annotations.team=carla", ACCOUNT, "metadata.annotations.team", "carla"),
    ("rbac.create=false", f"Role/{RELEASE}-controller", "", ABSENT),
    (
        "global.imageRegistry=mirror.example,image.repository=operator,image.tag=v1",
        CONTROLLER,
        f"{CONTAINER}.image",
        "mirror.example/operator:v1",
    ),
    (
        "image.registry=own.example,image.repository=operator,image.tag=v1",
        BRIDGE,
        f"{CONTAINER}.image",
        "own.example/operator:v1",
    ),
    ("global.imagePullSecrets[0].name=pull", BRIDGE, f"{POD}.imagePullSecrets", [{"name": "pull"}]),
    ("extraArgs={--concurrency=32}", CONTROLLER, f"{CONTAINER}.args", ["--concurrency=32"]),
    (
        "extraContainers[0].name=side,extraContainers[0].image=side:1",
        CONTROLLER,
        f"{POD}.containers.1",
        {"name": "side", "image": "side:1"},
    ),
    ("hostNetwork=true", CONTROLLER, f"{POD}.hostNetwork", True),
    ("dnsPolicy=Default", CONTROLLER, f"{POD}.dnsPolicy", "Default"),
    ("dnsConfig.nameservers={10.0.0.2}", CONTROLLER, f"{POD}.dnsConfig.nameservers", ["10.0.0.2"]),
    (
        "hostAliases[0].ip=10.0.0.3,hostAliases[0].hostnames={s3.example}",
        CONTROLLER,
        f"{POD}.hostAliases",
        [{"ip": "10.0.0.3", "hostnames": ["s3.example"]}],
    ),
    ("runtimeClassName=gvisor", CONTROLLER, f"{POD}.runtimeClassName", "gvisor"),
    ("schedulerName=volcano", CONTROLLER, f"{POD}.schedulerName", "volcano"),
    ("strategy.type=Recreate", CONTROLLER, "spec.strategy", {"type": "Recreate"}),
    ("livenessProbe.initialDelaySeconds=30", BRIDGE, f"{CONTAINER}.livenessProbe.initialDelaySeconds", 30),
    ("readinessProbe.failureThreshold=5", BRIDGE, f"{CONTAINER}.readinessProbe.failureThreshold", 5),
    ("deploymentAnnotations.team=carla", BRIDGE, "metadata.annotations.team", "carla"),
    (
        "podDisruptionBudget.minAvailable=1",
        f"PodDisruptionBudget/{RELEASE}-controller",
        "spec.minAvailable",
        1,
    ),
    ("crds.enabled=false", CRD, "", ABSENT),
    ("tolerations[0].operator=Exists", BRIDGE, f"{POD}.tolerations", [{"operator": "Exists"}]),
    ("nodeSelector.kubernetes\\.io/os=linux", CONTROLLER, f"{POD}.nodeSelector", {"kubernetes.io/os": "linux"}),
    ("commonLabels.team=carla", CONTROLLER, "metadata.labels.team", "carla"),
    ("namespaces={leaderboard}", f"Role/{RELEASE}-controller", "metadata.namespace", "leaderboard"),
    ("webUI.enabled=true", CONTROLLER, f"{CONTAINER}.ports.1.containerPort", 8081),
    ("grafanaDashboard.enabled=true", f"ConfigMap/{RELEASE}-dashboard", "metadata.labels.grafana_dashboard", "1"),
)


def typed(kube: Kube, chart: Path) -> str:
    """Renders the chart with each of them, and looks for its effect."""
    argv = ["template", RELEASE, str(chart), f"--namespace={SYSTEM}", SET_IMAGE]
    texts = at_once(lambda one: kube.run("helm", *argv, *lean(one[1]), f"--set={one[0]}"), TYPED)
    for (words, name, path, holds), rendered in zip(TYPED, chartrender.objects_of_each(kube, texts), strict=True):
        fault = chartrender.fault(rendered, Shown(name, path, holds))
        if fault:
            raise LabError(f"--set {words}: {fault}")
    return f"{len(TYPED)} values"


def lean(shown: str) -> list[str]:
    """Leaves the definitions out where the effect is on another object."""
    return [] if shown.startswith(chartrender.DEFINITION) else ["--set=crds.enabled=false"]
