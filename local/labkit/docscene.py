"""Owns the objects that the commands of the documents find on the API server, and the manifests of the documents, which it applies.

Called by `docruns`. kubectl turns YAML into JSON and lays a fragment over an example, so that nothing here reads YAML.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from . import docpages
from .chartcases import RELEASE, SET_IMAGE, SYSTEM
from .chartrender import documents, folder
from .docpages import Block
from .kube import Kube, last_words

EXAMPLE = "examples/leaderboard-20.yaml"
# As they are called in the pages. `sample` stands for NAME.
NAMESPACES = ("leaderboard", "carla", "challenge", "leaderboards", "leaderboard-demo")
FURNISHED = ("default", "leaderboard", "carla")
SUBMISSIONS = ("sample", "submission-1", "submission-42")
LEADERBOARDS = ("sample", "carla-20", "leaderboard-20")
# Manifests that no server of ours takes, with the reason.
NOT_OURS = {
    "kind: NodePool": "Karpenter's own definitions are not here",
    "timeSlicing:": "a file of NVIDIA's device plugin",
}
# First lines of values of the chart that stand in other pages than its own.
VALUES = ("networkPolicy:\n", "controller:\n")
# What the rest of the example cannot stand next to, by page.
INSTEAD: dict[str, dict[str, Any]] = {
    "docs/evalai.md": {"queue": None, "evalai": {"token": {"secretsManager": None}}},
    "docs/evaluator.md": {
        "evaluation": {
            "carla": None,
            "container": {"mode": "Batch", "image": "registry.example/evaluator:1", "command": ["python3"]},
        },
        "tracks": [{"name": "test", "container": {"score": {"metric": "accuracy"}}}],
        "agent": {"command": ["python3"]},
        "evalai": None,
        "queue": None,
    },
    "docs/gpu.md": {"gpu": None},
    "docs/migrate.md": {"queue": None, "table": None},
}
LEASE: dict[str, Any] = {"apiVersion": "coordination.k8s.io/v1", "kind": "Lease"}
CONTAINER = {"name": "agent", "image": "registry.example/agent:1"}
TEMPLATE = {"spec": {"restartPolicy": "Never", "containers": [CONTAINER]}}
JOB: dict[str, Any] = {"apiVersion": "batch/v1", "kind": "Job", "spec": {"template": TEMPLATE}}
# What the pipeline before this one has on its nodes, as docs/migrate.md finds it.
FLUENTD: tuple[dict[str, Any], ...] = (
    {
        "apiVersion": "apps/v1",
        "kind": "DaemonSet",
        "metadata": {"name": "fluentd", "namespace": "kube-system"},
        "spec": {
            "selector": {"matchLabels": {"app": "fluentd"}},
            "template": {
                "metadata": {"labels": {"app": "fluentd"}},
                "spec": {"containers": [{"name": "fluentd", "image": "registry.example/fluentd:1"}]},
            },
        },
    },
    {
        "apiVersion": "v1",
        "kind": "ConfigMap",
        "metadata": {"name": "fluentd-config", "namespace": "kube-system"},
    },
)
APPLY = ("apply", "--server-side", "--force-conflicts", "--dry-run=server", "--validate=strict", "--filename=-")


def prepare(repository: Path, kube: Kube) -> None:
    """The operator as the chart installs it, and objects by the names that the pages use, which have ended well."""
    argv = ["install", RELEASE, str(folder(repository)), f"--namespace={SYSTEM}", "--create-namespace", SET_IMAGE]
    kube.run("helm", *argv)
    definitions = ("crd/leaderboards.leaderboard.carla.org", "crd/submissions.leaderboard.carla.org")
    kube.run("kubectl", "wait", "--for=condition=Established", *definitions, "--timeout=60s")
    board = example(repository, kube, {})
    items = [{"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": name}} for name in NAMESPACES]
    items += [named(LEASE, RELEASE, SYSTEM), named(JOB, "sample", "default"), *FLUENTD]
    items.append(named(submission(), "submission-1", "leaderboard-demo"))
    for namespace in FURNISHED:
        items += [named(board, name, namespace) for name in LEADERBOARDS]
        items += [named(submission(), name, namespace) for name in SUBMISSIONS]
    given = json.dumps({"apiVersion": "v1", "kind": "List", "items": items})
    kube.run("kubectl", "apply", "--server-side", "--validate=strict", "--filename=-", given=given)
    for namespace in FURNISHED:
        for names, types in ((SUBMISSIONS, ("Finished",)), (LEADERBOARDS, ("Ready",))):
            kind = "submissions" if names == SUBMISSIONS else "leaderboards"
            patch = f"--patch={json.dumps({'status': {'conditions': [condition(name) for name in types]}})}"
            argv = ["patch", kind, *names, f"--namespace={namespace}", "--subresource=status", "--type=merge", patch]
            kube.run("kubectl", *argv)


def condition(name: str) -> dict[str, str]:
    time = "2026-11-01T12:00:00Z"
    return {"type": name, "status": "True", "reason": "Played", "message": "", "lastTransitionTime": time}


def submission() -> dict[str, Any]:
    spec = {"leaderboardName": "sample", "track": "sensors", "image": "registry.example/agent:1"}
    return {"apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Submission", "spec": spec}


def named(example: dict[str, Any], name: str, namespace: str) -> dict[str, Any]:
    return {**example, "metadata": {"name": name, "namespace": namespace}}


def example(repository: Path, kube: Kube, patch: dict[str, Any]) -> dict[str, Any]:
    """The example with a patch laid over it, which no server has seen."""
    argv = ["patch", "--local", f"--filename={repository / EXAMPLE}", "--type=merge", "--output=json"]
    found: dict[str, Any] = json.loads(kube.run("kubectl", *argv, f"--patch={json.dumps(patch)}"))
    return found


def fields(repository: Path, kube: Kube) -> frozenset[str]:
    """What a Leaderboard has below `spec`."""
    definition = json.loads(kube.run("kubectl", "get", "crd", "leaderboards.leaderboard.carla.org", "--output=json"))
    schema = definition["spec"]["versions"][0]["schema"]["openAPIV3Schema"]
    return frozenset(schema["properties"]["spec"]["properties"])


def manifests(repository: Path, kube: Kube, found: Sequence[Block]) -> tuple[int, list[str]]:
    """How many objects and fragments of the pages the server takes, and what is wrong with the others."""
    count, faults, known = 0, [], fields(repository, kube)
    for block in found:
        if block.language != "yaml" or any(mark in block.text for mark in NOT_OURS):
            continue
        is_values = block.page == docpages.CHART or block.text.startswith(VALUES)
        for kind, text in [("values", block.text)] if is_values else docpages.manifests(block, known):
            fault = applied(repository, kube, block.page, kind, text)
            count += not fault
            faults += [f"{block.place}: {fault}"] if fault else []
    return count, faults


def applied(repository: Path, kube: Kube, page: str, kind: str, text: str) -> str:
    """What the server answers against it; empty where nothing."""
    if kind == "other":
        return "a manifest of nothing that is known: give it a kind, or a reason in docscene.py"
    if kind == "values":
        done = kube.attempt("helm", "template", RELEASE, str(folder(repository)), SET_IMAGE, "--values=-", given=text)
        return last_words(done.stderr) if done.returncode != 0 else ""
    if kind == "part":
        base = example(repository, kube, {"metadata": {"name": "fragment"}, "spec": INSTEAD.get(page, {})})
        argv = ["patch", "--local", "--filename=-", "--type=merge", f"--patch={as_json(kube, text)}", "--output=json"]
        text = kube.run("kubectl", *argv, given=json.dumps(base))
    done = kube.attempt("kubectl", *APPLY, given=text)
    # A warning is about a field that is not known, or no longer wanted.
    return last_words(done.stderr) if done.returncode != 0 or done.stderr else ""


def as_json(kube: Kube, text: str) -> str:
    """A fragment that begins with `spec`, by way of an object that may hold anything."""
    whole = "apiVersion: v1\nkind: Fragment\nmetadata: {name: fragment}\n" + text
    argv = ["patch", "--local", "--filename=-", "--type=merge", "--patch={}", "--output=json"]
    (found,) = documents(kube.run("kubectl", *argv, given=whole))
    return json.dumps({"spec": found["spec"]})
