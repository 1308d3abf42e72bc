"""Owns the order in which the lab comes up and goes down. Called by `lab up|down|status`; the parts know nothing of each other."""

import hashlib
import os
import platform
import shutil
import subprocess
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from . import components, image, leftovers, network, packages, pki, process, pythonenv, tools
from .aws import create_resources
from .components import Component
from .console import say, seconds
from .errors import LabError
from .files import PAUSE_IMAGE, PAUSE_REFERENCE
from .settings import API_SERVICE_ADDRESS, HOST_ADDRESS, LONGEST_SOCKET_PATH, NODE_NAME, Settings, without_proxy

CLUSTER_TOOLS = (
    "etcd",
    "kube-apiserver",
    "kubectl",
    "kube-scheduler",
    "kube-controller-manager",
    "kubelet",
    "kube-proxy",
    "crane",
    "pause",
)
NAMES = (
    "etcd",
    "containerd",
    "aws",
    "kube-apiserver",
    "kube-controller-manager",
    "kube-scheduler",
    "kubelet",
    "kube-proxy",
)
# Started by commands of their own, ended by `down` with the rest.
GUESTS = ("evalai", "gpus")
OWNER_VARIABLE = "LEADERBOARD_LAB_OWNER"


def up(settings: Settings) -> None:
    """Starts whatever does not run, or runs with another configuration, and returns when Pods can be created."""
    started = time.monotonic()
    check_machine(settings)
    with exclusively(settings):
        tools.check_space(settings.state)
        packages.ensure(settings)
        folder = tools.ensure(settings, tools_of(settings), tools.fitting_assets(os.environ))
        python = pythonenv.ensure(settings) / "python"
        pki.ensure(settings)
        network.up(settings)
        leftovers.make_cgroup()
        changed = start_all(settings, folder, parts_of(settings, folder, python))
    took = seconds(time.monotonic() - started)
    news = f"started {', '.join(changed)}" if changed else "everything was running"
    say(f"the cluster is up ({took}; {news})")


def tools_of(settings: Settings) -> tuple[str, ...]:
    """The tools that this cluster runs on."""
    return (*CLUSTER_TOOLS, "containerd", "containerd-shim-runc-v2") if settings.builds_containerd else CLUSTER_TOOLS


def parts_of(settings: Settings, folder: Path, python: Path) -> list[Component]:
    """Every part as this machine runs it, with the tools in `folder`."""
    if settings.builds_containerd:
        containerd = str(folder / "containerd")
    else:
        containerd = shutil.which("containerd", path=components.PATH) or "containerd"
    return components.all_components(settings, folder, python, containerd, str(packages.cni_folder()))


def check_machine(settings: Settings) -> None:
    """Raises with the next step if this can't be the machine for a cluster."""
    if platform.system() != "Linux":
        raise LabError(
            f"the cluster needs Linux, and this is {platform.system()}: use a Linux machine or virtual machine"
        )
    if os.geteuid() != 0:
        raise LabError("the cluster needs root (containers, network): run `sudo -E local/lab up`")
    longest = len(os.fsencode(settings.containerd_socket)) + len(".ttrpc")
    if longest > LONGEST_SOCKET_PATH:
        raise LabError(
            f"the path {settings.state} is too long for a socket: set LEADERBOARD_LAB_STATE to a shorter folder"
        )


@contextmanager
def exclusively(settings: Settings) -> Iterator[None]:
    """One `up` or `down` at a time."""
    settings.state.mkdir(parents=True, exist_ok=True)
    with tools.lock(settings.state / "lab.lock", "the cluster"):
        yield


def start_all(settings: Settings, folder: Path, parts: Sequence[Component]) -> list[str]:
    """Starts the parts, each as soon as what it needs answers; returns the names of those that had to be started."""
    by_name = {part.name: part for part in parts}
    changed: list[str] = []

    def launch(*names: str) -> None:
        changed.extend(name for name in names if ensure_started(settings, by_name[name]))

    def await_ready(*names: str) -> None:
        for name in names:
            await_one(settings, by_name[name])

    launch("etcd", "containerd", "aws")
    with ThreadPoolExecutor(max_workers=2) as pool:
        await_ready("aws")
        resources = pool.submit(create_resources, settings)
        await_ready("containerd")
        pause = pool.submit(import_pause, settings, folder)
        await_ready("etcd")
        launch("kube-apiserver")
        await_ready("kube-apiserver")
        launch("kube-controller-manager", "kube-scheduler", "kube-proxy")
        pause.result()
        launch("kubelet")
        await_ready("kubelet", "kube-controller-manager", "kube-scheduler", "kube-proxy")
        await_cluster(settings, folder)
        resources.result()
    return changed


def ensure_started(settings: Settings, part: Component) -> bool:
    """Starts a part unless it runs just like this; returns whether it had to."""
    pidfile = settings.run / f"{part.name}.pid"
    digest = hashlib.sha256((part.digest() + authority(settings)).encode()).hexdigest()[:16]
    identity = process.read_pidfile(pidfile)
    if identity is not None and process.running(identity):
        if identity.digest == digest:
            return False
        say(f"{part.name} runs with another configuration: starting it again")
        process.stop(identity, part.patience)
    for stray in strays(settings, part.name):
        process.stop(stray, part.patience)
    for address, port in part.listens:
        holder = network.holder_of(address, port)
        if holder is not None:
            variable = next(name for name, number in settings.ports.items() if number == port).upper()
            raise LabError(
                f"{part.name} needs {address}:{port}, which {holder.text} uses: {ending(holder.pid)}, or set "
                f"LEADERBOARD_LAB_PORT_{variable} to a free port"
            )
    for file, text in part.files.items():
        file.parent.mkdir(parents=True, exist_ok=True)
        process.write_whole(file, text)
    settings.data.mkdir(parents=True, exist_ok=True)
    if part.prepare is not None:
        part.prepare()
    env = part.env | {OWNER_VARIABLE: f"{settings.state}:{part.name}"}
    log = settings.logs / f"{part.name}.log"
    process.start(part.name, part.argv, env=env, pidfile=pidfile, log=log, digest=digest)
    return True


def ending(pid: int | None) -> str:
    """How to end a process that is in the way: of the cluster of another folder, by `down` there."""
    try:
        environment = (Path("/proc") / str(pid) / "environ").read_bytes().split(b"\0") if pid else []
    except OSError:
        environment = []
    mark = f"{OWNER_VARIABLE}=".encode()
    states = [
        os.fsdecode(entry.removeprefix(mark)).rpartition(":")[0] for entry in environment if entry.startswith(mark)
    ]
    return f"run `LEADERBOARD_LAB_STATE={states[0]} local/lab down`" if states else "end that"


def authority(settings: Settings) -> str:
    """Stands for the certificates: with other ones every part must be started again."""
    return hashlib.sha256((settings.pki / "ca.crt").read_bytes()).hexdigest()


def strays(settings: Settings, name: str | None = None) -> list[process.Identity]:
    """Our own processes whose pidfiles got lost, found by a mark in their environment; of one part, or of all."""
    marks = [f"{OWNER_VARIABLE}={settings.state}:{part}".encode() for part in ([name] if name else [*NAMES, *GUESTS])]
    found = []
    for folder in Path("/proc").iterdir():
        if not folder.name.isdecimal():
            continue
        try:
            environment = (folder / "environ").read_bytes().split(b"\0")
            words = (folder / "cmdline").read_bytes().split(b"\0")
            # containerd hands its environment down to the shims, which go with their containers.
            if not any(mark in environment for mark in marks) or b"containerd-shim" in words[0]:
                continue
            began = process.start_time((folder / "stat").read_text())
        except OSError:
            continue
        found.append(process.Identity(int(folder.name), began, process.boot_id(), os.fsdecode(words[0]), ""))
    return found


def await_one(settings: Settings, part: Component) -> None:
    """Waits until the part answers; raises at once if it has ended instead."""
    pidfile = settings.run / f"{part.name}.pid"
    log = settings.logs / f"{part.name}.log"

    def ready_or_gone() -> bool:
        return part.ready() or not process.running(process.read_pidfile(pidfile))

    if not process.wait_until(ready_or_gone, 90):
        raise LabError(
            f"{part.name} does not answer after 90 s ({process.tail(log)[-300:]}); see {log}, then run `local/lab up` again"
        )
    if not process.running(process.read_pidfile(pidfile)):
        raise LabError(f"{part.name} ended right after its start ({process.tail(log)[-300:]}); see {log}")


def import_pause(settings: Settings, folder: Path) -> None:
    """Gives containerd the image that holds a Pod's namespaces, if it lacks it."""
    ctr = ["ctr", "--address", str(settings.containerd_socket), "--namespace", "k8s.io", "images"]
    listed = subprocess.run([*ctr, "ls", "-q", f"name=={PAUSE_REFERENCE}"], capture_output=True, text=True, check=False)
    if PAUSE_REFERENCE in listed.stdout.split():
        return
    archive = settings.data / "pause.tar"
    image.write_pause(folder / "pause", PAUSE_IMAGE, archive)
    done = subprocess.run([*ctr, "import", str(archive)], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise LabError(
            f"containerd did not take the pause image ({done.stderr.strip()[-200:]}); see {settings.logs}/containerd.log"
        )


def await_cluster(settings: Settings, folder: Path) -> None:
    """Watches until the node is Ready and Pods can be created in the namespace default."""
    kubectl = [str(folder / "kubectl"), f"--kubeconfig={settings.kubeconfig}", "wait", "--timeout=120s"]
    waits = (
        ["--for=create", f"node/{NODE_NAME}"],
        ["--for=condition=Ready", f"node/{NODE_NAME}"],
        ["--for=create", "serviceaccount/default", "--namespace=default"],
    )
    env = without_proxy(os.environ)
    for wait in waits:
        done = subprocess.run([*kubectl, *wait], env=env, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            log = settings.logs / "kubelet.log"
            raise LabError(
                f"the node does not become ready ({done.stderr.strip()[-200:]}); see {log}, then run `local/lab up` again"
            )
    service = f"https://{API_SERVICE_ADDRESS}:443/readyz"
    if not process.wait_until(lambda: components.answers(service, settings), 30):
        log = settings.logs / "kube-proxy.log"
        raise LabError(f"the API server can't be reached by its Service address {API_SERVICE_ADDRESS}; see {log}")


def down(settings: Settings) -> None:
    """Ends everything that `up` started and removes its data; certificates, kubeconfig and logs stay."""
    started = time.monotonic()
    if os.geteuid() != 0:
        raise LabError("the cluster belongs to root: run `sudo -E local/lab down`")
    with exclusively(settings):
        # The kubelet first: it would start again what is killed.
        stopped = stop_parts(settings, ["kubelet"])
        stopped += stop_parts(settings, [name for name in (*GUESTS, *NAMES) if name not in ("kubelet", "containerd")])
        sockets = leftovers.shim_sockets(settings)
        containers = leftovers.kill_containers(settings)
        stopped += stop_parts(settings, ["containerd"])
        containers += leftovers.kill_containers(settings)
        for stray in strays(settings):
            stopped += process.stop(stray, 5)
        mounts = leftovers.unmount_all(settings)
        leftovers.remove_traces(settings, sockets)
        network.down(settings)
        for place in (settings.data, settings.config, settings.run):
            shutil.rmtree(place, ignore_errors=True)
    took = seconds(time.monotonic() - started)
    say(f"the cluster is down ({took}; {stopped} parts, {containers} container processes and shims, {mounts} mounts)")


def stop_parts(settings: Settings, names: Sequence[str]) -> int:
    """Ends the named parts, all at once; returns how many of them ran."""
    with ThreadPoolExecutor(max_workers=len(names)) as pool:
        ends = [pool.submit(process.stop, process.read_pidfile(settings.run / f"{name}.pid"), 3.0) for name in names]
        return sum(end.result() for end in ends)


def status(settings: Settings) -> bool:
    """Prints each part's state; returns whether all of them run."""
    all_run = True
    guests = [name for name in GUESTS if (settings.run / f"{name}.pid").exists()]
    for name in [*NAMES, *guests]:
        identity = process.read_pidfile(settings.run / f"{name}.pid")
        if identity is not None and process.running(identity):
            print(f"{name:<25} running   pid {identity.pid:<8} for {seconds(leftovers.age_of(identity.pid))}")
        else:
            all_run = False
            print(f"{name:<25} {'ended     see ' + str(settings.logs / (name + '.log')) if identity else 'stopped'}")
    if all_run:
        ready = components.answers(f"{settings.api_endpoint}/readyz", settings)
        print(f"{'API server':<25} {'ready' if ready else 'not ready'}     {settings.api_endpoint}")
        print(f"{'AWS and registry':<25} {settings.aws_endpoint}")
        print(f"{'machine, seen from Pods':<25} {HOST_ADDRESS}")
    return all_run
