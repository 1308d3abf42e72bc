"""Owns the virtual environment with the AWS stand-in, its client and cfn-lint; it lives in the tool cache, keyed by its requirements."""

import hashlib
import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

from .console import run_long, say
from .errors import LabError
from .settings import Settings
from .tools import lock

USUAL_SECONDS = 40


def ensure(settings: Settings) -> Path:
    """Makes the virtual environment if it is not there, and returns its folder of programs."""
    requirements = settings.local / "requirements.txt"
    folder = home(settings)
    if not is_whole(settings):
        with lock(settings.cache / f"{folder.name}.lock", "the Python environment"):
            if not is_whole(settings):
                build(folder, requirements, settings)
                mark(settings).touch()
    return folder / "bin"


def is_whole(settings: Settings) -> bool:
    return mark(settings).exists()


def mark(settings: Settings) -> Path:
    """Scripts in the environment hold its name, so it can't be renamed: this file shows that it is whole."""
    return home(settings) / ".complete"


def home(settings: Settings) -> Path:
    """Where this very environment is, or will be."""
    requirements = (settings.local / "requirements.txt").read_bytes()
    key = hashlib.sha256(requirements + platform.python_version().encode()).hexdigest()[:16]
    return settings.cache / f"python-{key}"


def build(folder: Path, requirements: Path, settings: Settings) -> None:
    say(f"installing the AWS stand-in (ministack), boto3 and cfn-lint, usually {USUAL_SECONDS} s")
    shutil.rmtree(folder, ignore_errors=True)
    made = subprocess.run([sys.executable, "-m", "venv", str(folder)], capture_output=True, text=True, check=False)
    if made.returncode != 0:
        raise LabError(
            f"{sys.executable} can't make a virtual environment: install its venv module (Debian: apt-get install python3-venv)"
        )
    pip = [str(folder / "bin" / "python"), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    log = settings.cache / f"{folder.name}.log"
    run_long(
        [*pip, "--requirement", str(requirements)],
        "installing Python packages",
        log,
        env=dict(os.environ),
        usual=USUAL_SECONDS,
    )
