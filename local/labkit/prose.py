"""Owns the rules of prose in documents: short sentences, short cells, lists that a reader can scan, and no habit that hides who acts.

Pure. Called by `words`, and so by `local/words` and CI.
"""

import re
from collections.abc import Iterator
from typing import NamedTuple

# Words of a sentence, where code, a path and a number are one word each.
SENTENCE = 30
# Characters of a cell as a reader sees it: of a link its text alone.
CELL = 200
# Items of a list without a heading between them.
ITEMS = 15

# A table of contents, which has the titles of pages, and pages of which `docs/reference` is made from crds/.
LEFT_OUT = (
    "charts/leaderboard-operator/README.md",
    "docs/SUMMARY.md",
    "docs/reference/leaderboard.md",
    "docs/reference/submission.md",
)

HABITS = {
    r"(?:is|are|was|were|be|been) told": "name who reads it where",
    r"(?:is|are|was|were) said": "name who says it",
    r"(?:is|are|was|were) asked": "name who asks",
    r"(?:is|are|was|were) noticed": "name who notices it",
    r"nobody": "no one thing or person acts: name what happens instead",
    r"nothing\b[^.;:|]{0,60}\bbut\b": "only",
    r"whoever": "anyone who",
    r"strangers'?": "participants",
}
HABIT = re.compile(r"\b(?:" + "|".join(f"({pattern})" for pattern in HABITS) + r")(?!\w)", re.IGNORECASE)
# A sentence that begins with one of these has no subject yet. A question may.
HEADLESS = re.compile(r"(?:What|Who|Whom|Whose|Whether|Of|The same|Those)\b")

FENCE = re.compile(r"^ *(```|~~~)")
ITEM = re.compile(r"^( *)(?:[-*+]|\d+\.) +(?=\S)")
COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
IMAGE = re.compile(r"!\[[^\]]*\]\([^)]*\)")
LINK = re.compile(r"\[([^\[\]]*)\](?:\([^()\s]*(?:\([^()]*\))?[^()\s]*\)|\[[^\]]*\])")
TAG = re.compile(r"</?[a-zA-Z][^<>]*>")
CODE = re.compile(r"(`+)(?!`)(.+?)(?<!`)\1(?!`)", re.DOTALL)
SHORT = re.compile(r"\b(?:e\.g|i\.e|etc|vs|cf|No)\.(?= )")
ENDS = re.compile(r"(?<=[.!?]\*\*)\s+|(?<=[.!?])[)\"'*_”]*\s+(?=[\"'(*_“`\[]*[A-Z0-9\x00])")
WORD = re.compile(r"[\w\x00]")
# The place of a piece of code, while a sentence is read.
HELD = "\x00"


class Fault(NamedTuple):
    path: str
    line: int
    text: str

    def __str__(self) -> str:
        return f"{self.path}:{self.line}: {self.text}"


class Block(NamedTuple):
    """A paragraph, an item of a list, a heading or a cell, as it stands in the file."""

    line: int
    kind: str
    text: str


def faults(path: str, text: str) -> Iterator[Fault]:
    """The faults of one document, line by line."""
    found = []
    items = 0
    for block in blocks(text):
        if block.kind == "item":
            items += 1
            if items == ITEMS + 1:
                found.append(Fault(path, block.line, f"more than {ITEMS} items without a heading between them"))
        elif block.kind != "more":
            items = 0
        found += [Fault(path, block.line, fault) for fault in of_block(block)]
    yield from sorted(found, key=lambda fault: fault.line)


def of_block(block: Block) -> Iterator[str]:
    """The faults of a block."""
    shown = seen(block.text)
    # A query or a command is read as one word.
    is_code = CODE.fullmatch(block.text) is not None
    if block.kind == "cell" and len(shown) > CELL and not is_code:
        yield f"a cell of {len(shown)} characters, {CELL} at most: {begin(shown)}"
    if block.kind == "heading":
        return
    for sentence in sentences(block.text):
        count = len([word for word in sentence.split() if WORD.search(word)])
        if count > SENTENCE:
            yield f"a sentence of {count} words, {SENTENCE} at most: {begin(sentence)}"
        headless = HEADLESS.match(sentence.lstrip("*_\"'("))
        is_head = sentence.startswith("**") and "**" not in sentence[2:]
        if headless and block.kind != "cell" and not is_head and not sentence.rstrip(")*\"'").endswith("?"):
            yield f'a sentence begins with "{headless[0]}": name its subject first: {begin(sentence)}'
        for habit in HABIT.finditer(sentence):
            better = list(HABITS.values())[(habit.lastindex or 1) - 1]
            yield f'"{habit[0]}": write {better}'


def begin(text: str) -> str:
    """The first words of it, to be found by."""
    words = text.replace(HELD, "`…`").split()
    return " ".join(words[:8]) + ("" if len(words) <= 8 else " …")


def seen(text: str) -> str:
    """The text as a reader sees it."""
    text = TAG.sub("", LINK.sub(r"\1", IMAGE.sub("", text)))
    return " ".join(CODE.sub(r"\2", text).replace("\\|", "|").split())


def sentences(text: str) -> list[str]:
    """The sentences of a block, each with a mark in place of a piece of code, which counts as one word."""
    text = CODE.sub(HELD, LINK.sub(r"\1", IMAGE.sub("", text)))
    text = SHORT.sub(lambda short: short[0].replace(".", ""), TAG.sub("", text))
    return [part for part in ENDS.split(" ".join(text.split())) if part]


def blocks(text: str) -> Iterator[Block]:
    """The blocks of a document without code and comments; `more` is a further paragraph of an item."""
    lines = COMMENT.sub(lambda comment: re.sub(r"[^\n]", " ", comment[0]), text).splitlines()
    open_block: Block | None = None
    fenced = in_list = False
    for number, line in enumerate(lines, 1):
        kind, part = kind_of(line, fenced)
        if kind == "text" and line.startswith("    ") and open_block is None and not in_list:
            continue
        fenced ^= kind == "fence"
        if kind == "text" and open_block is not None:
            open_block = open_block._replace(text=f"{open_block.text}\n{part}")
            continue
        if open_block is not None:
            yield open_block
            open_block = None
        if kind in ("heading", "row"):
            in_list = False
            yield from cells(number, part) if kind == "row" else (Block(number, kind, part),)
        elif kind == "item":
            in_list = True
            open_block = Block(number, kind, part)
        elif kind == "text":
            in_list &= line.startswith(" ")
            open_block = Block(number, "more" if in_list else "paragraph", part)
    if open_block is not None:
        yield open_block


def kind_of(line: str, fenced: bool) -> tuple[str, str]:
    """The kind of a line, and its text without the marks of that kind."""
    bare = line.strip().removeprefix("> ").strip()
    if FENCE.match(line):
        return "fence", ""
    if fenced or not bare or bare.startswith("[!"):
        return "none", ""
    if re.match(r"#+ ", bare):
        return "heading", bare.lstrip("# ")
    if bare.startswith("|"):
        return "row", bare
    if ITEM.match(line):
        return "item", ITEM.sub("", line)
    return "text", bare


def cells(number: int, row: str) -> Iterator[Block]:
    """The cells of a row of a table; the row of dashes below its head has none."""
    kept = CODE.sub(lambda code: code[0].replace("|", "\\|") if "\\|" not in code[0] else code[0], row)
    parts = [part.strip() for part in re.split(r"(?<!\\)\|", kept.strip("|"))]
    if not all(re.fullmatch(r":?-+:?", part) for part in parts):
        yield from (Block(number, "cell", part) for part in parts if part)
