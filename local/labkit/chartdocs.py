"""Owns the way from values.yaml to the table of values in the chart's README, and to the list of all values. Pure but for two files.

values.yaml is read line by line, as the standard library knows no YAML: a comment above a key explains it, two blanks are one level.
"""

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .errors import LabError
from .marks import between

BEGIN = "<!-- made from values.yaml by `make chart-docs`: edit that file -->"
END = "<!-- end of the values -->"
KEY = re.compile(r"^(?P<indent> *)(?P<name>[A-Za-z][A-Za-z0-9]*):(?: (?P<default>.+))?$")
# A value without a comment is explained where it stands first.
EXPLAINED_BY = {"bridge": "controller", "serviceMonitor": "podMonitor"}
EXPLAINED_BY_BOTH = ("controller", "bridge")
# Names that explain themselves, and groups that Kubernetes explains.
PLAIN = {"enabled": "Whether it is made.", "labels": "Its labels.", "annotations": "Its annotations."}
AS_IN = {
    "podSecurityContext": "a Pod",
    "securityContext": "a container",
    "resources": "a container",
    "livenessProbe": "a container",
    "readinessProbe": "a container",
}


@dataclass(frozen=True)
class Value:
    """One key of values.yaml. `default` is None where further keys are below it."""

    path: str
    default: str | None
    text: str


def values(text: str) -> list[Value]:
    """Every key in the order of the file."""
    found: list[Value] = []
    parents: list[str] = []
    comment: list[str] = []
    for number, line in enumerate(text.splitlines(), start=1):
        stripped = line.strip()
        if stripped.startswith("#"):
            comment.append(stripped.removeprefix("#"))
            continue
        if stripped:
            key = KEY.match(line)
            if key is None or len(key["indent"]) % 2:
                raise LabError(
                    f"values.yaml:{number}: write a key and its value on one line, two blanks a level: {line}"
                )
            parents = [*parents[: len(key["indent"]) // 2], key["name"]]
            found.append(Value(".".join(parents), key["default"], explanation(comment)))
        comment = []
    return found


def explanation(comment: list[str]) -> str:
    """The sentences of a comment. Lines that are indented are an example, for those who read the file."""
    return " ".join(line.strip() for line in comment if not line.startswith("   "))


def leaves(text: str) -> list[str]:
    """The paths of all values that can be set."""
    return [value.path for value in values(text) if value.default is not None]


def table(text: str) -> str:
    """Markdown: one row for each value, and one for each group that has an explanation."""
    every = values(text)
    explained = {value.path: value.text for value in every}
    rows = ["| value | default | |", "|---|---|---|"]
    for value in every:
        words = value.text or reference(value.path, explained)
        if value.default is not None and not words:
            raise LabError(f"values.yaml: {value.path} has no comment: say above it what it is for")
        if words:
            default = "" if value.default is None else f"`{value.default}`"
            rows.append(f"| `{value.path}` | {cell(default)} | {cell(words)} |")
    return "\n".join(rows)


def reference(path: str, explained: dict[str, str]) -> str:
    """Where the same value of another group is explained."""
    group, _, rest = path.partition(".")
    other = f"{EXPLAINED_BY.get(group, '')}.{rest}"
    if explained.get(other):
        return f"As `{other}`."
    *groups, name = path.split(".")
    known = next((AS_IN[one] for one in groups if one in AS_IN), None)
    return f"As in {known}." if known else PLAIN.get(name, "") if groups else ""


def cell(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;")


def with_table(readme: str, text: str) -> str:
    """The README with the table of now between its two marks."""
    return between(readme, BEGIN, END, f"\n{table(text)}\n", "the chart's README")


def update(chart: Path) -> None:
    readme = chart / "README.md"
    readme.write_text(with_table(readme.read_text(), (chart / "values.yaml").read_text()))


def same_table(chart: Path) -> str:
    readme, text = (chart / "README.md").read_text(), (chart / "values.yaml").read_text()
    if with_table(readme, text) != readme:
        raise LabError("the table of values in the chart's README differs from values.yaml: run `make chart-docs`")
    return f"{len(leaves(text))} values"


def same_schema(chart: Path) -> str:
    """Neither values.yaml nor the schema may know a value that the other does not."""
    schema = json.loads((chart / "values.schema.json").read_text())
    documented = {value.path for value in values((chart / "values.yaml").read_text())}
    known = set(properties(schema, schema))
    # `controller` and `bridge` may have what both have.
    shared = {f"{program}.{path}" for program in EXPLAINED_BY_BOTH for path in documented}
    unexplained = sorted(path for path in known - documented - shared if ".resources." not in path)
    refused = sorted(path for path in documented - known if not below_open(path, known))
    if unexplained or refused:
        raise LabError(
            f"values.schema.json alone has {unexplained}, values.yaml alone has {refused}: add or remove them"
        )
    return f"{len(known)} keys"


def properties(schema: dict[str, Any], part: dict[str, Any], path: str = "") -> Iterator[str]:
    """The paths of all keys that a schema names, but those in lists."""
    if "$ref" in part:
        part = schema["definitions"][part["$ref"].rpartition("/")[2]]
    for name, below in part.get("properties", {}).items():
        # What is refused.
        if below is False:
            continue
        yield path + name
        yield from properties(schema, below, f"{path}{name}.")


def below_open(path: str, known: set[str]) -> bool:
    """True for a part of an object of Kubernetes, which the schema leaves to the server."""
    parent = path.rpartition(".")[0]
    siblings = [one for one in known if one.startswith(f"{parent}.")]
    return bool(parent) and not siblings and (parent in known or below_open(parent, known))
