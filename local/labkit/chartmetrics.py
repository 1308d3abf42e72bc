"""Owns which metrics the operator exports, by its source, and what the chart's queries ask for that does not exist."""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

from .errors import LabError

# The folder whose files register all metrics.
FOLDER = Path("src/observability/metrics")
# What Prometheus adds to every sample of a target.
TARGET_LABELS = frozenset({"namespace", "job", "pod", "container", "instance", "endpoint"})
SUFFIXES = {
    "Counter": ("_total",),
    "Histogram": ("_bucket", "_sum", "_count"),
    "Gauge": ("",),
    "LeaderGauge": ("",),
    "FloatCounter": ("_total",),
    "FloatGauge": ("",),
    "Info": ("_info",),
}
STRUCT = re.compile(r"struct (\w+) \{(.*?)\n\}", re.DOTALL)
FIELD = re.compile(r"^\s+(?:pub )?(\w+): (.+),$", re.MULTILINE)
IMPLEMENTATION = re.compile(r"^impl (\w+) \{(.*?)^\}", re.DOTALL | re.MULTILINE)
REGISTRATION = re.compile(r"(\w+): (?:zero|add)\(\s*r,\s*\"(\w+)\"")
INFO = re.compile(r"\.register\(\s*\"(\w+)\",\s*\"[^\"]*\",\s*Info::new\((\w+)\)")
PREFIX = re.compile(r"= [\w.:]*with_prefix\(\"(\w+)\"\)")
OTHER_PREFIX = re.compile(r"(\w+)::new\(\w+\.sub_registry_with_prefix\(\"(\w+)\"\)\)")
PROGRAM = re.compile(r"(\w+)::new\((controller|bridge)\)")
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


def exported(source: str) -> Exported:
    """The names that /metrics shows, with the labels of each."""
    structs = {name: dict(FIELD.findall(body)) for name, body in STRUCT.findall(source)}
    prefix, others = PREFIX.search(source), dict(OTHER_PREFIX.findall(source))
    if prefix is None:
        raise LabError("the source of the metrics names no prefix: chartmetrics.py must follow it")
    found: dict[str, frozenset[str]] = {}
    for owner, body in IMPLEMENTATION.findall(source):
        for field, name in REGISTRATION.findall(body):
            kind, labels = shape(structs[owner][field], structs)
            for suffix in SUFFIXES[kind]:
                more = {"le"} if suffix == "_bucket" else set()
                found[f"{others.get(owner, prefix[1])}_{name}{suffix}"] = frozenset(labels | more)
    for name, variable in INFO.findall(source):
        labels = structs[variable.capitalize()]
        found[f"{prefix[1]}_{name}_info"] = frozenset(labels)
    return found


def programs(source: str) -> dict[str, str]:
    """The one program that exports a family, by the family's name; those of both are left out."""
    of_owner = dict(PROGRAM.findall(source))
    return {
        name: of_owner[owner]
        for owner, body in IMPLEMENTATION.findall(source)
        if owner in of_owner
        for _, name in REGISTRATION.findall(body)
    }


def shape(written: str, structs: Mapping[str, Mapping[str, str]]) -> tuple[str, set[str]]:
    """The kind of a metric and its labels, from the type of its field."""
    family = re.fullmatch(r"(?:Family<(\w+), (\w+)>|(Timings)<(\w+)>|(\w+))", written)
    if family is None:
        raise LabError(f"{written}: chartmetrics.py knows no such type of a metric")
    labels, kind, timings, timing_labels, plain = family.groups()
    if timings:
        return "Histogram", set(structs[timing_labels])
    return (kind, set(structs[labels])) if kind else (plain, set())


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
    sources = [*(repository / "src").rglob("*.rs"), *(repository / "crates" / "api" / "src").rglob("*.rs")]
    texts = "\n".join(file.read_text() for file in sources)
    metrics = exported(source_of(repository))
    if not metrics:
        raise LabError("the source of the metrics registers none that chartmetrics.py could read")
    return metrics, frozenset(LITERAL.findall(texts))
