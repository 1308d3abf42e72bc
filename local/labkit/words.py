"""Words that a reader does not search for, and the usual ones of the field; with `prose`, what `local/words` finds.

Only words without another use are listed, so that a finding is never a matter of taste. Of Rust and Python these are read: comments,
strings and the names of functions, since that of a test is a sentence. Any other text file is read as a whole.
"""

import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from . import doccheck, prose

# At the start of a message: nobody knows whose Pod it is.
NAMED = {"Its Pod": "The Pod, or its name", "Its Job": "The Job, or its name"}
USUAL = {
    "wish": "request",
    "wishes": "requests",
    "wished": "requested",
    "mend": "fix",
    "mends": "fixes",
    "mended": "fixed",
    "mending": "fixing",
    "whoever": "anyone who",
    "for ever": "permanently",
    "bury": "dead-letter",
    "buries": "dead-letters",
    "buried": "dead-lettered",
    "fate": "outcome",
    "is told": "receives, or is asked",
}
PATTERN = re.compile(
    "|".join(rf"\b(?:{word})\b".replace(" ", r"\s+") for word in NAMED)
    + "|(?i:"
    + "|".join(rf"\b(?:{word})\b".replace(" ", r"\s+") for word in USUAL)
    + ")"
)
# A comment, a raw string, a string, a character, which may be a quotation mark, or the name of a function.
RUST = re.compile(r"\bfn\s+\w+|//[^\n]*|/\*.*?\*/|\br(#*)\".*?\"\1|\"(?:\\.|[^\"\\])*\"|'(?:\\.|[^\\'\n])'", re.DOTALL)
# Written by programs, or about these words.
LEFT_OUT = ("Cargo.lock", "go.sum", "words.py", "prose.py", "words.allow", "test_words.py", "test_prose.py")


class Finding(NamedTuple):
    path: str
    line: int
    word: str
    better: str

    def __str__(self) -> str:
        return f'{self.path}:{self.line}: "{self.word}": write {self.better}'


def find(path: str, text: str) -> Iterator[Finding]:
    """The words of a file that have a usual one."""
    for line, part in parts(path, text):
        for match in PATTERN.finditer(part):
            word = " ".join(match.group().split())
            better = NAMED.get(word) or USUAL[word.lower()]
            yield Finding(path, line + part.count("\n", 0, match.start()), word, better)


def parts(path: str, text: str) -> Iterator[tuple[int, str]]:
    """What people read of a file, with the line it starts in."""
    if path.endswith(".rs"):
        for match in RUST.finditer(text):
            is_name = match.group().startswith("fn")
            part = match.group().replace("_", " ") if is_name else match.group()
            yield text.count("\n", 0, match.start()) + 1, part
    elif path.endswith(".py") or text.startswith("#!/usr/bin/env python3"):
        before = ""
        for token in tokenize.generate_tokens(io.StringIO(text).readline):
            if before == "def":
                yield token.start[0], token.string.replace("_", " ")
            elif token.type not in (tokenize.NAME, tokenize.OP, tokenize.NUMBER):
                yield token.start[0], token.string
            before = token.string
    else:
        yield 1, text


def allowed(listing: str) -> list[tuple[str, str]]:
    """The allowed lines: a path, and a part of a line."""
    lines = (line.strip() for line in listing.splitlines())
    pairs = (line.split(": ", 1) for line in lines if line and not line.startswith("#"))
    return [(pair[0], pair[1]) for pair in pairs]


def check(texts: dict[str, str], listing: str) -> tuple[list[Finding], list[str]]:
    """What is found and not allowed, and what is allowed without a finding."""
    rules = allowed(listing)
    used: set[tuple[str, str]] = set()
    findings = []
    for path, text in sorted(texts.items()):
        lines = text.splitlines()
        for finding in find(path, text):
            matching = {rule for rule in rules if rule[0] == path and rule[1] in lines[finding.line - 1]}
            used |= matching
            if not matching:
                findings.append(finding)
    return findings, [f"{path}: {part}" for path, part in rules if (path, part) not in used]


def tracked(folder: Path) -> dict[str, str]:
    """The text files of the repository."""
    texts = {}
    for name in doccheck.tracked(folder):
        path = folder / name
        if path.is_symlink() or not path.is_file() or path.name in LEFT_OUT:
            continue
        try:
            texts[name] = path.read_text(encoding="utf-8")
        except UnicodeDecodeError:
            continue
    return texts


def main(folder: Path, allow: Path) -> int:
    texts = tracked(folder)
    findings, unused = check(texts, allow.read_text(encoding="utf-8"))
    faults = prose_faults(texts)
    for finding in [*findings, *faults]:
        print(finding)
    for rule in unused:
        print(f'{allow.name}: "{rule}" allows nothing any more: remove it')
    return 1 if findings or faults or unused else 0


def prose_faults(texts: dict[str, str]) -> list[prose.Fault]:
    """What is hard to read in the documents."""
    pages = {path: text for path, text in sorted(texts.items()) if path.endswith(".md") and path not in prose.LEFT_OUT}
    return [fault for path, text in pages.items() for fault in prose.faults(path, text)]
