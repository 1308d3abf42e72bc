"""Owns the demo on a cluster that is there already: the quickstart, with images made here and pushed to the reader's own registry.

Called by `lab demo --registry`. It needs no root, builds no Kubernetes, and takes kubectl, helm and a container engine of the machine where
it has them. It changes what kubectl's present context names, so that it never starts by itself because KUBECONFIG happens to be set.
"""

import json
import os
import platform
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

from . import build, demo_check, image, layer, pythonenv, quickstart, release, tools
from .console import run_long, say, seconds
from .demo import AGENT, LEADERBOARD, RELEASE, RUN_PATIENCE, heading, print_line, words
from .demo_check import Findings
from .errors import LabError
from .follow import follow
from .image_spec import ImageSpec, parse
from .kube import Kube
from .settings import Settings

# Everything that the quickstart makes is in it: examples/quickstart-values.yaml names it too.
NAMESPACE = "leaderboard-demo"
CLIENTS = ("kubectl", "helm")
ENGINES = ("docker", "podman")
# Pushes, pulls and one submission.
RUN_SECONDS = 180
STEPS = 6
PUSH_LOG = "push.log"
SUBMITTED = re.compile(r"^submission (\d+) is submitted", re.MULTILINE)
# What registries and engines answer to a push -> what to do about it. {registry} is its host, {names} are the repositories.
REFUSALS = {
    "HTTP response to HTTPS client": "it speaks plain HTTP: list {registry} as insecure, for podman in /etc/containers/registries.conf, "
    "for docker as insecure-registries in /etc/docker/daemon.json",
    "name unknown|does not exist": "it makes no repositories by itself, as ECR: make {names} first",
    "authentication required|unauthorized|denied|no basic auth": "log in to {registry} first, with `login` of docker, podman or crane",
}
# host[:port]/path, as image references begin.
REGISTRY = re.compile(r"[a-z0-9][a-z0-9.-]*(:\d+)?(/[a-z0-9]+([._/-][a-z0-9]+)*)?")


def run(settings: Settings, registry: str) -> None:
    """The whole demo; raises if a step fails or the result is not the expected one."""
    started = time.monotonic()
    registry = registry.rstrip("/")
    check_machine(registry)
    say(forecast(settings))
    step(1, "kubectl, helm and a way to push images")
    folder = clients(settings)
    kube = Kube(folder, dict(os.environ))
    context = check_cluster(kube)
    step(2, "the operator, and what goes into other images")
    build.programs(settings)
    build.static_programs(settings)
    step(3, f"images, pushed to {registry}")
    pushed = push_all(settings, registry)
    step(4, f"chart and stand-ins in the namespace {NAMESPACE} of {context}")
    install(settings, kube, pushed)
    step(5, "a participant of team-a submits to EvalAI, phase SENSORS")
    name = submit_and_follow(kube, pushed[AGENT.partition(":")[0]])
    step(6, "the score in Kubernetes and on EvalAI's leaderboard")
    check(settings, kube, name)
    say(f"the demo is done ({seconds(time.monotonic() - started)})")
    print(next_steps())


def step(number: int, what: str) -> None:
    say(f"[{number}/{STEPS}] {what}")


def check_machine(registry: str) -> None:
    if (platform.system(), platform.machine()) != ("Linux", "x86_64"):
        raise LabError(
            "the images are made of this machine's programs, and submissions run on linux/amd64: use such a machine"
        )
    if not REGISTRY.fullmatch(registry):
        raise LabError(f"{registry!r} is no registry: write it as in a name of an image, such as registry.example/demo")
    if not os.environ.get("KUBECONFIG"):
        raise LabError("the demo with a registry uses the cluster of KUBECONFIG, which is not set: export it")


def forecast(settings: Settings) -> str:
    """How long it will take, and why."""
    absent = tools.missing(settings, built_here())
    reasons = [
        (tools.cold_seconds(absent), f"for {' and '.join(name for _, name in absent)}, which this machine lacks"),
        (0 if pythonenv.is_whole(settings) else pythonenv.USUAL_SECONDS, "for the AWS stand-in's packages"),
        (build.cold_seconds(settings), "for the operator and the stand-ins in Rust"),
        (RUN_SECONDS, "for pushes, pulls and one submission"),
    ]
    parts = [f"{seconds(each)} {why}" for each, why in reasons if each]
    return f"this takes about {seconds(sum(each for each, _ in reasons))} on two cores: {', '.join(parts)}"


def engine() -> str | None:
    """A container engine of this machine that answers: its credentials for the registry are then used."""
    for name in ENGINES:
        if (program := shutil.which(name)) and not subprocess.run(
            [program, "info"], capture_output=True, check=False
        ).returncode:
            return program
    return None


def built_here() -> list[str]:
    """The tools that the machine does not have. crane is a client of registries alone."""
    return [*(name for name in CLIENTS if shutil.which(name) is None), *(["crane"] if engine() is None else [])]


def clients(settings: Settings) -> Path:
    """A folder with kubectl and helm: the machine's own go before ours."""
    own = {name: Path(place) for name in CLIENTS if (place := shutil.which(name))}
    if absent := built_here():
        tools.ensure(settings, absent)
    return tools.gather(settings, own)


def check_cluster(kube: Kube) -> str:
    """The name of the context; raises where no submission could run."""
    context = kube.run("kubectl", "config", "current-context").strip()
    nodes = kube.json("kubectl", "get", "nodes", "--selector=kubernetes.io/arch=amd64")["items"]
    if not nodes:
        raise LabError(f"the cluster of {context} has no node for amd64, which the Pods of submissions need")
    return context


def specs(settings: Settings) -> Iterator[ImageSpec]:
    yield parse((settings.local / "operator-image.toml").read_text(), "operator-image.toml")[0]
    yield from quickstart.specs(settings.repository)


def push_all(settings: Settings, registry: str) -> dict[str, str]:
    """Makes and pushes the images; returns repository -> reference. The tag is of the content: nodes keep what they have of another."""
    search = image.Search({}, image.target_folder(settings.repository, os.environ), build.PROFILE)
    program = engine()
    pushed: dict[str, str] = {}
    for spec in specs(settings):
        made = image.build(settings, spec, search)
        pushed[spec.repository] = reference = f"{registry}/{spec.repository}:{made.digest.partition(':')[2][:12]}"
        try:
            push(settings, program, made, reference)
        except LabError as error:
            said = (settings.logs / PUSH_LOG).read_text(errors="replace")
            raise LabError(f"{error}{advice(said, settings, registry)}") from error
        say(f"pushed {reference}")
    return pushed


def advice(said: str, settings: Settings, registry: str) -> str:
    """What to do about a push that failed; empty where its own words show all that is known."""
    found = next((what for words, what in REFUSALS.items() if re.search(words, said, re.IGNORECASE)), "")
    path = registry.partition("/")[2]
    names = ", ".join(f"{path}/{spec.repository}".lstrip("/") for spec in specs(settings))
    return found and f"; {found.format(registry=registry.partition('/')[0], names=names)}"


def push(settings: Settings, program: str | None, made: layer.Image, reference: str) -> None:
    log = settings.logs / PUSH_LOG
    with tempfile.TemporaryDirectory(prefix="leaderboard-image-") as folder:
        archive = Path(folder) / "image.tar"
        archive.write_bytes(layer.archive(made, reference))
        if program is None:
            crane = tools.ensure(settings, ["crane"]) / "crane"
            commands = [[str(crane), "push", str(archive), reference]]
        else:
            # The nodes pull from the registry: nobody needs the engine's own copy.
            commands = [
                [program, *words] for words in (["load", f"--input={archive}"], ["push", reference], ["rmi", reference])
            ]
        for command in commands:
            run_long(command, f"pushing {reference}", log)


def install(settings: Settings, kube: Kube, pushed: Mapping[str, str]) -> None:
    """As docs/quickstart.md does it, with our images."""
    repository, _, tag = pushed[RELEASE].rpartition(":")
    values = settings.repository / "examples" / "quickstart-values.yaml"
    argv = ["upgrade", RELEASE, str(settings.repository / "charts" / RELEASE), "--install", "--create-namespace"]
    argv += [f"--namespace={NAMESPACE}", f"--values={values}", f"--set=image.repository={repository},image.tag={tag}"]
    # Not --wait: controller and bridge wait for a Secret of the manifest.
    kube.run("helm", *argv, action="helm upgrade --install")
    text = manifest(settings, pushed)
    kube.run("kubectl", "apply", f"--namespace={NAMESPACE}", "--filename=-", given=text, action="kubectl apply")
    wait = ["wait", "--for=condition=Ready", f"leaderboard/{LEADERBOARD}", f"--namespace={NAMESPACE}", "--timeout=300s"]
    done = kube.attempt("kubectl", *wait)
    if done.returncode != 0:
        raise LabError(
            f"{LEADERBOARD} does not become Ready: {words(done.stderr)}; see `kubectl -n {NAMESPACE} get pods,events`"
        )


def manifest(settings: Settings, pushed: Mapping[str, str]) -> str:
    """examples/quickstart.yaml with what was pushed in place of what a release publishes."""
    text = (settings.repository / quickstart.MANIFEST).read_text()
    version = release.version(settings.repository)
    for repository, reference in pushed.items():
        text = text.replace(f"{quickstart.PUBLISHED}{repository}:{version}\n", f"{reference}\n")
    if quickstart.PUBLISHED in text:
        raise LabError(f"{quickstart.MANIFEST} names an image that is not made here: {quickstart.IMAGE.findall(text)}")
    return text


def submit_and_follow(kube: Kube, agent: str) -> str:
    """A participant pushes; from there on nobody helps. Returns the Submission's name."""
    argv = ["exec", f"--namespace={NAMESPACE}", "deployment/evalai", "--", "evalai-stand-in"]
    said = kube.run("kubectl", *argv, "submit", agent, action="evalai-stand-in submit")
    since = time.monotonic()
    found = SUBMITTED.search(said)
    if found is None:
        raise LabError(f"EvalAI's stand-in answered {words(said)!r}, which names no submission")
    name = f"submission-{found[1]}"
    kube.run(
        "kubectl",
        "wait",
        "--for=create",
        f"submission/{name}",
        f"--namespace={NAMESPACE}",
        "--timeout=60s",
        action=f"waiting for {name}",
    )
    follow(kube, NAMESPACE, name, since, RUN_PATIENCE, print_line)
    return name


def check(settings: Settings, kube: Kube, name: str) -> None:
    """Raises with every difference from local/challenge/expected.json. What S3 and DynamoDB hold is in conditions of the Submission."""
    expected = json.loads((settings.local / "challenge" / "expected.json").read_text())
    submission = kube.json("kubectl", "get", "submission", name, f"--namespace={NAMESPACE}")
    argv = ["exec", f"--namespace={NAMESPACE}", "deployment/evalai", "--", "evalai-stand-in", "leaderboard"]
    board = kube.run("kubectl", *argv, action="evalai-stand-in leaderboard")
    heading("kubectl get submissions -o wide")
    print(kube.run("kubectl", "get", "submission", name, f"--namespace={NAMESPACE}", "--output=wide").rstrip())
    heading("EvalAI's leaderboard")
    print(board.rstrip())
    differences = list(demo_check.in_cluster(expected, Findings(submission, {}, {}, None, {}, [])))
    score = str(expected["metrics"]["Driving score"])
    if score not in board:
        differences.append(f"EvalAI: no row of its leaderboard has the score {score}")
    if differences:
        raise LabError(f"{len(differences)} differences from local/challenge/expected.json: {'; '.join(differences)}")


def next_steps() -> str:
    return f"""
What to try next, and how to remove it, is in docs/quickstart.md:
  kubectl -n {NAMESPACE} get submissions --watch
  kubectl -n {NAMESPACE} exec deployment/evalai -- evalai-stand-in leaderboard
  kubectl -n {NAMESPACE} delete submissions,leaderboards --all && helm -n {NAMESPACE} uninstall {RELEASE}"""
