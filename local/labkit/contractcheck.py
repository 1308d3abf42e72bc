"""What a submitted image gets, as the documents show it, compared with the Job that the operator makes (its golden files).

Pure but for reading files. Called by local/tests.
"""

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .errors import LabError

GOLDEN = "crates/pod-spec/src/job/golden"
NAMES = "crates/results/src/names.rs"
CELL = re.compile(r"`([^`]+)`")
METRIC = re.compile(r"\b(?:metric|same)\(\s*\"([^\"]+)\"")


@dataclass(frozen=True)
class Container:
    """One container of a golden Job. Variables and words are as the container sees them behind Kubernetes' expansion."""

    words: tuple[str, ...]
    env: Mapping[str, str]
    mounts: Mapping[str, bool]

    @property
    def command(self) -> tuple[str, ...]:
        """What the runner starts."""
        return self.words[self.words.index("--") + 1 :] if "--" in self.words else self.words

    @property
    def flags(self) -> tuple[str, ...]:
        """What the runner is started with."""
        return self.words[1 : self.words.index("--")]


def container(repository: Path, version: str, name: str) -> Container:
    """A container of the golden Job of a version (`v1`, `v2`)."""
    job = json.loads((repository / GOLDEN / f"{version}.json").read_text())
    pod = job["spec"]["template"]["spec"]
    found = [one for one in pod["initContainers"] + pod["containers"] if one["name"] == name]
    if not found:
        raise LabError(f"{GOLDEN}/{version}.json has no container {name}")
    return _container(found[0])


def _container(one: dict[str, Any]) -> Container:
    env = {variable["name"]: variable["value"] for variable in one.get("env", [])}
    return Container(
        # Kubernetes makes one `$` of two.
        words=tuple(_expanded(word, env) for word in one["command"]),
        env=env,
        mounts={mount["mountPath"]: mount.get("readOnly", False) for mount in one["volumeMounts"]},
    )


def _expanded(word: str, env: Mapping[str, str]) -> str:
    for name, value in env.items():
        word = re.sub(rf"(?<!\$)\$\({name}\)", lambda _, value=value: value, word)
    return word.replace("$$(", "$(")


def part(text: str, mark: str) -> str:
    """What stands between `<!-- MARK… -->` and `<!-- end -->`."""
    found = re.search(rf"<!-- {re.escape(mark)}[^>]*-->(.*?)<!-- end -->", text, re.DOTALL)
    if found is None:
        raise LabError(f"no part is marked {mark!r}")
    return found.group(1)


def rows(text: str, mark: str) -> list[tuple[str, ...]]:
    """The cells of the table that is marked so, without its heading."""
    lines = [line for line in part(text, mark).splitlines() if line.startswith("|")]
    return [tuple(cell.strip() for cell in line.strip("|").split("|")) for line in lines[2:]]


def named(cell: str) -> str:
    """The one name in a cell."""
    found = CELL.findall(cell)
    if len(found) != 1:
        raise LabError(f"the cell {cell!r} has {len(found)} names")
    return str(found[0])


def difference(what: str, shown: set[str], made: set[str]) -> Iterator[str]:
    """What a page lacks, and what it has in vain."""
    yield from (f"{what} {name} is not on the page" for name in sorted(made - shown))
    yield from (f"{what} {name} is on the page, and the Job has none" for name in sorted(shown - made))


def agent_faults(repository: Path, text: str) -> Iterator[str]:
    """How the tables of docs/participants.md differ from the agents of the Jobs."""
    agents = [container(repository, version, "agent-2") for version in ("v1", "v2")]
    shown = {named(row[0]) for row in rows(text, "variables of the agent")}
    yield from difference("the variable", shown, {name for agent in agents for name in agent.env})
    access = {named(row[0]).replace("<n>", "2"): row[1] for row in rows(text, "mounts of the agent")}
    mounts = {path: read_only for agent in agents for path, read_only in agent.mounts.items()}
    yield from difference("the mount", set(access), set(mounts))
    for path in sorted(set(access) & set(mounts)):
        if access[path].startswith("read-only") != mounts[path]:
            yield f"the mount {path} is {access[path]} on the page"


def contents_faults(repository: Path, text: str) -> Iterator[str]:
    """How docs/contents-image.md differs from the Jobs."""
    shown = part(text, "command of contents").replace("```sh", "").replace("```", "").strip()
    for version in ("v1", "v2"):
        if shown != container(repository, version, "contents").command[-1].strip():
            yield f"the command of contents is another one in {version}"
    for row in rows(text, "flags of the simulator"):
        version, flags = named(row[0]), named(row[1])
        made = container(repository, version.lower(), "simulator-1")
        wanted = flags.replace("$(CARLA_PORT)", made.env["CARLA_PORT"]).split()
        without_adapter = [word for word in made.command if "GraphicsAdapter" not in word]
        if without_adapter != ["/bin/bash", "/home/carla/CarlaUE4.sh", *wanted]:
            yield f"the flags of {version} are {without_adapter}"


def label_faults(repository: Path, text: str) -> Iterator[str]:
    """How the labels of docs/evalai.md differ from the metrics that are published."""
    made = METRIC.findall((repository / NAMES).read_text())
    table = rows(text, "labels")
    common = [named(row[0]) for row in table]
    only = [named(row[1]) for row in table if row[1]]
    if common + only != made:
        yield f"{NAMES} has {made}"
