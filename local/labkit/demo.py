"""Owns the demo: from nothing to one submission whose score is in Kubernetes, S3, DynamoDB and EvalAI, and equal to what it must be.

Called by `lab demo`. Every step may be repeated, so the demo goes on where it was interrupted, and a second run only submits again.
"""

import json
import os
import shlex
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from . import aws, build, cluster, demo_check, evalai_server, firstbuild, image, packages, pki, pythonenv, tools
from .console import say, seconds
from .demo_check import Findings
from .errors import LabError
from .follow import follow
from .kube import Kube, of_lab
from .settings import HOST_ADDRESS, PORTS, Settings

SYSTEM = "leaderboard-system"
NAMESPACE = "leaderboard"
LEADERBOARD = "leaderboard-20"
RELEASE = "leaderboard-operator"
CHALLENGE, PHASE, SPLIT = 1, 1, 1
PARTICIPANT, ORGANIZER = "local-team-a-token", "local-organizer-token"
CONTENTS, SIMULATOR, AGENT = "challenge/contents:1", "challenge/simulator:1", "challenge/agent:standard"
# Agents that the demo's last lines name.
CRASHES, PRINTS = "challenge/agent:crash-once", "challenge/agent:print-routes"
OPERATOR = "leaderboard-operator:dev"
# The Leaderboard without CARLA, and what its agent needs for a game on average: local/games/README.md works it out.
GAME, GUESSES = "guessing-game", "8.25"
# The tests have more.
IMAGES = (OPERATOR, CONTENTS, SIMULATOR, AGENT, CRASHES, PRINTS, f"{GAME}/evaluator:1", f"{GAME}/agent:1")
CERTIFICATES = Path("/etc/ssl/certs/ca-certificates.crt")
RUN_PATIENCE = 600
# On two cores that do nothing else.
FIRST_MINUTES = 12
# Of the steps that are taken each time.
RUN_SECONDS = 90
STEPS = 7
TOOLS = (*cluster.CLUSTER_TOOLS, "helm")


def run(settings: Settings) -> None:
    """The whole demo; raises if a step fails or the result is not the expected one."""
    started = time.monotonic()
    cluster.check_machine(settings)
    say(forecast(settings))
    if other := foreign_cluster(settings, os.environ):
        say(other)
    folder = prepare(settings)
    kube = of_lab(settings, folder)
    step(3, "images, made here and pushed to the AWS stand-in's registry", "10 s, or 2 s if they are there")
    pinned = make_images(settings, IMAGES)
    step(4, "EvalAI's stand-in", "1 s")
    evalai_server.ensure(settings, build.program(settings, "evalai-stand-in"))
    install(settings, kube, pinned)
    apply_leaderboards(settings, kube, pinned)
    game = submit_game(settings, kube, pinned)
    submission = submit_and_follow(settings, kube, pinned[AGENT])
    findings = collect(settings, kube, submission)
    show(kube, findings)
    check(settings, findings)
    check_game(kube, game)
    say(f"the demo is done ({seconds(time.monotonic() - started)})")
    print(next_steps(settings, findings))


def forecast(settings: Settings) -> str:
    """How long it will take, and why."""
    built = firstbuild.cold_seconds(settings, TOOLS)
    total = f"this takes about {seconds(built + RUN_SECONDS)} on two cores"
    run = f"{seconds(RUN_SECONDS)} for the cluster, the images and one submission"
    if not built:
        return f"{total}: {run}"
    absent = firstbuild.absent(settings, TOOLS)
    whats = [
        f"{len(absent)} tools from source ({tools.longest(absent)} takes longest)" if absent else "",
        "the operator and the stand-ins in Rust" if build.cold_seconds(settings) else "",
        "" if pythonenv.is_whole(settings) else "the AWS stand-in's packages",
    ]
    parts = f"{seconds(built)} for {', '.join(filter(None, whats))}, and {run}"
    return f"{total} that do nothing else: {parts}; what is built is kept, so that the next time takes a minute or two"


def foreign_cluster(settings: Settings, env: Mapping[str, str]) -> str:
    """How to use a cluster that the machine has already; empty without one. It is never changed unasked."""
    if env.get("KUBECONFIG", str(settings.kubeconfig)) == str(settings.kubeconfig):
        return ""
    return (
        f"the cluster of KUBECONFIG={env['KUBECONFIG']} is left alone, and one is made here; "
        "`make demo REGISTRY=NAME` uses it, with images pushed to that registry: no Kubernetes to build, no root"
    )


def step(number: int, what: str, usual: str) -> None:
    say(f"[{number}/{STEPS}] {what} (usually {usual})")


def prepare(settings: Settings) -> Path:
    """Steps 1 and 2: everything that has to be built, and the cluster. Returns the folder of tools."""
    what = "Kubernetes, etcd and helm in Go; next to them operator and stand-ins in Rust"
    step(1, what, f"{FIRST_MINUTES} min the first time, then 2 s")
    tools.check_space(settings.state)
    packages.ensure(settings)
    firstbuild.ensure(settings, TOOLS)
    folder = tools.ensure(settings, TOOLS, tools.fitting_assets(os.environ))
    step(2, "the cluster and the AWS stand-in", "15 s, or 1 s if they run")
    cluster.up(settings)
    return folder


def make_images(settings: Settings, names: Collection[str] = ()) -> dict[str, str]:
    """Pushes the named images, or all; returns repository:tag → the reference with its digest."""
    if not CERTIFICATES.exists():
        raise LabError(
            f"{CERTIFICATES} is missing, which goes into the operator's image: apt-get install ca-certificates"
        )
    search = image.Search({}, image.target_folder(settings.repository, os.environ), build.PROFILE)
    specs = [
        spec
        for file in ("operator-image.toml", "challenge/images.toml", "games/images.toml")
        for spec in image.specs(settings.local / file)
        if not names or spec.name in names
    ]
    made = image.push_all(settings, specs, search)
    return {reference.partition("@")[0].removeprefix(f"{settings.registry}/"): reference for reference in made}


def install(settings: Settings, kube: Kube, pinned: dict[str, str]) -> None:
    """Step 5: the chart, with the operator's image by its digest."""
    step(5, f"the operator, by its Helm chart, in the namespace {SYSTEM}", "10 s")
    for name in ("namespaces.yaml", "secrets.yaml"):
        apply(settings, kube, name, pinned)
    # The commands that README and the demo's last lines name are then short.
    pki.choose_namespace(settings.kubeconfig, NAMESPACE)
    unblock(kube)
    values = manifest(settings, "values.yaml", {})
    digest = pinned[OPERATOR].partition("@")[2]
    chart = str(settings.repository / "charts" / RELEASE)
    argv = [
        "upgrade",
        RELEASE,
        chart,
        "--install",
        f"--namespace={SYSTEM}",
        "--values=-",
        f"--set=image.digest={digest}",
    ]
    # The definitions may be there already, applied by hand.
    argv += ["--take-ownership", "--force-conflicts"]
    done = kube.attempt("helm", *argv, "--wait", "--timeout=180s", given=values)
    if done.returncode != 0:
        raise LabError(f"helm could not install the operator: {words(done.stderr)}; {why_not_ready(kube)}")


def take_away(kube: Kube) -> None:
    """Uninstalls the demo's operator, which serves all namespaces and would read the queues of others; definitions stay."""
    kube.run("helm", "uninstall", RELEASE, f"--namespace={SYSTEM}", "--ignore-not-found", "--wait", "--timeout=120s")


def unblock(kube: Kube) -> None:
    """Removes the record of an upgrade that was killed: Helm would refuse the next one because of it."""
    for status in ("pending-install", "pending-upgrade", "pending-rollback"):
        selector = f"owner=helm,name={RELEASE},status={status}"
        kube.run("kubectl", "delete", "secret", f"--namespace={SYSTEM}", f"--selector={selector}")


def why_not_ready(kube: Kube) -> str:
    """The last words of the Pods that are not ready, and where to look."""
    said = []
    for component in ("controller", "bridge"):
        selector = f"app.kubernetes.io/component={component}"
        log = kube.attempt("kubectl", "logs", f"--namespace={SYSTEM}", f"--selector={selector}", "--tail=1")
        said.append(f"{component}: {words(log.stdout or log.stderr)}")
    return f"{'; '.join(said)}; see `kubectl -n {SYSTEM} get pods,events`"


def words(text: str) -> str:
    return " | ".join(line.strip() for line in text.strip().splitlines()[-3:])[-400:] or "no word"


def apply_leaderboards(settings: Settings, kube: Kube, pinned: dict[str, str]) -> None:
    """Step 6: both Leaderboards; waits until the controller reports that it can serve them."""
    step(6, f"the Leaderboards {LEADERBOARD} and {GAME} in the namespace {NAMESPACE}", "3 s")
    for name in ("leaderboard.yaml", f"{GAME}.yaml"):
        apply(settings, kube, name, pinned)
    for board in (LEADERBOARD, GAME):
        await_ready(kube, board)


def await_ready(kube: Kube, name: str) -> None:
    wanted = ["wait", "--for=condition=Ready", f"leaderboard/{name}", f"--namespace={NAMESPACE}"]
    done = kube.attempt("kubectl", *wanted, "--timeout=120s")
    if done.returncode != 0:
        board = kube.json("kubectl", "get", "leaderboard", name, f"--namespace={NAMESPACE}")
        ready = [one for one in board.get("status", {}).get("conditions", []) if one["type"] == "Ready"]
        reason = f"{ready[0]['reason']}: {ready[0]['message']}" if ready else "the controller has not looked at it"
        raise LabError(f"Leaderboard {name} does not become Ready: {reason}; see the controller's log")


def apply(settings: Settings, kube: Kube, name: str, pinned: dict[str, str]) -> None:
    text = manifest(settings, name, pinned)
    kube.run("kubectl", "apply", "--filename=-", given=text, action=f"kubectl apply of examples/demo/{name}")


def manifest(settings: Settings, name: str, pinned: dict[str, str]) -> str:
    """A file of examples/demo with this lab's ports, and images by their digests: a tag would not be pulled again."""
    text = (settings.repository / "examples" / "demo" / name).read_text()
    text = text.replace(f"{HOST_ADDRESS}:{PORTS['aws']}", settings.registry)
    text = text.replace(f"http://{HOST_ADDRESS}:{PORTS['evalai']}", settings.evalai_endpoint)
    if settings.ports["aws"] != PORTS["aws"]:
        text = text.replace(f"ports: [{PORTS['aws']}]", f"ports: [{settings.ports['aws']}]")
    for image_name, reference in pinned.items():
        text = text.replace(f"image: {settings.registry}/{image_name}\n", f"image: {reference}\n")
    return text


@dataclass(frozen=True)
class Submitted:
    """What EvalAI calls it, and its Submission."""

    key: int
    team: int
    name: str


def submit_game(settings: Settings, kube: Kube, pinned: dict[str, str]) -> str:
    """Begins step 7 with a submission to the challenge without CARLA, which runs beside; returns its name."""
    step(
        7,
        f"a submission to {GAME} by kubectl, and one of team-a to EvalAI, phase SENSORS",
        "30 s until the score is published",
    )
    given = manifest(settings, "game.yaml", pinned)
    made = kube.run(
        "kubectl", "create", "--filename=-", "--output=name", given=given, action="kubectl create of a game"
    )
    return made.strip().partition("/")[2]


def check_game(kube: Kube, name: str) -> None:
    """Waits for the end of the game, prints it, and raises if its score is another one."""
    heading(f"Next to it, a challenge without CARLA: {GAME}")
    wanted = ["wait", "--for=condition=Finished", f"submission/{name}", f"--namespace={NAMESPACE}"]
    kube.attempt("kubectl", *wanted, "--timeout=120s")
    print(kube.run("kubectl", "get", "submission", name, f"--namespace={NAMESPACE}").rstrip())
    found = kube.json("kubectl", "get", "submission", name, f"--namespace={NAMESPACE}").get("status", {})
    score = found.get("score", {}).get("text")
    if (found.get("state"), score) != ("Finished", GUESSES):
        raise LabError(
            f"the game {name} is {found.get('state')} with score {score} in place of Finished with {GUESSES}: {found.get('message')}"
        )


def submit_and_follow(settings: Settings, kube: Kube, agent: str) -> Submitted:
    """The rest of step 7: a participant pushes; EvalAI publishes into SQS; from there on nobody helps."""
    row = evalai_server.submit(settings, PARTICIPANT, CHALLENGE, PHASE, agent)
    since = time.monotonic()
    submitted = Submitted(row["id"], row["participant_team"], f"submission-{row['id']}")
    print_line(
        f"{'0 s':>8}  EvalAI has submission {submitted.key} and has put its message into SQS: {message(settings, submitted.key)}"
    )
    wait = ["wait", "--for=create", f"submission/{submitted.name}", f"--namespace={NAMESPACE}", "--timeout=60s"]
    done = kube.attempt("kubectl", *wait)
    if done.returncode != 0:
        raise LabError(
            f"the bridge made no Submission of the message within 60 s; see `kubectl -n {SYSTEM} logs deployment/{RELEASE}-bridge`"
        )
    follow(kube, NAMESPACE, submitted.name, since, RUN_PATIENCE, print_line)
    return submitted


def print_line(line: str) -> None:
    print(f"    {line}", flush=True)


def message(settings: Settings, key: int) -> str:
    """The message as EvalAI published it."""
    published = evalai_server.call(settings, "GET", "/_stand-in/state").get("published", [])
    bodies = [one.get("body", one.get("message", one)) for one in published]
    mine = [body for body in bodies if str(key) == str(body.get("submission_pk"))]
    return json.dumps(mine[-1]) if mine else "(see /_stand-in/state)"


def collect(settings: Settings, kube: Kube, submitted: Submitted) -> Findings:
    """Reads all four places, each by itself."""
    arguments = [LEADERBOARD, f"{submitted.key}/", LEADERBOARD, str(submitted.team), str(submitted.key)]
    stored = json.loads(aws.call_client(settings, "aws_results", arguments))
    state = evalai_server.call(settings, "GET", "/_stand-in/state")
    rows = state.get("rows", {})
    entries = [row for row in (rows.values() if isinstance(rows, dict) else rows) if row["submission"] == submitted.key]
    return Findings(
        submission=kube.json("kubectl", "get", "submission", submitted.name, f"--namespace={NAMESPACE}"),
        objects=stored["objects"],
        texts=stored["texts"],
        row=stored["row"],
        evalai=evalai_server.call(settings, "GET", f"/api/jobs/submission/{submitted.key}", token=ORGANIZER),
        entries=entries,
    )


def show(kube: Kube, found: Findings) -> None:
    """Prints what the four places hold."""
    name = found.submission["metadata"]["name"]
    heading("kubectl get submissions -o wide")
    table = kube.run("kubectl", "get", "submission", name, f"--namespace={NAMESPACE}", "--output=wide")
    print(table.rstrip())
    heading("Timeline (UTC, to the second where Kubernetes keeps seconds)")
    print("\n".join(demo_check.timeline(found.submission)))
    heading(f"S3: {found.submission['status']['resultsURL']}")
    for key, size in sorted(found.objects.items()):
        print(f"{size:>9}  {key}")
    heading(f"DynamoDB: table {LEADERBOARD}")
    for column, value in sorted((found.row or {}).items()):
        print(f"{column:<38}{value}")
    heading("EvalAI")
    for field in ("status", "participant_team_name", "started_at", "completed_at", "execution_time", "job_name"):
        print(f"{field:<38}{found.evalai.get(field)}")
    for entry in found.entries:
        for metric, value in entry.get("result", {}).items():
            print(f"  {metric:<36}{value}")


def heading(text: str) -> None:
    print(f"\n--- {text}", flush=True)


def check(settings: Settings, found: Findings) -> None:
    """Raises with every difference from local/challenge/expected.json."""
    expected: dict[str, Any] = json.loads((settings.local / "challenge" / "expected.json").read_text())
    differences = demo_check.differences(expected, found)
    heading("The same in all four places?")
    if differences:
        print("\n".join(differences))
        raise LabError(
            f"{len(differences)} differences from local/challenge/expected.json, the first: {differences[0]}"
        )
    metrics = len(expected["metrics"])
    score = expected["metrics"]["Driving score"]
    print(
        f"Yes: status, progress, score {score} and all {metrics} metrics agree in Kubernetes, S3, DynamoDB and EvalAI,\n"
        "and equal local/challenge/expected.json, which was worked out by hand."
    )


def next_steps(settings: Settings, found: Findings) -> str:
    """What a person may do now."""
    name, key = found.submission["metadata"]["name"], found.evalai["id"]
    stand_in = shlex.quote(os.path.relpath(build.program(settings, "evalai-stand-in")))
    at = "" if settings.ports["evalai"] == PORTS["evalai"] else f" --server {settings.evalai_endpoint}"
    return f"""
What to try next:
  eval "$(local/lab env)"                                   # kubectl with the plugin and this namespace, helm, AWS's variables
  kubectl describe submission {name}
  kubectl leaderboard dashboard                             # in a browser
  {stand_in} submit {settings.registry}/{CRASHES} --phase 2{at}
  {stand_in} submit {settings.registry}/{PRINTS}{at}
  kubectl get submissions --watch
  kubectl leaderboard scores {GAME}
  {stand_in} show {key}{at}
  http://127.0.0.1:{settings.ports["evalai"]}/                                    # EvalAI's submissions and leaderboards
  make demo                                                 # once more: a new submission
  make down                                                 # end everything"""
