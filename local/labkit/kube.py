"""Owns the calls of kubectl and helm: which cluster they speak to, and what becomes of their errors. Knows no object."""

import json
import os
import subprocess
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .errors import LabError
from .settings import Settings, client_environment, without_proxy


@dataclass(frozen=True)
class Kube:
    """kubectl and helm of one folder, speaking to the cluster of one kubeconfig."""

    tools: Path
    env: dict[str, str]

    def run(self, *argv: str, given: str | None = None, action: str | None = None) -> str:
        """Runs `kubectl …` or `helm …` and returns its output; raises with its own last words if it fails."""
        done = self.attempt(*argv, given=given)
        if done.returncode != 0:
            what = action or " ".join(argv[:3])
            raise LabError(f"{what} failed: {last_words(done.stderr)}")
        return done.stdout

    def attempt(self, *argv: str, given: str | None = None) -> subprocess.CompletedProcess[str]:
        """Runs it and hands back whatever comes of it."""
        return subprocess.run(
            self.command(*argv), env=self.env, input=given, capture_output=True, text=True, check=False
        )

    def command(self, *argv: str) -> list[str]:
        return [str(self.tools / argv[0]), *argv[1:]]

    def json(self, *argv: str) -> Any:
        """What `kubectl get … ` prints, as JSON."""
        return json.loads(self.run(*argv, "--output=json"))


def at_once(work: Callable[[Any], Any], given: Iterable[Any]) -> list[Any]:
    """What comes of each, in their order: helm has to start for each rendering, on one processor."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(work, given))


def of_lab(settings: Settings, tools: Path) -> Kube:
    """Speaks to the lab's own cluster."""
    return Kube(tools, {**without_proxy(os.environ), **client_environment(settings)})


def last_words(output: str, most: int = 600) -> str:
    """The end of an error output in one line."""
    lines: Sequence[str] = [line.strip() for line in output.strip().splitlines() if line.strip()]
    return " | ".join(lines[-4:])[-most:] or "it said nothing"
