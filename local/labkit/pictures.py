"""Owns the pictures of docs/images: the page and the plugin's output, of submissions that wait, run and have ended on the demo's cluster.

Called by `lab pictures`, after `lab demo`. It prints what it has drawn of terminals as text, too.
"""

import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from . import browser, build, evalai_server, image, pagetest, terminal, tools
from .browser import Tab
from .demo import CHALLENGE, LEADERBOARD, NAMESPACE, make_images
from .errors import LabError
from .kube import Kube, of_lab
from .settings import Settings

COLUMNS = 100
TEAM_A, TEAM_B = "local-team-a-token", "local-team-b-token"
SENSORS, MAP = 1, 2
# A route of the submissions that are shown while they run, long enough for all pictures.
ROUTE_MS = 9000
PATIENCE = 180
# What the submissions of the pictures run. The demo makes the first of them only.
AGENTS = ("standard", "crash-once", "crash-always", "nonsense", "slow")


@dataclass(frozen=True)
class Shown:
    """The submissions of the pictures, by how they are there."""

    finished: str
    failed: str
    running: str
    waiting: str


def run(settings: Settings) -> None:
    """Takes all pictures; raises where the demo's cluster is not there."""
    pagetest.ensure_browser(settings, pictures=True)
    with of_person(settings) as kube, browser.tab() as tab:
        if kube.attempt("kubectl", "get", "leaderboard", LEADERBOARD).returncode != 0:
            raise LabError("the pictures are of the demo's cluster, which is not there: run `make demo` first")
        make_images(settings, [f"challenge/agent:{name}" for name in AGENTS])
        with changed_back(kube):
            shown = submissions(settings, kube)
            folder = settings.repository / "docs" / "images"
            for name, drawing in terminals(kube, shown):
                pagetest.keep(folder / f"{name}.svg", drawing.encode())
            for name, data in pages(kube, tab):
                pagetest.keep(folder / f"{name}.png", data)


@contextmanager
def of_person(settings: Settings) -> Iterator[Kube]:
    """kubectl as a person has it: with the plugin, and a context with the Leaderboard's namespace, so that commands are short."""
    lab = of_lab(settings, tools.gather(settings, {}))
    built = image.target_folder(settings.repository, os.environ) / build.PROFILE
    path = os.pathsep.join([str(lab.tools), str(built), lab.env["PATH"]])
    with tempfile.TemporaryDirectory() as folder:
        config = shutil.copy(settings.kubeconfig, folder)
        kube = Kube(lab.tools, {**lab.env, "PATH": path, "KUBECONFIG": config, "TERM": "xterm"})
        kube.run("kubectl", "config", "set-context", "--current", f"--namespace={NAMESPACE}")
        yield kube


@contextmanager
def changed_back(kube: Kube) -> Iterator[None]:
    """Afterwards the Leaderboard is as the demo made it."""
    try:
        yield
    finally:
        change(kube, {"concurrency": None, "agent": {"env": None}})


def change(kube: Kube, spec: dict[str, object]) -> None:
    patch = json.dumps({"spec": spec})
    kube.run("kubectl", "patch", "leaderboard", LEADERBOARD, "--type=merge", f"--patch={patch}")


def submissions(settings: Settings, kube: Kube) -> Shown:
    """Some that have ended, each in its own way; then two that run, one with a crash, and three in line."""

    def submit(team: str, phase: int, agent: str) -> str:
        row = evalai_server.submit(settings, team, CHALLENGE, phase, f"{settings.registry}/challenge/agent:{agent}")
        wait(kube, f"submission-{row['id']}", "create")
        return f"submission-{row['id']}"

    finished = submit(TEAM_B, SENSORS, "crash-once")
    failed = submit(TEAM_B, MAP, "crash-always")
    useless = submit(TEAM_A, SENSORS, "nonsense")
    stopped = submit(TEAM_A, MAP, "slow")
    wait(kube, stopped, state("Running"))
    kube.run("kubectl", "leaderboard", "cancel", stopped)
    for name, end in ((finished, "Finished"), (failed, "Failed"), (useless, "Failed"), (stopped, "Cancelled")):
        wait(kube, name, state(end))
    change(kube, {"concurrency": {"total": 2}, "agent": {"env": [{"name": "ROUTE_MS", "value": str(ROUTE_MS)}]}})
    running, other = submit(TEAM_A, SENSORS, "crash-once"), submit(TEAM_B, MAP, "standard")
    wait(kube, other, state("Running"))
    waiting = [submit(team, SENSORS, "standard") for team in (TEAM_B, TEAM_A, TEAM_A)]
    wait(kube, running, "jsonpath={.status.workers[1].crashes}=1")
    return Shown(finished, failed, running, waiting[0])


def state(name: str) -> str:
    return f"jsonpath={{.status.state}}={name}"


def wait(kube: Kube, submission: str, what: str) -> None:
    argv = ["wait", f"--for={what}", f"submission/{submission}", f"--timeout={PATIENCE}s"]
    kube.run("kubectl", *argv, action=f"waiting for {what} of {submission}")


def terminals(kube: Kube, shown: Shown) -> Iterator[tuple[str, str]]:
    """Drawings of terminals; all that is shown is printed too."""
    sessions = {
        "submissions": ["kubectl get submissions"],
        "top": ["kubectl leaderboard status", "kubectl leaderboard top"],
        "why": [f"kubectl leaderboard why {shown.failed}"],
        "": [
            "kubectl get submissions -o wide",
            f"kubectl leaderboard status {shown.running}",
            f"kubectl describe submission {shown.failed}",
            *(f"kubectl leaderboard why {name}" for name in (shown.waiting, shown.running, shown.finished)),
        ],
    }
    for name, commands in sessions.items():
        session = [(command, terminal.shown(kube.command(*command.split()), kube.env, COLUMNS)) for command in commands]
        for command, text in session:
            print(f"$ {command}\n{terminal.plain(text)}\n", flush=True)
        if name:
            yield f"terminal-{name}", terminal.picture(session)


def pages(kube: Kube, tab: Tab) -> Iterator[tuple[str, bytes]]:
    """Pictures of the page, as `kubectl leaderboard dashboard` serves it."""
    command = kube.command("kubectl", "leaderboard", "dashboard")
    with subprocess.Popen(command, env=kube.env, stdout=subprocess.PIPE, text=True) as serving:
        try:
            address = serving.stdout.readline().partition(" ")[0] if serving.stdout else ""
            pagetest.need(address.startswith("http://"), "kubectl leaderboard dashboard names no address")
            yield from pagetest.pictures(tab, address)
        finally:
            serving.terminate()
