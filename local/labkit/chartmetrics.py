"""Owns which metrics the operator exports, by its source, and what the chart's queries ask for that does not exist."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from .errors import LabError

# The folder whose files register all metrics.
FOLDER = Path("src/metrics")
# What Prometheus adds to every sample of a target.
TARGET_LABELS = frozenset({"namespace", "job", "pod", "container", "instance", "endpoint"})
SUFFIXES = {
    "counter": ("_total",),
    "histogram": ("_bucket", "_sum", "_count"),
    "gauge": ("",),
    "info": ("_info",),
}
# By the method that registers them.
KINDS = {"counters": "counter", "gauges": "gauge", "timings": "histogram", "hours": "histogram", "days": "histogram"}
IMPLEMENTATION = re.compile(r"^impl (\w+) \{(.*?)^\}", re.DOTALL | re.MULTILINE)
PROGRAM = re.compile(r"(\w+)::new\(&mut (controller|bridge)\)")
REGISTERED = re.compile(r"\br\.(\w+)\(\s*\"(\w+)\",\s*(?:\[([^\]]*)\],\s*)?\"([^\"]*)\"")
OF_LEADER = re.compile(r"= Gauge\(\s*\"(\w+)\",\s*\[([^\]]*)\],\s*\"([^\"]*)\"")
SCRAPED = re.compile(r"\bto\.(counter|gauge)\(\s*\"(\w+)\",\s*\"([^\"]*)\"")
INFO = re.compile(r"Info::new\(\[(.*?)\]\);\s*\w+\.register\(\"(\w+)\", \"([^\"]*)\"", re.DOTALL)
QUOTED = re.compile(r"\"(\w+)\"")
PREFIX = "leaderboard_"
NAME = re.compile(r"\b(?:leaderboard|process)_\w+")
SELECTED = re.compile(r"\b((?:leaderboard|process)_\w+)\{([^}]*)\}")
MATCHER = re.compile(r"(\w+)\s*(?:=~|!~|!=|=)\s*\"([^\"]*)\"")
GROUPED = re.compile(r"\b(?:by|on|without|ignoring)\s*\(([^)]*)\)")
LITERAL = re.compile(r"\"([A-Za-z][A-Za-z_]*)\"")

Exported = Mapping[str, frozenset[str]]


def source_of(repository: Path) -> str:
    """The text of all files that register metrics, without their tests."""
    files = sorted(file for file in (repository / FOLDER).glob("*.rs") if file.name != "tests.rs")
    return "\n".join(file.read_text().partition("\n#[cfg(test)]")[0] for file in files)


@dataclass(frozen=True)
class Family:
    """One metric: its name without the suffix of its kind, its labels, the program that exports it, and its meaning."""

    name: str
    kind: str
    labels: frozenset[str]
    program: str
    text: str


def families(source: str) -> Iterator[Family]:
    """All that are registered."""
    program_of = dict(PROGRAM.findall(source))
    for owner, body in IMPLEMENTATION.findall(source):
        for method, name, labels, text in REGISTERED.findall(body):
            if method not in KINDS:
                raise LabError(f"{name} is registered by {method}: chartmetrics.py knows no such method")
            program = program_of.get(owner, "both")
            yield Family(PREFIX + name, KINDS[method], frozenset(QUOTED.findall(labels)), program, text)
    for name, labels, text in OF_LEADER.findall(source):
        yield Family(PREFIX + name, "gauge", frozenset(QUOTED.findall(labels)), "controller", text)
    for kind, name, text in SCRAPED.findall(source):
        yield Family(name, kind, frozenset(), "both", text)
    for labels, name, text in INFO.findall(source):
        yield Family(PREFIX + name, "info", frozenset(re.findall(r"\(\"(\w+)\",", labels)), "both", text)


def exported(source: str) -> Exported:
    """The names that /metrics shows, with the labels of each."""
    return {
        family.name + suffix: family.labels | ({"le"} if suffix == "_bucket" else set())
        for family in families(source)
        for suffix in SUFFIXES[family.kind]
    }


def faults(query: str, metrics: Exported, literals: frozenset[str]) -> Iterator[str]:
    """What a query asks for that nobody exports."""
    names = set(NAME.findall(query))
    for name in sorted(names - metrics.keys()):
        yield f"there is no metric {name}"
    for name, matchers in SELECTED.findall(query):
        for label, value in MATCHER.findall(matchers):
            if label not in metrics.get(name, frozenset()) | TARGET_LABELS:
                yield f"{name} has no label {label}"
            elif label not in TARGET_LABELS:
                yield from (f"no {label} is called {one}" for one in value.split("|") if one not in literals)
    known = TARGET_LABELS.union(*(metrics.get(name, frozenset()) for name in names))
    for listed in GROUPED.findall(query):
        yield from (f"no metric here has the label {one}" for one in re.findall(r"\w+", listed) if one not in known)


def of_repository(repository: Path) -> tuple[Exported, frozenset[str]]:
    """The metrics of the operator, and every string that may be the value of a label."""
    sources = [*(repository / "src").rglob("*.rs"), *(repository / "crates").glob("*/src/**/*.rs")]
    texts = "\n".join(file.read_text() for file in sources)
    metrics = exported(source_of(repository))
    if not metrics:
        raise LabError("the source of the metrics registers none that chartmetrics.py could read")
    return metrics, frozenset(LITERAL.findall(texts))
