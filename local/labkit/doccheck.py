"""Owns what the documents promise of the repository: runbooks for alerts, links that lead somewhere, tests, files and names that exist.

Pure but for reading files. Called by the chart's test and by local/tests.
"""

import re
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from .errors import LabError

ALERTS = "charts/leaderboard-operator/files/alerts.yaml"
RUNBOOKS = "docs/runbooks"
ALERT = re.compile(r"^\s+- alert: (\w+)$", re.MULTILINE)
RUNBOOK_PARTS = ("**Meaning.**", "**Impact.**", "**Find out**", "**Fix.**")
LINK = re.compile(r"\]\(([^)\s]+)\)")
FENCE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
# No link: a pattern such as [a](b)*.
CODE = re.compile(r"`[^`\n]*`")
HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)
ROW = re.compile(r"^\| (\d+) \| (.+) \| (\w[\w ]*) \| (.+) \|$", re.MULTILINE)
TEST = re.compile(r"`([\w./-]+\.(?:rs|py))::(\w+)`")
RUST_TEST = re.compile(r"#\[(?:tokio::)?test[^\]]*\]((?:\s*#\[[^\]]*\])*)\s*(?:async )?fn (\w+)")
PYTHON_TEST = re.compile(r"^    def (test_\w+)", re.MULTILINE)
# The chart's test is no unittest: it checks by functions, each of which it names once.
CHART_CHECK = re.compile(r"^ +check\(\".+\", lambda: (?:\w+\.)?(\w+)\(", re.MULTILINE)
PAGE_CHECK = re.compile(r'^    "[^"]+": (\w+),$', re.MULTILINE)
# A file of the source as a page writes it, whole or by its end: `crates/policy/src/plan.rs`, `queue/choose.rs`.
PLACE = re.compile(
    r"`((?:[\w.-]+/)*[\w.-]+\.(?:rs|py)|(?:src|crates|tests|local|benches|charts|examples)/[\w./-]*\w/?)`"
)
NAME_IN_PLACE = re.compile(r"`([\w:]+)` in\s+`((?:[\w.-]+/)*[\w.-]+\.(?:rs|py))`")
# A row of docs/reference/attacks.md.
SHOWN = re.compile(r"^\| (\d+) \| `([\w./-]+\.(?:rs|py))::(\w+)` \|$", re.MULTILINE)
# Their pages get the address where they are shown.
WITHOUT_ADDRESS = ("crates/api/src/reasons/table.rs", "crates/kubectl-leaderboard/src/main.rs")
MESSAGES = re.compile(r"(?:crates/[\w-]+/)?src/(?!.*tests?\b)[\w/-]*\.rs$")
TESTS_OF_MODULE = re.compile(r"^#\[cfg\(test\)\]$", re.MULTILINE)
PAGE_OF_MESSAGE = re.compile(r"(?:\{DOCUMENTS\}|docs/)([\w/-]+\.md)(?:#([\w-]+))?")
# A comment may name a page by its path, and so does what includes its text.
BARE_PAGE = re.compile(r"^(?!\s*//)(?!.*include_str!).*\b(docs/[\w/-]+\.md)", re.MULTILINE)
KINDS = ("held", "by policy", "inherent", "open", "struck")
# How the sums are written in the text, so that it cannot contradict its table.
SUMS = re.compile(
    r"The table has (\d+) attacks: (\d+) are held, (\d+) are held by policy, (\d+) are inherent, (\d+) are open, and (\d+) are struck\."
)


@dataclass(frozen=True)
class Attack:
    """One row of the table in docs/security.md. `tests` are pairs of a file and a test's name, from the row or the page of tests."""

    number: int
    kind: str
    tests: tuple[tuple[str, str], ...]


def runbook_faults(repository: Path) -> Iterator[str]:
    """What is missing between alerts and pages, in both directions."""
    alerts = set(ALERT.findall((repository / ALERTS).read_text()))
    folder = repository / RUNBOOKS
    index = (folder / "README.md").read_text()
    pages = {page.stem for page in folder.glob("*.md")} - {"README"}
    if not alerts:
        yield f"{ALERTS} names no alert that doccheck.py could read"
    yield from (f"{name} has no page: write {RUNBOOKS}/{name}.md" for name in sorted(alerts - pages))
    yield from (f"{RUNBOOKS}/{name}.md is about no alert: delete it" for name in sorted(pages - alerts))
    for name in sorted(alerts & pages):
        text = (folder / f"{name}.md").read_text()
        parts = (f"# {name}\n", *RUNBOOK_PARTS)
        yield from (f"{RUNBOOKS}/{name}.md lacks {part.strip()}" for part in parts if part not in text)
        if f"]({name}.md)" not in index:
            yield f"{RUNBOOKS}/README.md does not list {name}"


def runbooks(repository: Path) -> str:
    """For the chart's test: raises unless each alert has its page."""
    faults = list(runbook_faults(repository))
    if faults:
        raise LabError("; ".join(faults))
    return f"{len(ALERT.findall((repository / ALERTS).read_text()))} alerts"


def pages(repository: Path) -> list[Path]:
    """Every Markdown file that git knows or would add."""
    listed = tracked(repository, "--cached", "--others", "--exclude-standard", "*.md")
    return [repository / name for name in sorted(set(listed)) if (repository / name).exists()]


def tracked(repository: Path, *chosen: str) -> list[str]:
    """Every file that git knows, or those that these arguments of `git ls-files` choose."""
    argv = ["git", "-C", str(repository), "ls-files", "-z", *chosen]
    listed = subprocess.run(argv, capture_output=True, text=True, check=True).stdout
    return [name for name in listed.split("\0") if name]


def place_faults(repository: Path, page: Path, files: Sequence[str]) -> Iterator[str]:
    """Files that a page of the house names and that do not exist, and names that are not in the file where the page places them."""
    text = FENCE.sub("", page.read_text())
    for place in sorted(set(PLACE.findall(text))):
        if not _named(place, files):
            yield f"{page.name}: there is no {place}"
    for name, place in NAME_IN_PLACE.findall(text):
        texts = [(repository / file).read_text() for file in _named(place, files)]
        word = re.compile(rf"\b{name.split('::')[-1]}\b")
        if texts and not any(word.search(text) for text in texts):
            yield f"{page.name}: {name} is not in {place}"


def _named(place: str, files: Sequence[str]) -> list[str]:
    """The files of that name, or below the folder of that name."""
    place = place.rstrip("/")
    ends = [file for file in files if f"/{file}".endswith(f"/{place}")]
    return ends or [file for file in files if f"/{place}/" in f"/{file}"]


def anchors(text: str) -> set[str]:
    """The places of a page that a link can name, as GitHub makes them of headings."""
    headings = HEADING.findall(FENCE.sub("", text))
    return {re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-") for heading in headings}


def link_faults(page: Path) -> Iterator[str]:
    """Links of a page to files, and places in them, that do not exist."""
    for link in LINK.findall(CODE.sub("", FENCE.sub("", page.read_text()))):
        if re.match(r"[a-z]+:", link):
            continue
        target, _, place = link.partition("#")
        file = (page.parent / target).resolve() if target else page
        if not file.exists():
            yield f"{page.name}: {link} leads nowhere"
        elif place and file.suffix == ".md" and place not in anchors(file.read_text()):
            yield f"{page.name}: {link}: there is no heading {place}"


def message_faults(repository: Path, files: Sequence[str]) -> Iterator[str]:
    """Pages of messages that do not exist, and messages that name a page without its address."""
    for file in files:
        if not MESSAGES.match(file):
            continue
        text = TESTS_OF_MODULE.split((repository / file).read_text())[0]
        for page, place in PAGE_OF_MESSAGE.findall(text):
            target = repository / "docs" / page
            if not target.exists():
                yield f"{file}: there is no docs/{page}"
            elif place and place not in anchors(target.read_text()):
                yield f"{file}: docs/{page} has no heading {place}"
        if file not in WITHOUT_ADDRESS:
            yield from (f"{file}: name {page} by DOCUMENTS" for page in BARE_PAGE.findall(text))


def attacks(text: str, tests: str) -> list[Attack]:
    """The rows of the table, in the order of the page, with what the page of tests has for each number."""
    shown: dict[int, list[tuple[str, str]]] = {}
    for number, file, name in SHOWN.findall(tests):
        shown.setdefault(int(number), []).append((file, name))
    return [
        Attack(int(number), kind, (*TEST.findall(why), *shown.get(int(number), [])))
        for number, _, kind, why in ROW.findall(text)
    ]


def attack_faults(text: str, tests: str, expected: int) -> Iterator[str]:
    """What is wrong with the table of attacks by itself: numbers, kinds, missing tests, and the sums in the text."""
    found = attacks(text, tests)
    numbers = [attack.number for attack in found]
    if numbers != list(range(1, expected + 1)):
        odd = sorted(set(numbers) ^ set(range(1, expected + 1)))
        yield f"the rows must be 1 to {expected} in order; wrong or missing: {odd or 'the order'}"
    for number in sorted({int(row[0]) for row in SHOWN.findall(tests)} - set(numbers)):
        yield f"the page of tests has attack {number}, which the table lacks"
    for attack in found:
        if attack.kind not in KINDS:
            yield f"attack {attack.number} is {attack.kind!r}, not one of {', '.join(KINDS)}"
        if attack.kind in ("held", "by policy") and not attack.tests:
            yield f"attack {attack.number} is {attack.kind} and names no test"
    sums = SUMS.search(text)
    counted = [len(found), *(sum(attack.kind == kind for attack in found) for kind in KINDS)]
    if sums is None:
        yield "the sums are not in the text"
    elif [int(number) for number in sums.groups()] != counted:
        yield f"the text says {list(map(int, sums.groups()))}, the table has {counted}"


def test_faults(repository: Path, named: Sequence[tuple[str, str]]) -> Iterator[str]:
    """Tests that a document names and that do not exist."""
    for path, name in sorted(set(named)):
        file = repository / path
        if not file.exists():
            yield f"{path} does not exist, which has {name}"
        elif name not in tests_of(file.read_text(), file.suffix):
            yield f"{path} has no test {name}"


def tests_of(text: str, suffix: str) -> set[str]:
    """The names of the tests in a file that run without being asked for."""
    if suffix == ".py":
        return {*PYTHON_TEST.findall(text), *CHART_CHECK.findall(text), *PAGE_CHECK.findall(text)}
    return {name for attributes, name in RUST_TEST.findall(text) if "#[ignore" not in attributes}
