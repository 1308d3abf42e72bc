"""Owns the table of metrics in docs/metrics.md, made from the source of the metrics. Pure but for two files."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from . import chartmetrics
from .errors import LabError
from .marks import between

PAGE = Path("docs/metrics.md")
BEGIN = "<!-- made from src/observability/metrics by `make chart-docs`: edit those files -->"
END = "<!-- end of the metrics -->"
HELP = re.compile(
    r"(?:zero|add)\(\s*r,\s*\"(\w+)\",\s*\"([^\"]+)\"|\.register\(\s*\"(\w+)\",\s*\"([^\"]+)\",\s*Info::new"
)
TYPES = {"_total": "counter", "_bucket": "histogram", "_info": "info"}


@dataclass(frozen=True)
class Row:
    """One family: its name as queries write it, type, labels and meaning."""

    name: str
    kind: str
    labels: tuple[str, ...]
    program: str
    text: str


def rows(source: str) -> list[Row]:
    """Each family once, in the order of their names."""
    exported = chartmetrics.exported(source)
    texts = {first or second: text or other for first, text, second, other in HELP.findall(source)}
    found = families(exported, texts, chartmetrics.programs(source))
    return sorted(found, key=lambda row: row.name)


def families(exported: chartmetrics.Exported, texts: dict[str, str], programs: dict[str, str]) -> Iterator[Row]:
    for name, labels in exported.items():
        if name.endswith(("_sum", "_count")) and name.rpartition("_")[0] + "_bucket" in exported:
            continue
        suffix = next((end for end in TYPES if name.endswith(end)), "")
        family = name.removesuffix(suffix)
        short = family.partition("_")[2]
        text = texts.get(short)
        if text is None:
            raise LabError(f"{chartmetrics.FOLDER} registers {family} in a way that metricdocs.py cannot read")
        shown = family if suffix == "_bucket" else name
        yield Row(shown, TYPES.get(suffix, "gauge"), tuple(sorted(labels - {"le"})), programs.get(short, "both"), text)


def table(source: str) -> str:
    lines = ["| metric | type | labels | program | meaning |", "|---|---|---|---|---|"]
    for row in rows(source):
        labels = ", ".join(f"`{label}`" for label in row.labels)
        lines.append(f"| `{row.name}` | {row.kind} | {labels} | {row.program} | {row.text} |")
    return "\n".join(lines)


def page(text: str, source: str) -> str:
    """The page with the table of this source."""
    return between(text, BEGIN, END, table(source), str(PAGE))


def update(repository: Path) -> None:
    file = repository / PAGE
    file.write_text(page(file.read_text(), chartmetrics.source_of(repository)))


def same(repository: Path) -> str:
    """For the chart's test: raises unless the page is that of the source."""
    source, text = chartmetrics.source_of(repository), (repository / PAGE).read_text()
    if page(text, source) != text:
        raise LabError(f"{PAGE} differs from {chartmetrics.FOLDER}: run `make chart-docs`")
    return f"{len(rows(source))} metrics"
