"""Owns how many seconds the processors have worked: for this process, for a part of the cluster, for all Pods, for the whole machine.

Called by `testrun`, whose table shows which layer uses them. Knows no layer.
"""

import os
import resource
from collections.abc import Mapping
from pathlib import Path

from . import leftovers, process
from .settings import CGROUP, Settings

STAT = Path("/proc/stat")
TICKS = os.sysconf("SC_CLK_TCK")
# Places in the first line of /proc/stat, behind its name: user, nice, system, irq, softirq. The others are idle, or another machine's.
WORKING = (0, 1, 2, 5, 6)
PODS = "Pods"


def of_this_process() -> float:
    """With all that it has waited for. What it has left running is in the machine's alone."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def of_machine(stat: str) -> float:
    """Since its start, by the text of /proc/stat."""
    numbers = [int(word) for word in stat.partition("\n")[0].split()[1:]]
    return sum(numbers[place] for place in WORKING) / TICKS


def machine() -> float:
    """0 where the system does not count."""
    return of_machine(STAT.read_text()) if STAT.exists() else 0


def of_process(stat: str) -> float:
    """Of the process with this text of /proc/PID/stat, with all that it has waited for."""
    return sum(int(word) for word in stat.rpartition(")")[2].split()[11:15]) / TICKS


def of_cluster(settings: Settings, names: tuple[str, ...]) -> dict[str, float]:
    """Of each part that runs, since its start, and of all Pods since the cluster's."""
    found = {PODS: of_pods()}
    for name in names:
        identity = process.read_pidfile(settings.run / f"{name}.pid")
        if identity is not None and process.running(identity):
            found[name] = of_process((Path("/proc") / str(identity.pid) / "stat").read_text())
    return found


def of_pods() -> float:
    """By the cgroup of them all, which keeps what those have used that are gone."""
    places = [root / CGROUP for root in leftovers.cgroup_roots()]
    # cgroup v1, which may have a hierarchy of v2 beside it that counts nothing.
    for file in (place / "cpuacct.usage" for place in places):
        if file.exists():
            return int(file.read_text()) / 1e9
    for file in (place / "cpu.stat" for place in places):
        words = file.read_text().split() if file.exists() else []
        if "usage_usec" in words:
            return int(words[words.index("usage_usec") + 1]) / 1e6
    return 0


def since(before: Mapping[str, float], after: Mapping[str, float]) -> str:
    """What has worked between two looks, the most first. A part that was started again counts from its start."""
    spent = {name: value - before.get(name, 0) for name, value in after.items()}
    spent |= {name: after[name] for name, value in spent.items() if value < 0}
    return ", ".join(f"{name} {value:.0f}" for name, value in sorted(spent.items(), key=lambda one: -one[1]))
