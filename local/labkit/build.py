"""Owns cargo: builds the programs that the demo, the images and the tests need, always with the same selection and profile.

Called by `demo` and `testrun`. One selection (the whole workspace) matters: cargo chooses the features of shared dependencies by
what is built together, so that another selection would compile half the tree again. What only tests depend on is not built with the
programs, and `local/features` asks for the features that it asks for.
"""

import os
import platform
import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

from .console import run_long, say
from .errors import LabError
from .image import target_folder
from .settings import Settings

PROFILE = "local"
# From nothing on two cores that do nothing else, next to the tools in Go (docs/decisions/0054-the-first-build.md).
PROGRAMS_SECONDS, STATIC_SECONDS, RUNNER_SECONDS = 410, 25, 45
SELECTION = ("--workspace",)
PROGRAMS = ("leaderboard-operator", "kubectl-leaderboard", "evalai-stand-in")
# What goes into other images: the runner, the stand-ins of simulator and agent, and the probe.
STATIC_PACKAGES = ("leaderboard-runner", "challenge-stand-in", "challenge-probe")
STATIC = "-C target-feature=+crt-static"


def triple() -> str:
    """The target of static programs: that of this machine, named, so that cargo builds them apart."""
    return f"{platform.machine()}-unknown-linux-gnu"


def check_cargo() -> None:
    if shutil.which("cargo") is None:
        raise LabError("cargo is missing: install Rust 1.95 or newer (https://rustup.rs) and put it on the PATH")


def programs(settings: Settings) -> None:
    """Builds what runs outside of other images: the operator, the plugin and EvalAI's stand-in."""
    cargo(settings, program_arguments(), "building the programs", PROGRAMS_SECONDS)


def program_arguments() -> list[str]:
    return ["build", *SELECTION, *(f"--bin={name}" for name in PROGRAMS), "--profile", PROFILE]


def static_programs(settings: Settings) -> None:
    """Builds what goes into other images."""
    packages = [f"--package={name}" for name in STATIC_PACKAGES]
    arguments = ["build", "--profile", PROFILE, "--target", triple(), *packages]
    cargo(settings, arguments, "building the static programs", STATIC_SECONDS, {"RUSTFLAGS": STATIC})


def released_runner(settings: Settings) -> None:
    """Builds the runner as a release has it, small: for the image that the Dockerfile makes."""
    arguments = ["build", "--release", "--target", triple(), "--package", "leaderboard-runner"]
    cargo(settings, arguments, "building the released runner", RUNNER_SECONDS, {"RUSTFLAGS": STATIC})


def cold_seconds(settings: Settings) -> int:
    """About how long cargo takes: nothing of note where it has built here before."""
    if (target_folder(settings.repository, os.environ) / PROFILE).is_dir():
        return 0
    return PROGRAMS_SECONDS + STATIC_SECONDS


def program(settings: Settings, name: str) -> Path:
    """Where cargo has put a program of the workspace."""
    place = target_folder(settings.repository, os.environ) / PROFILE / name
    if not place.exists():
        raise LabError(f"{place} is not there although cargo built it: unset CARGO_BUILD_TARGET and CARGO_TARGET_DIR")
    return place


def cargo(
    settings: Settings, arguments: Sequence[str], what: str, usual: int, env: Mapping[str, str] | None = None
) -> None:
    """Runs cargo; `usual` is how many seconds it takes from nothing on two cores."""
    check_cargo()
    say(f"{what} (from nothing {usual} s, else a few)")
    is_cold = cold_seconds(settings) > 0
    log = settings.logs / f"cargo-{'-'.join(what.split()[1:])}.log"
    run_long(
        ["cargo", *arguments],
        what,
        log,
        cwd=settings.repository,
        env={**os.environ, "CARGO_TERM_COLOR": "never", **(env or {})},
        progress=compiled,
        # Where it has built before nobody knows how much is left.
        usual=usual if is_cold else 0,
    )


def compiled(log: str) -> str:
    """How far cargo is, from its output."""
    crates = re.findall(r"^ +Compiling (\S+)", log, re.MULTILINE)
    return f"{len(crates)} crates begun, the last one {crates[-1]}," if crates else "waiting for its turn"
