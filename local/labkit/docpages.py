"""Owns what the documents show people to type and to apply: the blocks and lines of README.md, docs/ and the chart's README.

Pure but for reading files. Called by `docruns`, which runs and applies them, and by local/tests.
"""

import re
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

# The blocks of YAML on this page are values.
CHART = "charts/leaderboard-operator/README.md"
BLOCK = re.compile(r"^( *)```(\w*)[^\n]*\n(.*?)^ *```$", re.MULTILINE | re.DOTALL)
SPAN = re.compile(r"`([^`\n]+(?:\n[^`\n]+)?)`")
# A line of prose that starts with one of these and goes on is a command, not the name of one.
COMMAND = re.compile(r"(?:kubectl|helm|aws|cargo|leaderboard-operator) \S+ .*\S|(?:make|local/lab) \S.*")
# Behind the place of such a command.
PROSE = " (prose)"
# Words that start like a command: settings, and what is left for the reader to complete.
NO_COMMAND = re.compile(r"…|\.\.\.")


@dataclass(frozen=True)
class Block:
    """A block between fences, or a command within a line of prose, whose language is `span`."""

    page: str
    line: int
    language: str
    text: str

    @property
    def place(self) -> str:
        return f"{self.page}:{self.line}{PROSE if self.language == 'span' else ''}"


def pages(repository: Path) -> list[Path]:
    """The chart's own page is the last one: it ends with an uninstall."""
    return [repository / "README.md", *sorted((repository / "docs").rglob("*.md")), repository / CHART]


def blocks(page: str, text: str) -> Iterator[Block]:
    """The blocks of a page, without their indentation."""
    for found in BLOCK.finditer(text):
        yield Block(page, line_of(text, found.start()), found[2], textwrap.dedent(found[3]))


def spans(page: str, text: str) -> Iterator[Block]:
    """The commands that a page names in its prose, as `kubectl get pods`."""
    # Of the same length, so that lines keep their numbers.
    prose = BLOCK.sub(lambda block: re.sub(r"[^\n]", " ", block[0]), text)
    for found in SPAN.finditer(prose):
        words = re.sub(r"\s+", " ", found[1])
        if COMMAND.fullmatch(words) and not NO_COMMAND.search(words):
            yield Block(page, line_of(text, found.start()), "span", words)


def line_of(text: str, place: int) -> int:
    return text.count("\n", 0, place) + 1


def of_repository(repository: Path) -> list[Block]:
    """Everything of all pages, page by page and in the order of the lines."""
    found: list[Block] = []
    for file in pages(repository):
        page, text = file.relative_to(repository).as_posix(), file.read_text()
        found += sorted([*blocks(page, text), *spans(page, text)], key=lambda block: block.line)
    return found


def manifests(block: Block, fields: frozenset[str]) -> list[tuple[str, str]]:
    """The parts of a YAML block: `whole` objects as they are, `part` ones as what is below the root of a Leaderboard, and `other` ones.

    `fields` are the names below a Leaderboard's `spec`, some of which are shown without it.
    """
    whole, parts = [], []
    for text in re.split(r"^---\n", block.text, flags=re.MULTILINE):
        text = textwrap.dedent(text)
        first = next((line for line in text.splitlines() if line and not line.startswith("#")), "")
        key = first.partition(":")[0]
        if re.search(r"^kind:", text, re.MULTILINE):
            whole.append(text)
        elif key == "spec":
            parts.append(("part", text))
        elif key in fields:
            parts.append(("part", "spec:\n" + textwrap.indent(text, "  ")))
        else:
            parts.append(("other", text))
    return ([("whole", "---\n".join(whole))] if whole else []) + parts
