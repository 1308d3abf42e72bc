"""Owns the table of metrics in docs/metrics.md, made from the source of the metrics. Pure but for two files."""

from pathlib import Path

from . import chartmetrics
from .errors import LabError
from .marks import between

PAGE = Path("docs/metrics.md")
BEGIN = "<!-- made from src/metrics by `make chart-docs`: edit those files -->"
END = "<!-- end of the metrics -->"


def table(source: str) -> str:
    """Each family once, in the order of the names that queries use."""
    lines = ["| metric | type | labels | program | meaning |", "|---|---|---|---|---|"]
    for name, family in sorted((shown(family), family) for family in chartmetrics.families(source)):
        labels = ", ".join(f"`{label}`" for label in sorted(family.labels))
        lines.append(f"| `{name}` | {family.kind} | {labels} | {family.program} | {family.text} |")
    return "\n".join(lines)


def shown(family: chartmetrics.Family) -> str:
    """The name that queries use; that of a histogram has no ending here."""
    return family.name if family.kind == "histogram" else family.name + chartmetrics.SUFFIXES[family.kind][0]


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
    return f"{len(list(chartmetrics.families(source)))} metrics"
