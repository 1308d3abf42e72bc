"""Owns the programs that come from the system's packages (container runtime, network plugins); installs only what is missing."""

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from .console import run_long, say
from .errors import LabError
from .settings import Settings
from .tools import lock

# program -> Debian package
PROGRAMS = {
    "containerd": "containerd",
    "ctr": "containerd",
    "runc": "runc",
    "iptables": "iptables",
    "nft": "nftables",
    "ip": "iproute2",
    "ss": "iproute2",
    "openssl": "openssl",
    "umount": "mount",
}
UPDATE_SECONDS, INSTALL_SECONDS = 5, 15
CNI_FOLDERS = (Path("/usr/lib/cni"), Path("/opt/cni/bin"), Path("/usr/libexec/cni"))
CNI_PLUGINS = ("bridge", "host-local", "portmap", "loopback")
POLICY = Path("/usr/sbin/policy-rc.d")
POLICY_TEXT = "#!/bin/sh\n# leaderboard lab: packages are being installed, their services are not wanted\nexit 101\n"


def missing() -> list[str]:
    """The Debian packages of the programs that this machine lacks."""
    packages = {package for program, package in PROGRAMS.items() if shutil.which(program) is None}
    if cni_folder() is None:
        packages.add("containernetworking-plugins")
    return sorted(packages)


def cni_folder() -> Path | None:
    """The folder that holds the network plugins we use."""
    return next((place for place in CNI_FOLDERS if all((place / name).exists() for name in CNI_PLUGINS)), None)


def ensure(settings: Settings) -> None:
    """Installs what is missing with apt-get, without starting any service."""
    packages = missing()
    if not packages:
        return
    install(settings, packages)
    if missing():
        raise LabError(f"{' '.join(missing())} is still missing after apt-get: see {settings.logs}/apt-install.log")


def install(settings: Settings, packages: Sequence[str]) -> None:
    """Installs these Debian packages."""
    names = " ".join(packages)
    if shutil.which("apt-get") is None:
        raise LabError(
            f"this machine lacks what the Debian packages {names} hold: install them with its own package manager"
        )
    say(f"installing the Debian packages {names}, usually {UPDATE_SECONDS + INSTALL_SECONDS} s")
    env = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    # Of two at once the second would fail.
    with lock(settings.cache / "packages.lock", "the system's packages"), no_services():
        argv = ["apt-get", "update", "--quiet"]
        run_long(argv, "updating the package lists", settings.logs / "apt-update.log", env=env, usual=UPDATE_SECONDS)
        argv = ["apt-get", "install", "--yes", "--quiet", "--no-install-recommends", *packages]
        run_long(argv, "installing packages", settings.logs / "apt-install.log", env=env, usual=INSTALL_SECONDS)


@contextmanager
def no_services() -> Iterator[None]:
    """Keeps packages from starting their services while they are installed, unless the machine has a policy of its own."""
    # Ours may be left from a run that was killed.
    if POLICY.exists() and POLICY.read_text(errors="replace") != POLICY_TEXT:
        yield
        return
    POLICY.write_text(POLICY_TEXT)
    POLICY.chmod(0o755)
    try:
        yield
    finally:
        POLICY.unlink(missing_ok=True)
