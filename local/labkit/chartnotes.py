"""Owns the check of the text after an installation: what it says, and that its manifests can be pasted.

Called by `charttest`. The manifests are taken out of the shell lines that the text has, and a server with the definitions judges them.
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from . import chartrender
from .chartcases import IMAGE, NOTES, RELEASE, SYSTEM
from .chartshown import CONTROLLER
from .errors import LabError
from .kube import Kube

# A manifest on a shell's standard input, with its namespace.
PASTED = re.compile(r"^kubectl -n (\S+) apply --filename=- <<'EOF'\n(.*?)\nEOF$", re.DOTALL | re.MULTILINE)


def text_of(kube: Kube, chart: Path, values: Mapping[str, Any]) -> str:
    """What people read after an installation with these values."""
    argv = ["install", RELEASE, str(chart), f"--namespace={SYSTEM}", "--dry-run=client", "--values=-"]
    given = json.dumps(chartrender.nested({**IMAGE, **chartrender.LEAN, **values}))
    return kube.run("helm", *argv, given=given).partition("\nNOTES:\n")[2]


def texts(kube: Kube, chart: Path) -> list[str]:
    """For each case what people read."""
    return [text_of(kube, chart, values) for values, _, _ in NOTES]


def notes(shown: Sequence[str]) -> str:
    for (values, present, missing), text in zip(NOTES, shown, strict=True):
        wrong = [f"lacks {one!r}" for one in present if one not in text]
        wrong += [f"has {one!r}" for one in missing if one in text]
        if wrong:
            raise LabError(f"with {json.dumps(values)} NOTES.txt {', '.join(wrong)}: {text}")
    return f"{len(NOTES)} cases"


def manifests(kube: Kube, chart: Path, shown: Sequence[str]) -> str:
    """The server takes each manifest as it stands, and each Leaderboard names what the same values allow."""
    count = 0
    for (values, _, _), text in zip(NOTES, shown, strict=True):
        pasted = PASTED.findall(text)
        if len(pasted) != 2:
            raise LabError(f"with {json.dumps(values)} NOTES.txt has {len(pasted)} manifests and not 2")
        bounds = allowed(kube, chart, values)
        for namespace, manifest in pasted:
            argv = ["apply", "--server-side", "--dry-run=server", "--validate=strict", f"--namespace={namespace}"]
            done = kube.attempt("kubectl", *argv, "--filename=-", "--output=json", given=manifest)
            if done.returncode != 0 or done.stderr:
                raise LabError(f"with {json.dumps(values)}: {done.stderr.strip()[-400:]}: {manifest}")
            made = json.loads(done.stdout)
            wrong = list(refused(made["spec"], bounds.get(namespace, bounds.get("*", {}))))
            if made["kind"] == "Leaderboard" and wrong:
                raise LabError(
                    f"with {json.dumps(values)} the Leaderboard of NOTES.txt is not allowed {', '.join(wrong)}"
                )
            count += 1
    return f"{count} manifests"


def allowed(kube: Kube, chart: Path, values: Mapping[str, Any]) -> dict[str, dict[str, list[str]]]:
    """What the installed controller would let Leaderboards name, by namespace."""
    container = chartrender.at(
        chartrender.objects(kube, chartrender.template(kube, chart, {**chartrender.LEAN, **values}))[CONTROLLER],
        "spec.template.spec.containers.0",
    )
    bounds: dict[str, dict[str, list[str]]] = json.loads(
        next(one["value"] for one in container["env"] if one["name"] == "LEADERBOARD_ALLOWED")
    )
    return bounds


def refused(spec: Mapping[str, Any], bounds: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """What a Leaderboard names beyond its bounds. Without any bucket NOTES.txt says so itself."""
    s3 = spec.get("storage", {}).get("s3", {})
    named = {
        "secretsManager": chartrender.at(spec, "evalai.token.secretsManager.id"),
        "queues": chartrender.at(spec, "queue.sqs.url"),
        "tables": chartrender.at(spec, "table.dynamoDB.name"),
        "logGroups": chartrender.at(spec, "logs.cloudWatch.name"),
    }
    if "buckets" in bounds:
        named["buckets"] = f"{s3.get('bucket')}/{s3.get('prefix', '')}"
    for kind, name in named.items():
        if name != chartrender.ABSENT and not any(covers(kind, pattern, name) for pattern in bounds.get(kind, [])):
            yield f"{kind} {name}"


def covers(kind: str, pattern: str, name: str) -> bool:
    """True where the pattern is about the name, as crates/policy/src/allowed.rs has it."""
    whole = "/" in pattern or kind not in ("queues", "buckets")
    part = name if whole else name.rsplit("/", 1)[-1] if kind == "queues" else name.split("/")[0]
    return fnmatchcase(part, pattern)
