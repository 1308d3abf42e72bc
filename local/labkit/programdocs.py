"""Owns docs/reference/programs.md: exit codes and status files, made from the sources of the programs. Pure but for these files."""

import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from .errors import LabError
from .marks import between

PAGE = Path("docs/reference/programs.md")
END = "<!-- end -->"
OPERATOR = "src/cli"
RUNNER = "crates/runner/src"
PROTOCOL = "crates/protocol/src/files.rs"
# Exit codes that the controller knows as well.
VERDICT = "crates/protocol/src/verdict.rs"
# The pages of its help, which the plugin's own tests compare with the program.
PLUGIN = "crates/kubectl-leaderboard/src/tests/shown/help.txt"
TEXT = r"((?: *///[^\n]*\n)+)"
CODE = re.compile(TEXT + r"(?:pub(?:\([a-z]+\))? )?const CODE_\w+: \w+ = (\d+);")
FILE = re.compile(TEXT + r"    (Of|Cancel|Stored)\b")
MARK = re.compile(TEXT + r"    (Start|Crash|Done)\b")
COMMAND = re.compile(r"#\[command\(after_help = (\w+)::(\w+)\)\]\n    ([A-Z]\w*)\(")
CONSTANT = re.compile(r'const (\w*EXIT_CODES): &str =\s*"((?:[^"\\]|\\.)*)";', re.DOTALL)
HELP = re.compile(r"^=== (kubectl leaderboard [a-z ]*)--help\n(.*?)(?=^=== |\Z)", re.MULTILINE | re.DOTALL)
CODES = re.compile(r"^Exit code (.+?)\n\n", re.MULTILINE | re.DOTALL)


def update(repository: Path) -> None:
    file = repository / PAGE
    file.write_text(page(file.read_text(), repository))


def same(repository: Path) -> str:
    """For the chart's test: raises unless the page is that of the sources."""
    text = (repository / PAGE).read_text()
    if page(text, repository) != text:
        raise LabError(f"{PAGE} differs from the sources: run `make chart-docs`")
    return f"{sum(line.startswith('| `') for line in text.splitlines())} rows"


def page(text: str, repository: Path) -> str:
    """The page with the tables of these sources."""
    protocol = (repository / PROTOCOL).read_text()
    plugin = (repository / PLUGIN).read_text()
    tables = {
        f"the status files, from {PROTOCOL}": status_files(protocol),
        f"the exit codes of leaderboard-runner, from {RUNNER}": runner(
            sources(repository / RUNNER) + (repository / VERDICT).read_text()
        ),
        f"the exit codes of leaderboard-operator, from {OPERATOR}": operator(repository),
        f"the exit codes of kubectl leaderboard, from {PLUGIN}": rows(helps(plugin)),
    }
    for name, table in tables.items():
        text = between(text, f"<!-- made by `make chart-docs`: {name} -->", END, table, str(PAGE))
    return text


def sources(folder: Path) -> str:
    return "\n".join(file.read_text() for file in sorted(folder.rglob("*.rs")))


def words(comment: str) -> str:
    """The text of a comment above an item."""
    return " ".join(line.strip().removeprefix("///").strip() for line in comment.strip().splitlines())


def body(source: str, item: str) -> str:
    """What stands between the braces of an enum."""
    found = re.search(rf"^pub enum {item} \{{\n(.*?)^\}}", source, re.MULTILINE | re.DOTALL)
    if found is None:
        raise LabError(f"{PROTOCOL} has no enum {item}, of which {PAGE} is made")
    return found[1]


def status_files(protocol: str) -> str:
    files = {name: words(comment) for comment, name in FILE.findall(body(protocol, "StatusFile"))}
    marks = {name: words(comment) for comment, name in MARK.findall(body(protocol, "Mark"))}
    if len(files) != 3 or len(marks) != 3:
        raise LabError(f"{PROTOCOL} has other files and marks than programdocs.py knows: {[*files, *marks]}")
    lines = ["| file | meaning |", "|---|---|"]
    for mark, suffix in (("Start", ".start<c>"), ("Crash", ".crash<c>"), ("Done", ".done")):
        lines.append(f"| `<member>/<member>{suffix}` | {marks[mark]} |")
    for name in ("Cancel", "Stored"):
        file, comma, text = files[name].partition(", ")
        lines.append(f"| {file} | {text[0].upper()}{text[1:]} |" if comma else f"| {file} | |")
    return "\n".join(lines)


def runner(source: str) -> str:
    codes = {int(code): words(comment) for comment, code in CODE.findall(source)}
    if len(codes) != len(re.findall(r"\bconst CODE_\w+:", source)):
        raise LabError(f"{RUNNER}: each CODE_ needs a comment above it and a number of its own")
    lines = ["| code | meaning |", "|---|---|"]
    return "\n".join([*lines, *(f"| `{code}` | {codes[code]} |" for code in sorted(codes))])


def operator(repository: Path) -> str:
    folder = repository / OPERATOR
    found = COMMAND.findall((folder / "mod.rs").read_text())
    texts = []
    for module, constant, variant in found:
        file = folder / f"{module}.rs"
        source = (file if file.exists() else folder / module / "mod.rs").read_text()
        known = {name: re.sub(r"\\\n\s*", "", text) for name, text in CONSTANT.findall(source)}
        if constant not in known:
            raise LabError(f"{OPERATOR}: {module} has no {constant} that programdocs.py can read")
        texts.append((f"leaderboard-operator {variant.lower()}", known[constant]))
    return rows(texts)


def helps(plugin: str) -> Iterator[tuple[str, str]]:
    """The commands whose help shows what their exit codes mean, each with that text."""
    for command, text in HELP.findall(plugin):
        if codes := CODES.search(text):
            yield command.strip(), f"Exit code {' '.join(codes[1].split())}"


def rows(texts: Iterable[tuple[str, str]]) -> str:
    lines = [f"| `{command}` | {text.removeprefix('Exit code ')} |" for command, text in texts]
    if not lines:
        raise LabError("no program says what its exit codes mean in a way that programdocs.py can read")
    return "\n".join(["| command | exit codes |", "|---|---|", *lines])
