"""Owns the check of what Artifact Hub reads of the chart: annotations of Chart.yaml, and artifacthub-repo.yml. Pure but for two files.

Artifact Hub takes the chart and leaves out what it can't read, so that a mistake would be seen by nobody. The annotations are YAML inside
of YAML; the standard library knows none, so that they are lists of flat maps, one key a line.
"""

import re
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path

from . import release
from .errors import LabError

CHART = "charts/leaderboard-operator/Chart.yaml"
REPOSITORY_FILE = "charts/artifacthub-repo.yml"
# As its documentation lists them.
CHANGES = {"added", "changed", "deprecated", "removed", "fixed", "security"}
CAPABILITIES = {"Basic Install", "Seamless Upgrades", "Full Lifecycle", "Deep Insights", "Auto Pilot"}
KNOWN = {
    "category", "changes", "containsSecurityUpdates", "crds", "crdsExamples", "images", "license", "links", "operator",
    "operatorCapabilities", "prerelease",
}  # fmt: skip
IMAGE = re.compile(r"ghcr\.io/[\w.-]+/leaderboard-operator:(\S+)")
ICON = re.compile(r"^icon: https://github\.com/[\w.-]+/leaderboard-operator/raw/v([^/]+)/(\S+)$", re.MULTILINE)
LINE = re.compile(r"^  artifacthub\.io/(\w+): ?(.*)$", re.MULTILINE)


def block(text: str, name: str) -> str:
    """The lines of an annotation, which is itself YAML."""
    found = re.search(rf"^  artifacthub\.io/{name}: \|\n((?:    .*\n)+)", text, re.MULTILINE)
    if found is None:
        raise LabError(f"Chart.yaml has no annotation artifacthub.io/{name}")
    return textwrap.dedent(found[1])


def items(text: str) -> list[dict[str, str]]:
    """A list of flat maps, `- key: value` and then `  key: value`."""
    found: list[dict[str, str]] = []
    for line in text.splitlines():
        mark, _, rest = line.partition(" ") if line.startswith("- ") else ("", "", line.removeprefix("  "))
        key, colon, value = rest.partition(": ")
        if not colon or line[:1] not in ("-", " ") or key != key.strip():
            raise LabError(f"Chart.yaml: {line!r} is no line of a list of flat maps, which is all that is read here")
        if mark:
            found.append({})
        found[-1][key] = value.strip('"')
    return found


def faults(chart: str, repository: str, version: str) -> Iterator[str]:
    """What is wrong with the two files, a sentence each."""
    scalars = {name: value.strip('"') for name, value in LINE.findall(chart)}
    yield from (f"artifacthub.io/{name} is missing" for name in sorted(KNOWN - scalars.keys()))
    yield from (f"artifacthub.io/{name} is none that Artifact Hub reads" for name in sorted(scalars.keys() - KNOWN))
    for name in ("operator", "prerelease", "containsSecurityUpdates"):
        if scalars.get(name) not in ("true", "false"):
            yield f"artifacthub.io/{name} is neither true nor false"
    if scalars.get("operatorCapabilities") not in CAPABILITIES:
        yield f"artifacthub.io/operatorCapabilities is none of {', '.join(sorted(CAPABILITIES))}"
    yield from of_lists({name: items(block(chart, name)) for name in ("changes", "images", "links")}, version)
    if not re.search(r"^owners:\n  - name: \S.*\n    email: \S+@\S+$", repository, re.MULTILINE):
        yield f"{REPOSITORY_FILE} names no owner with an email"


def of_lists(lists: Mapping[str, list[dict[str, str]]], version: str) -> Iterator[str]:
    for change in lists["changes"]:
        if change.keys() != {"kind", "description"} or change["kind"] not in CHANGES:
            yield f"a change has a description and a kind of {', '.join(sorted(CHANGES))}, not {change}"
    for link in lists["links"]:
        if link.keys() != {"name", "url"} or not link["url"].startswith("https://"):
            yield f"a link has a name and an https address, not {link}"
        elif "/blob/" in link["url"] and f"/blob/v{version}/" not in link["url"]:
            yield f"a link leads to another version than {version}: {link}"
    for image in lists["images"]:
        found = IMAGE.fullmatch(image.get("image", ""))
        if image.keys() != {"name", "image"} or found is None or found[1] != version:
            yield f"an image has a name and a reference of version {version}, not {image}"


def icon_faults(chart: str, version: str, repository: Path) -> Iterator[str]:
    """The icon is a file of this repository, as it is in this version."""
    icon = ICON.search(chart)
    if icon is None:
        yield "Chart.yaml has no icon of this repository"
    elif icon[1] != version:
        yield f"the icon is of another version than {version}: {icon[0]}"
    elif not (repository / icon[2]).is_file():
        yield f"the icon {icon[2]} does not exist"


def check(repository: Path) -> str:
    """For the chart's test: raises with what is wrong."""
    chart, own = ((repository / path).read_text() for path in (CHART, REPOSITORY_FILE))
    version = release.version(repository)
    found = [*faults(chart, own, version), *icon_faults(chart, version, repository)]
    if found:
        raise LabError("; ".join(found))
    return f"{len(KNOWN)} annotations"
