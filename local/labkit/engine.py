"""Owns the container engine that builds the Dockerfile in the tests: buildah, from the system's packages where the machine has none.

Called by `dockerfile`. buildah needs no daemon and mounts folders of this machine into a build, which docker can't. Its storage is a
folder of ours, so that no other storage of the machine is touched and nothing of it stays.
"""

import os
import shutil
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from . import leftovers, packages, tools
from .console import run_long
from .errors import LabError, NotRun
from .settings import Settings

PROGRAM = "buildah"
# Neither a kernel's overlays nor a network of the engine's own are needed, which a machine may withhold.
ISOLATION = ("--isolation", "chroot")


def ensure(settings: Settings) -> str:
    """The engine's program; raises NotRun where there is none and none can be had."""
    if os.geteuid() != 0:
        raise NotRun(f"only root can mount folders into a build of {PROGRAM}: run it with sudo -E")
    if shutil.which(PROGRAM) is None:
        if shutil.which("apt-get") is None:
            raise NotRun(f"this machine has no {PROGRAM} and no apt-get: install it with its own package manager")
        packages.install(settings, [PROGRAM])
    program = shutil.which(PROGRAM)
    if program is None:
        raise LabError(f"{PROGRAM} is still missing after apt-get: see {settings.logs}/apt-install.log")
    return program


@dataclass(frozen=True)
class Engine:
    program: str
    # Its images and containers, removed in the end.
    storage: Path
    # Its temporary files. What `RUN --mount=type=cache` keeps is below it, and stays.
    caches: Path
    # The lock's descriptor, which every command of the engine holds too: one that outlives us keeps the next run out.
    held: tuple[int, ...] = ()

    def argv(self, command: str, *arguments: str) -> list[str]:
        places = ["--root", str(self.storage / "root"), "--runroot", str(self.storage / "run")]
        return [self.program, "--storage-driver", "vfs", *places, command, *arguments]

    def environment(self) -> dict[str, str]:
        return {**os.environ, "TMPDIR": str(self.caches)}

    def run(self, command: str, *arguments: str) -> str:
        """A command of a few seconds; returns what it prints."""
        argv, env = self.argv(command, *arguments), self.environment()
        done = subprocess.run(argv, env=env, pass_fds=self.held, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise LabError(f"{PROGRAM} {command} {arguments[-1]} failed: {done.stderr.strip()[-300:]}")
        return done.stdout.strip()

    def load(self, archive: Path, name: str) -> None:
        """Takes an image from an archive."""
        self.run("tag", self.run("pull", "--quiet", f"oci-archive:{archive}"), name)

    def build(self, file: Path, context: Path, tag: str, options: Sequence[str], what: str, log: Path) -> None:
        """Builds a Dockerfile from images that are here; no registry is asked."""
        places = ["--file", str(file), "--tag", tag, str(context)]
        argv = self.argv("bud", *ISOLATION, "--network", "host", "--pull-never", *options, *places)
        # A build goes on where only its engine is ended.
        run_long(argv, what, log, env=self.environment(), keep=self.held, group=True)

    def output(self, image: str, argv: Sequence[str]) -> str:
        """What a program of an image prints, run as the image's user."""
        container = self.run("from", "--pull-never", image)
        try:
            return self.run("run", *ISOLATION, container, "--", *argv)
        finally:
            self.run("rm", container)

    def layout(self, image: str, folder: Path) -> None:
        """Writes an image as an OCI layout."""
        self.run("push", "--quiet", image, f"oci:{folder}:built")


def volumes(mounts: Mapping[Path, str]) -> list[str]:
    """Options that show folders and files of this machine to a build, which can't write there."""
    return [word for source, to in mounts.items() for word in ("--volume", f"{source}:{to}:ro")]


@contextmanager
def opened(settings: Settings) -> Iterator[Engine]:
    """An engine with an empty storage."""
    program = ensure(settings)
    home = settings.cache / "dockerfile"
    with tools.lock(settings.cache / "dockerfile.lock", "the build of the Dockerfile") as held:
        engine = Engine(program, home / "storage", home / "caches", (held,))
        # Left by a run that was killed.
        clear(engine)
        engine.caches.mkdir(parents=True, exist_ok=True)
        engine.storage.mkdir()
        try:
            yield engine
        finally:
            clear(engine)


def clear(engine: Engine) -> None:
    """Removes images and containers. A mount among them would be a folder of this machine, whose files are no engine's."""
    check_unmounted(engine.storage)
    if engine.storage.exists():
        shutil.rmtree(engine.storage)


def forget(engine: Engine) -> None:
    """Empties the caches."""
    check_unmounted(engine.caches)
    shutil.rmtree(engine.caches)
    engine.caches.mkdir()


def check_unmounted(folder: Path) -> None:
    mounts = leftovers.mounts_below(Path("/proc/self/mountinfo").read_text(), os.path.realpath(folder))
    if mounts:
        raise LabError(f"{mounts[0]} is still mounted: `umount` it, then run the same command again")
