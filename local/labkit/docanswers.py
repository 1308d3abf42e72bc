"""Owns what lets more of the documents' commands run on this machine: EvalAI's stand-in for curl, the plugin's own files for man.

Called by `docruns`. Programs that the machine lacks come from the system's packages where that can be; without them their lines are
only noted.
"""

import json
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from . import apiserver, build, packages, process
from .components import answers
from .docprograms import PLUGIN, variable
from .errors import LabError
from .settings import Settings

# program -> Debian package
PROGRAMS = {"curl": "curl", "man": "man-db"}
STAND_IN = "evalai-stand-in"
# As the pages have them; PLACEHOLDER is what they write where a host has the name of a queue.
EVALAI, CHALLENGE, QUEUE, PLACEHOLDER = "https://eval.ai", 2098, "leaderboard", "QUEUE_NAME"
PATIENCE = 60


@contextmanager
def running(settings: Settings, folder: Path) -> Iterator[dict[str, str]]:
    """For the time of the block; gives what a page's shell finds in its environment."""
    build.programs(settings)
    (port,) = apiserver.free_ports(1)
    seed = folder / "seed.json"
    seed.write_text(json.dumps(world(settings.local)))
    argv = [str(build.program(settings, STAND_IN)), "serve", f"--listen=127.0.0.1:{port}", f"--seed={seed}"]
    with (folder / "evalai.log").open("wb") as log:
        child = subprocess.Popen([*argv, f"--queue-url={QUEUE}"], stdin=subprocess.DEVNULL, stdout=log, stderr=log)
    try:
        url = f"http://127.0.0.1:{port}"
        if not process.wait_until(lambda: answers(f"{url}/_stand-in/health"), PATIENCE):
            raise LabError(f"EvalAI's stand-in does not answer: {process.tail(folder / 'evalai.log')}")
        yield {**programs(settings), "DOCUMENTS_EVALAI": url, "TOKEN": "local-host-token"}
    finally:
        child.kill()
        child.wait()


def world(local: Path) -> dict[str, object]:
    """The stand-in's own challenge under the number of the documents."""
    seed = json.loads((local / "evalai" / "seed.json").read_text())
    seed["challenges"][0]["id"] = CHALLENGE
    return dict(seed)


def programs(settings: Settings) -> dict[str, str]:
    """Where those are that run."""
    lacking = [package for name, package in PROGRAMS.items() if shutil.which(name) is None]
    if lacking and os.geteuid() == 0 and shutil.which("apt-get"):
        packages.install(settings, lacking)
    found = {name: shutil.which(name) for name in PROGRAMS}
    found[PLUGIN] = str(build.program(settings, PLUGIN))
    return {variable(name): place for name, place in found.items() if place}
