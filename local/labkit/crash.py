"""Owns the sudden death of one part of the running cluster. Called by `lab crash`; knows nothing of what runs in the cluster."""

import time

from . import cluster, process, pythonenv, tools
from .console import say, seconds
from .errors import LabError
from .settings import Settings

# Those without which a submission under way must get by.
PARTS = ("kube-apiserver", "etcd", "kubelet")


def crash(settings: Settings, name: str, away: int) -> None:
    """Kills a part, starts it again after `away` seconds as `up` does, and returns when the cluster is ready again."""
    if name not in PARTS:
        raise LabError(f"{name} can't be crashed: name one of {', '.join(PARTS)}")
    if away < 0:
        raise LabError(f"--away {away} is no time to stay away: give 0 or more seconds")
    cluster.check_machine(settings)
    with cluster.exclusively(settings):
        pidfile = settings.run / f"{name}.pid"
        identity = process.read_pidfile(pidfile)
        if identity is None or not process.running(identity):
            raise LabError(f"{name} does not run: start the cluster with `sudo -E local/lab up`")
        # All that could fail or take time comes before the kill.
        folder = tools.ensure(settings, cluster.CLUSTER_TOOLS)
        parts = {part.name: part for part in cluster.parts_of(settings, folder, pythonenv.ensure(settings) / "python")}
        if not process.kill(identity):
            raise LabError(f"{name} ended by itself: see {settings.logs / name}.log, then run `sudo -E local/lab up`")
        killed = time.monotonic()
        time.sleep(away)
        cluster.ensure_started(settings, parts[name])
        # Without its store the API server does not answer either.
        for needed in dict.fromkeys((name, "kube-apiserver")):
            cluster.await_one(settings, parts[needed])
        cluster.await_cluster(settings, folder)
    gone = seconds(time.monotonic() - killed)
    say(f"{name} (pid {identity.pid}) was killed, started again after {away} s, and ready after {gone}")
