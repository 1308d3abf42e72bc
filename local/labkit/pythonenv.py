"""Owns the virtual environments, in the tool cache and keyed by their requirements.

One has the AWS stand-in, its client and cfn-lint, and the other one what runs the files of examples.
"""

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
STAND_IN = "requirements.txt"
EXAMPLES = "requirements-examples.txt"
CONTENTS = {
    STAND_IN: "the AWS stand-in (ministack), boto3 and cfn-lint",
    EXAMPLES: "awscli, Lua, CEL, jsonschema and shellcheck",
}


def ensure(settings: Settings, name: str = STAND_IN) -> Path:
    """Makes the virtual environment of a file of requirements if it is not there, and returns its folder of programs."""
    folder = home(settings, name)
    if not is_whole(settings, name):
        with lock(settings.cache / f"{folder.name}.lock", "the Python environment"):
            if not is_whole(settings, name):
                build(folder, name, settings)
                mark(settings, name).touch()
    return folder / "bin"


def is_whole(settings: Settings, name: str = STAND_IN) -> bool:
    return mark(settings, name).exists()


def mark(settings: Settings, name: str = STAND_IN) -> Path:
    """Scripts in the environment hold its name, so it can't be renamed: this file shows that it is whole."""
    return home(settings, name) / ".complete"


def home(settings: Settings, name: str = STAND_IN) -> Path:
    """Where this very environment is, or will be."""
    requirements = (settings.local / name).read_bytes()
    key = hashlib.sha256(requirements + platform.python_version().encode()).hexdigest()[:16]
    return settings.cache / f"python-{key}"


def build(folder: Path, name: str, settings: Settings) -> None:
    say(f"installing {CONTENTS[name]}, usually {USUAL_SECONDS} s")
    shutil.rmtree(folder, ignore_errors=True)
    made = subprocess.run([sys.executable, "-m", "venv", str(folder)], capture_output=True, text=True, check=False)
    if made.returncode != 0:
        raise LabError(
            f"{sys.executable} can't make a virtual environment: install its venv module (Debian: apt-get install python3-venv)"
        )
    pip = [str(folder / "bin" / "python"), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    log = settings.cache / f"{folder.name}.log"
    run_long(
        [*pip, "--requirement", str(settings.local / name)],
        "installing Python packages",
        log,
        env=dict(os.environ),
        usual=USUAL_SECONDS,
    )
