"""Owns what a run of the demo must have left behind, in all four places: the cluster, S3, DynamoDB and EvalAI. Pure.

`differences` compares; the other functions make of the same findings what a person reads.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

CONDITIONS = ("Finished", "Archived", "Recorded", "Published")


@dataclass(frozen=True)
class Findings:
    """What the four places show of one run."""

    # The Submission, as the API server has it.
    submission: dict[str, Any]
    # Keys below the run's prefix with their sizes, and the texts of some.
    objects: dict[str, int]
    texts: dict[str, str]
    # The row of the table, columns as text; None: there is none.
    row: dict[str, str] | None
    # EvalAI's submission, and the leaderboard rows it has for that submission (there must be one).
    evalai: dict[str, Any]
    entries: list[dict[str, Any]]


def differences(expected: dict[str, Any], found: Findings) -> list[str]:
    """Every difference between `expected.json` and what was found, each with its place; none: all is as it must be."""
    return [
        *in_cluster(expected, found),
        *in_s3(expected, found),
        *in_table(expected, found),
        *in_evalai(expected, found),
    ]


def unlike(place: str, what: str, found: Any, wanted: Any) -> Iterator[str]:
    """One line if the two differ. Numbers are compared to the last digit: they are copied, never computed again."""
    if found != wanted:
        yield f"{place}: {what} is {shown(found)}, and {shown(wanted)} is expected"


def shown(value: Any) -> str:
    return "missing" if value is None else json.dumps(value, ensure_ascii=False)


def progress_text(expected: dict[str, Any]) -> str:
    done, total = expected["progress"]
    return f"{done}/{total}"


def in_cluster(expected: dict[str, Any], found: Findings) -> Iterator[str]:
    status = found.submission.get("status", {})
    yield from unlike("Kubernetes", "state", status.get("state"), "Finished")
    yield from unlike("Kubernetes", "progress", status.get("progress", {}).get("text"), progress_text(expected))
    score = f"{expected['metrics']['Driving score']:.2f}"
    yield from unlike("Kubernetes", "score", status.get("score", {}).get("text"), score)
    truth = {condition["type"]: condition["status"] for condition in status.get("conditions", [])}
    for name in CONDITIONS:
        yield from unlike("Kubernetes", f"condition {name}", truth.get(name), "True")


def in_s3(expected: dict[str, Any], found: Findings) -> Iterator[str]:
    merged = parsed(found.texts.get("agent/agent_results.json"))
    yield from unlike("S3", "entry_status of the merged results", merged.get("entry_status"), expected["entry_status"])
    yield from unlike("S3", "eligible of the merged results", merged.get("eligible"), expected["eligible"])
    yield from unlike("S3", "values of the merged results", merged.get("values"), expected["values"])
    checkpoint = merged.get("_checkpoint", {})
    yield from unlike("S3", "progress of the merged results", checkpoint.get("progress"), expected["progress"])
    splits = parsed(found.texts.get("evalai/results.json"), [{}])
    yield from metrics_unlike("S3", "evalai/results.json", expected, splits[0].get("accuracies", {}))


def in_table(expected: dict[str, Any], found: Findings) -> Iterator[str]:
    row = found.row or {}
    yield from unlike("DynamoDB", "submission_status", row.get("submission_status"), "FINISHED")
    yield from unlike("DynamoDB", "progress", row.get("progress"), progress_text(expected))
    for (name, _), text in zip(expected["metrics"].items(), expected["values"], strict=True):
        yield from unlike("DynamoDB", column(name), row.get(column(name)), text)


def in_evalai(expected: dict[str, Any], found: Findings) -> Iterator[str]:
    yield from unlike("EvalAI", "status", found.evalai.get("status"), "finished")
    yield from unlike("EvalAI", "number of leaderboard rows", len(found.entries), 1)
    if found.entries:
        yield from metrics_unlike("EvalAI", "the leaderboard row", expected, found.entries[0].get("result", {}))


def metrics_unlike(place: str, where: str, expected: dict[str, Any], metrics: dict[str, Any]) -> Iterator[str]:
    for name, wanted in expected["metrics"].items():
        yield from unlike(place, f"“{name}” in {where}", metrics.get(name), wanted)
    for name in metrics.keys() - expected["metrics"].keys():
        yield f"{place}: “{name}” in {where} is not expected"


def column(metric: str) -> str:
    """The column of the table that holds a metric."""
    return metric.lower().replace(" ", "_").replace("-", "_")


def parsed(text: str | None, default: Any = None) -> Any:
    """A JSON text; what is missing or broken shows up as missing values."""
    try:
        return json.loads(text or "")
    except ValueError:
        return {} if default is None else default


def timeline(submission: dict[str, Any]) -> list[str]:
    """When what happened, each line with the seconds since the one before."""
    # Most times are whole seconds: within one second the order is that of cause and effect, in which they come.
    moments = sorted(moments_of(submission), key=lambda moment: int(moment[0].timestamp()))
    lines, latest = [], None
    for at, what in moments:
        took = "" if latest is None else f"+{max(0.0, (at - latest).total_seconds()):.1f} s"
        lines.append(f"{at:%H:%M:%S}  {took:>8}  {what}")
        latest = at if latest is None else max(at, latest)
    if latest is not None:
        lines.append(f"{'':8}  {(latest - moments[0][0]).total_seconds():.1f} s in all")
    return lines


TIMES = {
    "accepted": "accepted: EvalAI still wants it, its plan is pinned",
    "scheduled": "its Pod has a node",
    "started": "the first agent runs",
    "finished": "results final and in S3",
    "published": "score in EvalAI",
}


def moments_of(submission: dict[str, Any]) -> Iterator[tuple[datetime, str]]:
    """Every moment that the object itself records, causes before effects."""
    meta, status = submission.get("metadata", {}), submission.get("status", {})
    times = status.get("times", {})
    if "submitted" in times:
        yield moment(times["submitted"]), "submitted to EvalAI"
    ingested = parsed(meta.get("annotations", {}).get("leaderboard.carla.org/ingested"))
    if isinstance(ingested.get("sent"), int):
        yield datetime.fromtimestamp(ingested["sent"] / 1000, UTC), "EvalAI's message in SQS"
    if "creationTimestamp" in meta:
        yield moment(meta["creationTimestamp"]), "Submission created by the bridge"
    for name, what in TIMES.items():
        if name in times:
            yield moment(times[name]), what
    for condition in status.get("conditions", []):
        if condition.get("type") == "Recorded" and condition.get("status") == "True":
            yield moment(condition["lastTransitionTime"]), "row in DynamoDB"


def moment(text: str) -> datetime:
    return datetime.fromisoformat(text.replace("Z", "+00:00"))
