"""Owns the API documents of the Kubernetes versions that the chart is for besides the lab's own, whose API server gives its own.

Each is a file of the Go module that Kubernetes is built from. The module is compared with a pinned sum and thrown away; the file stays in
the cache.
"""

import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .console import say
from .errors import LabError
from .settings import Settings
from .tools import lock

MODULE = "k8s.io/kubernetes"
DOCUMENT = "api/openapi-spec/swagger.json"
# The newest patch of each minor version that the Go module proxy has, and the sum of its content as in a go.sum.
SUMS: Mapping[str, str] = {
    "v1.33.13": "h1:bmH31xUdSzeA5vk0wZAK9MZp11mdLuzUSeKk0qN3hPQ=",
    "v1.34.4": "h1:Yy6R4QB8C9kJPp25GFqEvX5XQwY5qzKeqD0Xx6oAcmk=",
}


def document(settings: Settings, version: str) -> dict[str, Any]:
    """What an API server of this version serves, in OpenAPI v2."""
    file = settings.cache / f"openapi-{version}.json"
    if not file.exists():
        with lock(settings.cache / f"openapi-{version}.lock", f"the API document of Kubernetes {version}"):
            if not file.exists():
                fetch(settings.cache, version, file)
    found: dict[str, Any] = json.loads(file.read_text())
    return found


def fetch(cache: Path, version: str, file: Path) -> None:
    """Downloads the module, about 20 MB, and keeps the one file."""
    say(f"fetching the API document of Kubernetes {version}, usually 4 s")
    with tempfile.TemporaryDirectory(dir=cache, prefix=".openapi-") as folder:
        place = downloaded(version, Path(folder))
        whole = Path(folder) / file.name
        shutil.copyfile(place / DOCUMENT, whole)
        whole.replace(file)


def downloaded(version: str, folder: Path) -> Path:
    """Where Go has put the module."""
    # Its sum is compared below, so that no other server is asked for it. Without the flag the folder could not be removed.
    env = {**os.environ, "GOMODCACHE": str(folder), "GOFLAGS": "-modcacherw", "GONOSUMDB": MODULE, "GOWORK": "off"}
    argv = ["go", "mod", "download", "-json", f"{MODULE}@{version}"]
    try:
        done = subprocess.run(argv, cwd=folder, env=env, capture_output=True, text=True, check=False)
    except OSError as error:
        raise LabError(f"Go is missing, which downloads {MODULE}: install Go 1.26 or newer") from error
    answer = json.loads(done.stdout or "{}")
    if done.returncode != 0:
        words = (answer.get("Error") or done.stderr.strip())[-300:]
        raise LabError(f"{MODULE} {version} can't be downloaded ({words}); check the network or the proxy settings")
    if answer["Sum"] != SUMS[version]:
        raise LabError(f"{MODULE} {version} is not what kubeversions.py names: its sum is {answer['Sum']}")
    return Path(answer["Dir"])
