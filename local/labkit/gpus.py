"""Owns the stand-in of a node's GPUs: a device plugin and a DRA driver that hand out devices which are none. Started by the cluster's
tests, ended by `lab down`.
"""

import os
import subprocess
from pathlib import Path

from . import cluster
from .components import PATH, Component, accepts
from .errors import LabError
from .leftovers import CDI, DEVICE_PLUGIN
from .settings import NODE_NAME, Settings, without_proxy

NAME = "gpus"
TOOL = "fake-gpu"
RESOURCE = "nvidia.com/gpu"
GPUS = 4
# Each GPU is offered twice, as with time-slicing.
REPLICAS = 2


def component(settings: Settings, folder: Path) -> Component:
    """The process. Its rights are the node's: of the administrator's requests the tests read what the operator uses."""
    argv = [str(folder / TOOL), f"-resource={RESOURCE}", f"-gpus={GPUS}", f"-replicas={REPLICAS}"]
    argv += [f"-kubelet-root={settings.data}/kubelet", f"-kubeconfig={settings.pki}/node.kubeconfig"]
    argv += [f"-node={NODE_NAME}", f"-cdi={CDI}"]
    return Component(NAME, argv, lambda: accepts(DEVICE_PLUGIN), env={"PATH": PATH})


def ensure(settings: Settings, folder: Path) -> None:
    """Starts it unless it runs, and waits until the node offers its GPUs."""
    part = component(settings, folder)
    with cluster.exclusively(settings):
        cluster.ensure_started(settings, part)
        cluster.await_one(settings, part)
    offers = "--for=jsonpath={.status.allocatable.nvidia\\.com/gpu}=" + str(GPUS * REPLICAS)
    kubectl = [str(folder / "kubectl"), f"--kubeconfig={settings.kubeconfig}", "wait", "--timeout=60s"]
    done = subprocess.run(
        [*kubectl, f"node/{NODE_NAME}", offers],
        env=without_proxy(os.environ),
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        log = settings.logs / f"{NAME}.log"
        raise LabError(f"the node does not offer {RESOURCE} ({done.stderr.strip()[-200:]}); see {log}")
