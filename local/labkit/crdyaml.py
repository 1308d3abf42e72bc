"""Owns the reading of crds/*.yaml, as the standard library knows no YAML. Pure.

It reads what the printer of `make crds` writes: maps and lists a line each, plain and double-quoted texts, folded and literal blocks,
and `{}`. Everything else is an error with its line, so nothing is misread in silence.
"""

import json
import re
from dataclasses import dataclass
from typing import Any

from .errors import LabError

KEY = re.compile(r'("(?:[^"\\]|\\.)*"|[\w$./-]+):(?: (.*))?$')
NUMBER = re.compile(r"-?\d+(\.\d+)?")
WORDS = {"true": True, "false": False, "null": None, "{}": {}, "[]": []}
# What these begin has another meaning in YAML than the text that it looks like.
MARKED = tuple("'[{&*!|>%@`?")


def read(text: str, name: str) -> Any:
    """The document of a file of this name."""
    lines = [Line(number, line) for number, line in enumerate(text.splitlines(), start=1) if not line.startswith("#")]
    return Reader(lines, name).value(0)


@dataclass
class Line:
    number: int
    text: str

    @property
    def indent(self) -> int:
        return len(self.text) - len(self.text.lstrip(" "))


class Reader:
    """The lines that are not read yet, from `at` on."""

    def __init__(self, lines: list[Line], name: str) -> None:
        self.lines, self.name, self.at = lines, name, 0

    def next(self) -> Line | None:
        return self.lines[self.at] if self.at < len(self.lines) else None

    def fault(self, line: Line) -> LabError:
        return LabError(f"{self.name}:{line.number}: a form of YAML that crdyaml.py does not read: {line.text.strip()}")

    def value(self, indent: int) -> Any:
        """The list or map whose entries stand at this indentation."""
        line = self.next()
        if line is None or line.indent != indent:
            raise LabError(f"{self.name}: nothing to read behind line {self.lines[self.at - 1].number}")
        return self.items(indent) if line.text.lstrip().startswith("- ") else self.entries(indent)

    def items(self, indent: int) -> list[Any]:
        found = []
        while (line := self.next()) and line.indent == indent and line.text.lstrip().startswith("- "):
            rest = line.text[indent + 2 :]
            if KEY.match(rest):
                # The entry is a map whose first key stands behind the hyphen.
                line.text = " " * (indent + 2) + rest
                found.append(self.entries(indent + 2))
            else:
                self.at += 1
                found.append(self.scalar(line, rest, indent))
        return found

    def entries(self, indent: int) -> dict[str, Any]:
        found: dict[str, Any] = {}
        while (line := self.next()) and line.indent == indent and not line.text.lstrip().startswith("- "):
            key = KEY.match(line.text[indent:])
            if key is None:
                raise self.fault(line)
            self.at += 1
            name = json.loads(key[1]) if key[1].startswith('"') else key[1]
            found[name] = self.scalar(line, key[2], indent) if key[2] else self.below(indent)
        line = self.next()
        if line is not None and line.indent > indent:
            raise self.fault(line)
        return found

    def below(self, indent: int) -> Any:
        """What stands under a key: deeper, or a list at the indentation of the key itself."""
        line = self.next()
        if line is None or line.indent < indent:
            return None
        if line.indent == indent:
            return self.items(indent) if line.text.lstrip().startswith("- ") else None
        return self.value(line.indent)

    def scalar(self, line: Line, text: str, indent: int) -> Any:
        if text in (">-", "|-"):
            return self.block(indent, folded=text == ">-")
        if text in WORDS:
            return WORDS[text]
        if text.startswith('"'):
            try:
                return json.loads(text)
            except json.JSONDecodeError:
                raise self.fault(line) from None
        if text.startswith(MARKED) or ": " in text or " #" in text:
            raise self.fault(line)
        if NUMBER.fullmatch(text):
            return float(text) if "." in text else int(text)
        return text

    def block(self, indent: int, *, folded: bool) -> str:
        """A text over several lines, all deeper than its key."""
        taken: list[str] = []
        while (line := self.next()) and (not line.text.strip() or line.indent > indent):
            taken.append(line.text)
            self.at += 1
        depth = min(len(text) - len(text.lstrip(" ")) for text in taken if text.strip())
        lines = [text[depth:] for text in taken]
        if folded and any(not text or text.startswith(" ") for text in lines):
            raise LabError(f"{self.name}: a folded text with paragraphs: {lines[0]}")
        return (" " if folded else "\n").join(lines).rstrip("\n")
