"""Owns cargo: builds the programs that the demo, the images and the tests need, always with the same selection and profile.

Called by `demo` and `testrun`. One selection (the whole workspace) matters: cargo chooses the features of shared dependencies by
what is built together, so that another selection would compile half the tree again. A test program is part of it, as with tests
cargo counts the dependencies of tests in.
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
# From nothing on two cores.
PROGRAMS_SECONDS, RUNNER_SECONDS, STAND_INS_SECONDS = 420, 45, 30
# The test program that costs nearly nothing on top of what is built anyway.
CHEAPEST_TEST = "programs"
SELECTION = ("--workspace", "--test", CHEAPEST_TEST)
STATIC = "-C target-feature=+crt-static"


def triple() -> str:
    """The target of static programs: that of this machine, named, so that cargo builds them apart."""
    return f"{platform.machine()}-unknown-linux-gnu"


def check_cargo() -> None:
    if shutil.which("cargo") is None:
        raise LabError("cargo is missing: install Rust 1.95 or newer (https://rustup.rs) and put it on the PATH")


def programs(settings: Settings) -> None:
    """Builds every program of the workspace: the operator and the stand-in of EvalAI among them."""
    cargo(settings, ["build", *SELECTION, "--bins", "--profile", PROFILE], "building the programs", PROGRAMS_SECONDS)


def static_programs(settings: Settings) -> None:
    """Builds what goes into other images: the runner, small, the stand-ins of simulator and agent, and the probe."""
    env = {"RUSTFLAGS": STATIC}
    runner = ["build", "--release", "--target", triple(), "--package", "leaderboard-runner"]
    cargo(settings, runner, "building the static runner", RUNNER_SECONDS, env)
    challenge = ["build", "--profile", PROFILE, "--target", triple()]
    challenge += ["--package", "challenge-stand-in", "--package", "challenge-probe"]
    cargo(settings, challenge, "building the static stand-ins", STAND_INS_SECONDS, env)


def cold_seconds(settings: Settings) -> int:
    """About how long cargo takes: nothing of note where it has built here before."""
    if (target_folder(settings.repository, os.environ) / PROFILE).is_dir():
        return 0
    return PROGRAMS_SECONDS + RUNNER_SECONDS + STAND_INS_SECONDS


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
