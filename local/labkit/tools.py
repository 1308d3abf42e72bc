"""Owns the tool cache: builds what is missing, crash-safe and safe against a second builder. Called by `lab tools` and `lab up`."""

import fcntl
import hashlib
import os
import platform
import shutil
import subprocess
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from .console import run_long, say, seconds
from .errors import LabError
from .settings import Settings
from .toolsets import ENVTEST_TOOLS, KUBERNETES_VERSION, SETS, ToolSet, build_flags, cache_key, in_build_order

LEAST_FREE_BYTES = 5 << 30
# Go's own variables. The compiler collects its garbage less often: packages are small next to the machine's memory.
GO_ENVIRONMENT = {"CGO_ENABLED": "0", "GOFLAGS": "", "GOWORK": "off", "GOGC": "400"}


def ensure(settings: Settings, names: Iterable[str], assets: str | None = None) -> Path:
    """Makes sure that the tools exist and returns a folder that holds all of them.

    `assets` is a folder of envtest binaries (KUBEBUILDER_ASSETS) whose etcd, kube-apiserver and kubectl win over ours.
    """
    names = list(names)
    wanted = in_build_order(names)
    found = {name: place for _, name in wanted if (place := from_assets(assets, name)) is not None}
    places = {name: home(settings, tool_set) / name for tool_set, name in wanted if name not in found}
    absent = missing(settings, names, assets)
    if absent:
        build_all(settings, absent)
    return gather(settings, {**places, **found})


def missing(settings: Settings, names: Iterable[str], assets: str | None = None) -> list[tuple[ToolSet, str]]:
    """Of the named tools those that must be built, in the order of building."""
    ours = [(tool_set, name) for tool_set, name in in_build_order(names) if from_assets(assets, name) is None]
    return [(tool_set, name) for tool_set, name in ours if not (home(settings, tool_set) / name).exists()]


def cold_seconds(absent: Iterable[tuple[ToolSet, str]]) -> int:
    """How long building these takes on two cores."""
    return sum(tool_set.tools[name].seconds for tool_set, name in absent)


def longest(absent: Iterable[tuple[ToolSet, str]]) -> str:
    """The tool that takes longest to build."""
    return max(((tool_set.tools[name].seconds, name) for tool_set, name in absent), default=(0, "none"))[1]


def fitting_assets(env: Mapping[str, str]) -> str | None:
    """KUBEBUILDER_ASSETS if its API server is of the minor version of our kubelet, which must fit it."""
    assets = env.get("KUBEBUILDER_ASSETS")
    server = from_assets(assets, "kube-apiserver")
    if server is None:
        return None
    done = subprocess.run([str(server), "--version"], capture_output=True, text=True, check=False)
    minor = KUBERNETES_VERSION.rpartition(".")[0]
    if done.stdout.startswith(f"Kubernetes {minor}."):
        return assets
    say(f"KUBEBUILDER_ASSETS has {done.stdout.strip() or 'no API server that runs'}, not {minor}: ours is taken")
    return None


def from_assets(assets: str | None, name: str) -> Path | None:
    """The binary of KUBEBUILDER_ASSETS that takes the place of ours, if that variable is set and speaks of this tool."""
    if not assets or name not in ENVTEST_TOOLS:
        return None
    place = Path(assets).absolute() / name
    if not os.access(place, os.X_OK):
        raise LabError(
            f"KUBEBUILDER_ASSETS={assets} has no executable {name}: unset the variable or point it to envtest's folder"
        )
    return place


def home(settings: Settings, tool_set: ToolSet) -> Path:
    """The folder in the cache that holds this very version of a tool set."""
    target = f"{os.uname().sysname.lower()}/{platform.machine()}"
    key = cache_key(settings.local / "tools" / tool_set.name, build_flags(tool_set), target)
    return settings.cache / f"{tool_set.name}-{key}"


def gather(settings: Settings, places: Mapping[str, Path]) -> Path:
    """One folder with a symbolic link to each tool; its name follows from what it links to."""
    every = {name: home(settings, tool_set) / name for tool_set in SETS.values() for name in tool_set.tools} | dict(
        places
    )
    text = "\n".join(f"{name}={place}" for name, place in sorted(every.items()))
    folder = settings.cache / f"bin-{hashlib.sha256(text.encode()).hexdigest()[:16]}"
    folder.mkdir(parents=True, exist_ok=True)
    for name, place in every.items():
        link = folder / name
        if not place.exists() or (link.is_symlink() and os.readlink(link) == str(place)):
            continue
        temporary = folder / f".{name}.{os.getpid()}"
        temporary.unlink(missing_ok=True)
        temporary.symlink_to(place)
        temporary.rename(link)
    return folder


def build_all(settings: Settings, absent: list[tuple[ToolSet, str]]) -> None:
    """Builds the tools in order, one at a time, telling how far it is."""
    if shutil.which("go") is None:
        names = " ".join(name for _, name in absent)
        raise LabError(f"Go is missing, which builds {names}: install Go 1.26 or newer and put it on the PATH")
    check_space(settings.cache)
    count = "1 tool" if len(absent) == 1 else f"{len(absent)} tools"
    say(f"{count} to build, once: about {seconds(cold_seconds(absent))} on two cores, kept in {settings.cache}")
    for number, (tool_set, name) in enumerate(absent, start=1):
        folder = home(settings, tool_set)
        with lock(settings.cache / f"{folder.name}.lock", f"{tool_set.name} tools") as held:
            if not (folder / name).exists():
                build_one(settings, tool_set, name, f"{name} ({number} of {len(absent)})", held)


def build_one(settings: Settings, tool_set: ToolSet, name: str, label: str, held: int) -> None:
    """Builds one tool under a temporary name and renames it, so that a file in the cache is always whole.

    `held` is the descriptor of the lock: should we be killed, the next builder waits for the compiler that we leave behind.
    """
    tool = tool_set.tools[name]
    folder = home(settings, tool_set)
    folder.mkdir(parents=True, exist_ok=True)
    for stale in folder.glob(f".{name}.*"):
        stale.unlink()
    temporary = folder / f".{name}.{os.getpid()}"
    say(f"building {label}, usually {seconds(tool.seconds)} cold")
    started = time.monotonic()
    argv = ["go", "build", *build_flags(tool_set), "-o", str(temporary), tool.package]
    nice = ["nice", "-n", "5"] if shutil.which("nice") else []
    env = {**os.environ, **GO_ENVIRONMENT}
    module = settings.local / "tools" / tool_set.name
    try:
        run_long(
            nice + argv,
            f"building {name}",
            folder / f"{name}.log",
            cwd=module,
            env=env,
            keep=[held],
            usual=tool.seconds,
        )
        temporary.rename(folder / name)
    finally:
        temporary.unlink(missing_ok=True)
    say(f"built {label} in {seconds(time.monotonic() - started)}")


@contextmanager
def lock(file: Path, what: str) -> Iterator[int]:
    """Holds an exclusive lock; reports it when another process holds it first. The system drops it with the last holder.

    Gives the lock's descriptor, for a child that must hold it too.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("w") as handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say(f"another process is at work on {what}: waiting for it")
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield handle.fileno()


def check_space(folder: Path) -> None:
    """Raises if less than 5 GiB are free where `folder` is or will be."""
    existing = folder
    while not existing.exists():
        existing = existing.parent
    free = shutil.disk_usage(existing).free
    if free < LEAST_FREE_BYTES:
        raise LabError(
            f"{existing} has {free / (1 << 30):.1f} GiB free and 5 GiB are needed: free some space, then run the same command again"
        )
