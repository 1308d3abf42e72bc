"""examples/gitops: what Argo CD and Flux show of an object of each state, and manifests of other projects by their own schemas."""

import functools
import json
import os
import re
import subprocess
import tempfile
import unittest
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from labkit import chartdocs, pythonenv, settings

REPOSITORY = Path(__file__).resolve().parents[2]
EXAMPLES = REPOSITORY / "examples" / "gitops"
SCHEMAS = REPOSITORY / "local" / "schemas" / "others.json"
# Without a schema here: their own fields are few, and the tests of health read them.
UNCHECKED = {
    "v1 ConfigMap",
    "v1 Namespace",
    "argoproj.io/v1alpha1 Application",
    "source.toolkit.fluxcd.io/v1 GitRepository",
    "kustomize.toolkit.fluxcd.io/v1 Kustomization",
    "helm.toolkit.fluxcd.io/v2 HelmRelease",
}


@functools.cache
def python() -> str:
    return str(pythonenv.ensure(settings.load(REPOSITORY), pythonenv.EXAMPLES) / "python")


def labkit(*arguments: str, given: Any = None) -> Any:
    """What gitops.py says of these arguments."""
    env = {**os.environ, "PYTHONPATH": str(REPOSITORY / "local"), "PYTHONDONTWRITEBYTECODE": "1"}
    argv = [python(), "-m", "labkit.gitops", *arguments]
    done = subprocess.run(
        argv, env=env, input=json.dumps(given), capture_output=True, text=True, timeout=120, check=False
    )
    if done.returncode != 0:
        raise AssertionError(done.stderr[-2000:])
    return json.loads(done.stdout)


def condition(kind: str, status: str, reason: str, **more: Any) -> dict[str, Any]:
    return {"type": kind, "status": status, "reason": reason, "message": "", "observedGeneration": 2, **more}


def submission(state: str, reason: str, *conditions: dict[str, Any], observed: int = 2) -> dict[str, Any]:
    # As the operator writes it: a reason that repeats the state is absent.
    own = {} if reason == state else {"reason": reason}
    return {
        "apiVersion": "leaderboard.carla.org/v1alpha1",
        "kind": "Submission",
        "metadata": {"name": "a", "generation": 2},
        "spec": {"leaderboardName": "lb"},
        "status": {"observedGeneration": observed, "state": state, **own, "conditions": list(conditions)},
    }


def leaderboard(*conditions: dict[str, Any], paused: bool = False) -> dict[str, Any]:
    found = submission("", "", *conditions)
    return found | {"kind": "Leaderboard", "spec": {"paused": paused}}


def unread(found: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in found.items() if key != "status"}


LIVE = condition("Finished", "False", "Preparing")
ENDED = condition("Finished", "True", "Finished")
FAILED = condition("Finished", "True", "AgentCrashed")
READY = condition("Ready", "True", "Ready")
# What is seen, what Argo CD shows of it, and what Flux does.
STATES = {
    "a new Submission": (unread(submission("", "")), "Progressing", "InProgress"),
    "Pending": (submission("Pending", "WaitingForSlot", LIVE), "Progressing", "InProgress"),
    "Pending, its Job is in a queue of Kueue": (submission("Pending", "Suspended", LIVE), "Suspended", "InProgress"),
    "Pending, the Leaderboard is paused": (submission("Pending", "Paused", LIVE), "Suspended", "InProgress"),
    "Pending, and a person has to look": (
        submission("Pending", "LeaderboardNotFound", LIVE, condition("Stalled", "True", "LeaderboardNotFound")),
        "Degraded",
        "Failed",
    ),
    "Running": (
        submission("Running", "Running", LIVE, condition("Running", "True", "Running")),
        "Progressing",
        "InProgress",
    ),
    "Resumed": (
        submission("Resumed", "Resumed", LIVE, condition("Running", "True", "Resumed")),
        "Progressing",
        "InProgress",
    ),
    "Finished": (
        submission("Finished", "Finished", ENDED, condition("Succeeded", "True", "Finished")),
        "Healthy",
        "Current",
    ),
    "Failed by its participant": (
        submission(
            "Failed",
            "AgentCrashed",
            condition("Finished", "True", "AgentCrashed"),
            condition("Succeeded", "False", "AgentCrashed"),
        ),
        "Healthy",
        "Current",
    ),
    "Cancelled": (
        submission("Cancelled", "Cancelled", condition("Finished", "True", "Cancelled")),
        "Healthy",
        "Current",
    ),
    "an ended one whose next attempt is asked for": (
        submission("Failed", "AgentCrashed", ENDED, observed=1),
        "Progressing",
        "InProgress",
    ),
    "a new Leaderboard": (unread(leaderboard()), "Progressing", "InProgress"),
    "Ready": (leaderboard(READY), "Healthy", "Current"),
    "Ready and paused": (leaderboard(READY, paused=True), "Suspended", "Current"),
    "not Ready": (leaderboard(condition("Ready", "False", "NoToken")), "Degraded", "Failed"),
    "Ready of an earlier spec": (leaderboard(READY | {"observedGeneration": 1}), "Progressing", "InProgress"),
    "Ready unknown": (leaderboard(condition("Ready", "Unknown", "Asking")), "Progressing", "InProgress"),
}


class Health(unittest.TestCase):
    maxDiff = None

    def test_argo_cd_shows_each_state(self) -> None:
        self.assertEqual(seen("argo", "argocd-cm.yaml"), {name: argo for name, (_, argo, _) in STATES.items()})

    def test_flux_shows_each_state(self) -> None:
        self.assertEqual(seen("flux", "flux.yaml"), {name: flux for name, (_, _, flux) in STATES.items()})

    def test_argo_cd_shows_the_reason(self) -> None:
        found = submission("Failed", "AgentCrashed", condition("Finished", "True", "AgentCrashed"))
        found["status"]["message"] = "Agent 1 crashed once."
        (health,) = labkit("health", "argo", str(EXAMPLES / "argocd-cm.yaml"), given=[found])
        self.assertEqual(health["message"], "Failed AgentCrashed: Agent 1 crashed once.")


def seen(program: str, file: str) -> dict[str, str]:
    healths = labkit("health", program, str(EXAMPLES / file), given=[found for found, _, _ in STATES.values()])
    return {name: health["status"] for name, health in zip(STATES, healths, strict=True)}


def terraform_values(text: str) -> dict[str, Any]:
    """What a file of Terraform encodes as the values of a chart. Each line has one value, as `terraform fmt` leaves it."""
    lines = re.sub(r"^ *#.*\n", "", text.split("yamlencode({\n")[1].split("})]")[0], flags=re.MULTILINE)
    named = re.sub(r"(\w+) += ", r'"\1": ', re.sub(r"(?<= )var\.\w+", '"a variable"', lines))
    found: dict[str, Any] = json.loads("{" + re.sub(r"(?<=[]}\"])\n(?! *}| *$)", ",\n", named) + "}")
    return found


def paths(values: dict[str, Any], above: str = "") -> Iterator[str]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from paths(value, f"{above}{name}.")
        else:
            yield above + name


class Manifests(unittest.TestCase):
    def test_other_projects_take_their_kinds(self) -> None:
        files = sorted(str(file) for file in EXAMPLES.glob("*.yaml"))
        self.assertEqual(len(files), 6)
        found = labkit("faults", str(SCHEMAS), *files)
        self.assertEqual(set(found), {f"unknown {kind}" for kind in UNCHECKED})

    def test_terraform_gives_the_chart_values_that_it_has(self) -> None:
        known = chartdocs.leaves((REPOSITORY / "charts" / "leaderboard-operator" / "values.yaml").read_text())
        given = set(paths(terraform_values((EXAMPLES / "main.tf").read_text())))
        self.assertEqual(given - set(known), set())
        self.assertLessEqual({"controller.roleARN", "namespaces", "allow.queues"}, given)

    def test_a_misspelling_is_found(self) -> None:
        text = (EXAMPLES / "external-secret.yaml").read_text()
        self.assertIn("property: auth_token", text)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "wrong.yaml"
            file.write_text(text.replace("property: auth_token", "properties: auth_token"))
            (fault,) = labkit("faults", str(SCHEMAS), str(file))
        self.assertIn("'properties' was unexpected", fault)


if __name__ == "__main__":
    unittest.main()
