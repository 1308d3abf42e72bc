"""Owns the comparison of the rights that the chart grants with those that the operator's programs used, by the API server's audit log.

Called by `lab test` after the cluster's tests, whose programs name themselves in their requests. The chart is rendered as if each test's
namespace were its release's and its leaderboards': names of namespaces are not compared. Pure but for reading the log.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from . import chartrender
from .errors import LabError
from .kube import Kube

PROGRAMS = ("controller", "bridge")
AGENT = "leaderboard-operator-"
# The name of each test's Lease, in tests/support/operator.rs.
LEASE = "operator"
VALUES: Mapping[str, Any] = {
    "fullnameOverride": LEASE,
    "namespaces": ["tests"],
    "allow": {"secrets": ["evalai"]},
}
GROUP = "leaderboard.carla.org"
DECISION = "authorization.k8s.io/decision"


@dataclass(frozen=True, order=True)
class Right:
    program: str
    verb: str
    # With the subresource behind a slash.
    resource: str
    group: str

    def text(self) -> str:
        return f"{self.program}: {self.verb} {self.resource}{' of ' + self.group if self.group else ''}"


# What is granted and may be unused in a run of the tests, and why it is granted all the same.
RARE: Mapping[Right, str] = {
    Right("controller", "update", "leaderboards/finalizers", GROUP): "asked for by an admission plugin, in no request",
    Right("controller", "update", "submissions/finalizers", GROUP): "asked for by an admission plugin, in no request",
    Right("controller", "create", "networkpolicies", "networking.k8s.io"): "part of an apply, which is a patch",
    Right("controller", "delete", "pods", ""): "only for a Pod whose kubelet hangs",
    Right("controller", "patch", "events", "events.k8s.io"): "only for an event that is repeated within minutes",
    Right("bridge", "patch", "events", "events.k8s.io"): "only for an event that is repeated within minutes",
    Right(
        "controller", "delete", "submissions", GROUP
    ): "only with retention.finishedSeconds, as tests/api/retention.rs has it",
    **{
        Right(
            "controller", verb, "resourceclaimtemplates", "resource.k8s.io"
        ): "only with gpu.mode Claim, as tests/api/claims.rs has it"
        for verb in ("get", "list", "create", "patch", "delete")
    },
    Right(
        "controller", "get", "priorityclasses", "scheduling.k8s.io"
    ): "only for a track with priorityClassName, as tests/api/boards.rs has it",
    Right(
        "controller", "get", "persistentvolumeclaims", ""
    ): "only for a claim with the data of a challenge, as src/leaderboards/data_claims.rs has it",
    Right("controller", "create", "submissions", GROUP): "only for a submission whose message was lost",
    Right("controller", "get", "submissions", GROUP): "only for a submission whose message was lost",
}


@dataclass(frozen=True)
class Request:
    """A request of one of the programs, as the audit log has it."""

    right: Right
    namespace: str
    name: str
    is_refused: bool


def now() -> str:
    """The time as the audit log writes it."""
    return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")


def check(kube: Kube, repository: Path, log: Path, since: str) -> str:
    """Compares both, the log from a time on; raises with what differs."""
    manifests = chartrender.template(kube, chartrender.folder(repository), VALUES)
    granted = rights_of(chartrender.objects(kube, manifests).values())
    requests = list(read(log, since))
    faults = differences(granted, requests)
    if faults:
        raise LabError(f"rights: {'; '.join(faults)}")
    used = {request.right for request in requests}
    return f"rights: {len(used)} verbs used, {len(granted)} granted, {len(granted.keys() - used)} of these rarely used, none missing"


def rights_of(objects: Iterable[Mapping[str, Any]]) -> dict[Right, set[str] | None]:
    """What the roles grant each program, with the names that a right is limited to; None is any name."""
    granted: dict[Right, set[str] | None] = {}
    listed = list(objects)
    roles = {key_of(one): one for one in listed if one["kind"] in ("Role", "ClusterRole")}
    for binding in listed:
        if binding["kind"] not in ("RoleBinding", "ClusterRoleBinding"):
            continue
        namespace = binding["metadata"].get("namespace") if binding["roleRef"]["kind"] == "Role" else None
        role = roles[(binding["roleRef"]["kind"], namespace, binding["roleRef"]["name"])]
        for subject in binding["subjects"]:
            program = subject["name"].rpartition("-")[2]
            for rule in role["rules"]:
                add(granted, program, rule)
    return granted


def key_of(role: Mapping[str, Any]) -> tuple[str, str | None, str]:
    return role["kind"], role["metadata"].get("namespace"), role["metadata"]["name"]


def add(granted: dict[Right, set[str] | None], program: str, rule: Mapping[str, Any]) -> None:
    names = set(rule.get("resourceNames") or ()) or None
    for group in rule["apiGroups"]:
        for resource in rule["resources"]:
            for verb in rule["verbs"]:
                right = Right(program, verb, resource, group)
                known = granted.get(right, set())
                granted[right] = None if known is None or names is None else known | names


def read(log: Path, since: str) -> Iterator[Request]:
    """The programs' requests from a time on: of the log, and of those that the API server has put aside, with a time in their names."""
    for file in sorted(log.parent.glob(f"{log.stem}*{log.suffix}")):
        with file.open(encoding="utf-8", errors="replace") as lines:
            for line in lines:
                if AGENT in line and (request := request_of(line, since)):
                    yield request


def request_of(line: str, since: str) -> Request | None:
    """A line of the log; None: another client's, an older one, a request for no object, or a line that is half written."""
    try:
        entry = json.loads(line)
    except ValueError:
        return None
    program = entry.get("userAgent", "").removeprefix(AGENT).partition("/")[0]
    about = entry.get("objectRef")
    if entry.get("requestReceivedTimestamp", "") < since:
        return None
    if program not in PROGRAMS or not entry.get("userAgent", "").startswith(AGENT) or not about:
        return None
    part = f"/{about['subresource']}" if about.get("subresource") else ""
    right = Right(program, entry["verb"], about.get("resource", "") + part, about.get("apiGroup", ""))
    is_refused = (entry.get("annotations") or {}).get(DECISION) == "forbid"
    return Request(right, about.get("namespace", ""), about.get("name", ""), is_refused)


def differences(granted: Mapping[Right, set[str] | None], requests: Sequence[Request]) -> list[str]:
    """A sentence for each right that is used and not granted, granted and not used, or refused."""
    used = {request.right for request in requests}
    if {right.program for right in used} != set(PROGRAMS):
        return [f"the audit log has no request of {' and '.join(sorted(set(PROGRAMS) - {r.program for r in used}))}"]
    lines = [f"used and not granted: {one}" for one in sorted({text_of(r) for r in requests if not covers(granted, r)})]
    idle = sorted(granted.keys() - used - RARE.keys())
    lines += [f"granted and not used (take it out of the chart, or say why in rights.py): {one.text()}" for one in idle]
    stale = sorted(RARE.keys() - granted.keys())
    lines += [f"an exception of rights.py that the chart does not grant: {one.text()}" for one in stale]
    return lines + [f"refused and never allowed: {one}" for one in refused(requests)]


def covers(granted: Mapping[Right, set[str] | None], request: Request) -> bool:
    if request.right not in granted:
        return False
    names = granted[request.right]
    # The hosts choose what their Secrets are called, and so do the tests.
    return names is None or request.name in names or request.right.resource == "secrets"


def refused(requests: Sequence[Request]) -> list[str]:
    """Rights that a namespace never had. One that just lost its API server may be refused for a moment, before that knows its roles."""
    allowed = {(one.right, one.namespace) for one in requests if not one.is_refused}
    missing = {(one.right, one.namespace) for one in requests if one.is_refused} - allowed
    return [f"{right.text()} in {namespace or 'the cluster'}" for right, namespace in sorted(missing)]


def text_of(request: Request) -> str:
    return f"{request.right.text()}{' ' + request.name if request.right.verb == 'update' else ''}"
