"""Owns the removal of what the cluster's Pods leave on the machine: processes, shims, mounts, cgroups, links to logs.

Works on its own, whether containerd still answers or not, and touches only what lies in our cgroup or below our folders.
"""

import os
import signal
import subprocess
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

from .errors import LabError
from .process import start_time, wait_until
from .settings import CGROUP, Settings

CGROUPS = Path("/sys/fs/cgroup")
CONTAINER_LOGS = Path("/var/log/containers")
# Each kubelet of a machine has its plugins' sockets here, whatever its own root folder is.
DEVICE_PLUGIN = Path("/var/lib/kubelet/device-plugins/fake-gpu.sock")
# Where container engines read which devices a name stands for.
CDI = Path("/var/run/cdi")


def cgroup_roots() -> list[Path]:
    """The top folder of every cgroup hierarchy: one with cgroup v2, one per controller with v1."""
    if (CGROUPS / "cgroup.controllers").exists():
        return [CGROUPS]
    links = [place for place in CGROUPS.iterdir() if place.is_dir() and not place.is_symlink()]
    return [place for place in links if (place / "cgroup.procs").exists()]


def make_cgroup() -> None:
    """Makes the cgroup below which the kubelet puts every Pod, with all controllers usable in it."""
    roots = cgroup_roots() if CGROUPS.is_dir() else []
    if not roots:
        raise LabError(
            "no cgroup hierarchy is mounted at /sys/fs/cgroup: mount cgroup2 there, or run the lab on a usual Linux system"
        )
    for root in roots:
        place = root / CGROUP
        for folder in (root, place):
            folder.mkdir(exist_ok=True)
            enable_controllers(folder)
        for name in ("cpuset.cpus", "cpuset.mems"):
            # A fresh cpuset of cgroup v1 has no processors, so nothing could be moved into it.
            file, above = place / name, root / name
            if root != CGROUPS and file.exists() and above.exists() and not file.read_text().strip():
                file.write_text(above.read_text())


def enable_controllers(folder: Path) -> None:
    """cgroup v2: hands every controller on to the folders below."""
    available = folder / "cgroup.controllers"
    if available.exists():
        for controller in available.read_text().split():
            try:
                (folder / "cgroup.subtree_control").write_text(f"+{controller}")
            except OSError:
                # Such as `cpu` while real-time processes run: the kubelet names those it misses.
                continue


def container_processes() -> set[int]:
    """The processes of all our Pods, by our cgroup."""
    found: set[int] = set()
    for root in cgroup_roots():
        # A walk goes on where a folder vanishes under it, as the ended containers' do; a glob would raise.
        for folder, _, _ in os.walk(root / CGROUP):
            try:
                found.update(int(pid) for pid in (Path(folder) / "cgroup.procs").read_text().split())
            except OSError:
                continue
    return found - {0}


def shims(settings: Settings) -> set[int]:
    """The containerd shims that belong to our socket."""
    socket = str(settings.containerd_socket).encode()
    found = set()
    for folder in Path("/proc").iterdir():
        if not folder.name.isdecimal():
            continue
        try:
            words = (folder / "cmdline").read_bytes().split(b"\0")
        except OSError:
            continue
        if b"containerd-shim" in words[0] and socket in words:
            found.add(int(folder.name))
    return found


def kill_containers(settings: Settings) -> int:
    """Kills every process of our Pods and every shim of our containerd; returns how many. Raises if some will not go."""
    return kill_until_gone(container_processes) + kill_until_gone(lambda: shims(settings))


def kill_until_gone(find: Callable[[], set[int]]) -> int:
    """Kills what `find` finds until it finds nothing more; returns how many processes that were."""
    killed: set[int] = set()

    def gone() -> bool:
        pids = find()
        for pid in pids - killed:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        killed.update(pids)
        return not pids

    if not wait_until(gone, 20):
        raise LabError(
            f"processes of Pods can't be killed ({sorted(find())[:5]}): they hang in the kernel; restart the machine"
        )
    return len(killed)


def mounts_below(mountinfo: str, folder: str) -> list[str]:
    """The mount points at or below `folder`, innermost first, from the text of /proc/self/mountinfo."""
    points = [unescape(line.split(" ")[4]) for line in mountinfo.splitlines() if line]
    return [point for point in reversed(points) if point == folder or point.startswith(f"{folder}/")]


def unescape(point: str) -> str:
    """mountinfo writes blanks, tabs, newlines and backslashes as three octal digits."""
    for code, character in (("\\040", " "), ("\\011", "\t"), ("\\012", "\n"), ("\\134", "\\")):
        point = point.replace(code, character)
    return point


def unmount_all(settings: Settings) -> int:
    """Unmounts everything below our state folder; returns how many mounts there were."""
    folder = os.path.realpath(settings.state)
    points = mounts_below(Path("/proc/self/mountinfo").read_text(), folder)
    for point in points:
        if subprocess.run(["umount", point], capture_output=True, check=False).returncode != 0:
            subprocess.run(["umount", "--lazy", point], capture_output=True, check=False)
    left = mounts_below(Path("/proc/self/mountinfo").read_text(), folder)
    if left:
        raise LabError(
            f"{left[0]} can't be unmounted: end the processes that use it (`fuser -m {left[0]}`), then run `lab down` again"
        )
    return len(points)


def shim_sockets(settings: Settings) -> list[Path]:
    """The sockets of our shims, which containerd puts into a folder of the system; each bundle names its own.

    To be asked before the containers are killed: containerd removes the bundle of a dead container, but not the socket.
    """
    sockets = []
    for file in (settings.run / "containerd").glob("io.containerd.runtime.v2.task/*/*/address"):
        try:
            sockets.append(Path(file.read_text().strip().removeprefix("unix://")))
        except OSError:
            continue
    return sockets


def remove_traces(settings: Settings, sockets: Iterable[Path]) -> None:
    """Removes the shims' sockets, links to our Pods' logs and our cgroups. The mounts must be gone."""
    for socket in sockets:
        if socket.is_socket():
            socket.unlink(missing_ok=True)
    if CONTAINER_LOGS.is_dir():
        for link in CONTAINER_LOGS.iterdir():
            if link.is_symlink() and os.readlink(link).startswith(f"{settings.pod_logs}/"):
                link.unlink(missing_ok=True)
    remove_gpus()
    for root in cgroup_roots():
        for folder, _, _ in os.walk(root / CGROUP, topdown=False):
            try:
                os.rmdir(folder)
            except OSError:
                continue


def remove_gpus() -> None:
    """Removes what the stand-in of GPUs has left: the next cluster's node has none."""
    if DEVICE_PLUGIN.is_socket():
        DEVICE_PLUGIN.unlink(missing_ok=True)
        # The kubelet remembers there which resources its node had.
        (DEVICE_PLUGIN.parent / "kubelet_internal_checkpoint").unlink(missing_ok=True)
    for file in CDI.glob("fake-gpu-*.json"):
        file.unlink(missing_ok=True)


def age_of(pid: int) -> float:
    """Seconds since a process started."""
    ticks = start_time(Path(f"/proc/{pid}/stat").read_text())
    uptime = float(Path("/proc/uptime").read_text().split()[0])
    return max(0.0, uptime - ticks / os.sysconf("SC_CLK_TCK"))
