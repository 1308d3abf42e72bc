"""Reads what Rust's test programs print as it streams through, and sums up what failed. Knows libtest's format, and no layer.

A log of an hour is read from its end, and often nothing but its end is kept: so the summary is short and comes last.
"""

import re
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

# Lines of the whole summary, of one message, and characters of a line.
MOST_LINES = 60
MOST_OF_MESSAGE = 15
MOST_OF_LINE = 240
# Names and cases that are listed; the messages have what is left.
MOST_NAMES = 20
MOST_CASES = 10

SECTION = re.compile(r"---- (?P<name>\S+) stdout ----")
PANIC = re.compile(r"thread '.*' (?:\(\d+\) )?panicked at (?P<place>.+):")
# What follows a panic's message in a test's output; `=====` begins the description of a test's namespace.
AFTER_MESSAGE = ("note: run with `RUST_BACKTRACE", "stack backtrace:", "=====")
# Values of a case's third column that are no failure.
GOOD_CASES = ("as expected", "measured")
# Begins what was seen of a good case that says more.
GOOD_START = "as expected: "


@dataclass
class Failure:
    """A failed test with its messages: place and text of each panic, or else the first lines of its output."""

    name: str
    messages: list[list[str]]


class Reader:
    """Takes the output of `cargo test` line by line."""

    def __init__(self) -> None:
        self._names: list[str] = []
        self._panics: dict[str, list[list[str]]] = {}
        self._output: dict[str, list[str]] = {}
        self._section = ""
        self._message: list[str] | None = None
        # Of the list that may be the closing one; None outside of a list.
        self._listed: list[str] | None = None
        self._running = 0
        # The end of the output: all there is where a test program was killed, or not built.
        self.tail: deque[str] = deque(maxlen=MOST_OF_MESSAGE)

    def feed(self, line: str) -> None:
        line = line.rstrip("\n")
        if line.strip():
            self.tail.append(line)
        if re.fullmatch(r"running \d+ tests?", line):
            self._running += 1
        elif line.startswith("test result: "):
            self._running -= 1
            self._names += self._listed or []
            self._end_section()
        elif section := SECTION.fullmatch(line):
            self._end_section()
            self._section = section["name"]
            self._output.setdefault(self._section, [])
        elif line == "failures:":
            self._end_section()
            self._listed = []
        elif self._section:
            self._feed_section(line)
        elif self._listed is not None and line.startswith("    "):
            self._listed.append(line.strip())

    def _end_section(self) -> None:
        self._section, self._message, self._listed = "", None, None

    def _feed_section(self, line: str) -> None:
        output = self._output[self._section]
        if len(output) < MOST_OF_MESSAGE and line.strip():
            output.append(line)
        if panic := PANIC.fullmatch(line):
            self._message = [panic["place"]]
            self._panics.setdefault(self._section, []).append(self._message)
        elif line.startswith(AFTER_MESSAGE):
            self._message = None
        elif self._message is not None and line.strip() and len(self._message) <= MOST_OF_MESSAGE:
            self._message.append(line)

    def failures(self) -> list[Failure]:
        return [Failure(name, self._panics.get(name) or [self._output.get(name, [])]) for name in self._names]

    def is_whole(self) -> bool:
        """Whether each test program that began has come to its end, and reported which tests failed."""
        return self._running == 0 and bool(self._names)


@dataclass
class Summary:
    """What failed in a whole run."""

    failed: list[Failure] = field(default_factory=list)
    # Failed next to other tests and passed alone.
    passed_alone: list[Failure] = field(default_factory=list)
    cases: list[str] = field(default_factory=list)

    def take(self, other: "Summary") -> None:
        """Adds what failed in a part of the run."""
        self.failed += other.failed
        self.passed_alone += other.passed_alone
        self.cases += other.cases

    def lines(self) -> list[str]:
        """At most MOST_LINES of them; none if nothing failed."""
        names = [f"FAILED: {failure.name}" for failure in self.failed]
        names += [f"failed next to others and passed alone: {failure.name}" for failure in self.passed_alone]
        if not names:
            return []
        head = ["", "--- what failed", *_at_most(names, MOST_NAMES), *_at_most(self.cases, MOST_CASES)]
        messages = _messages([*self.failed, *self.passed_alone], MOST_LINES - len(head))
        return [_short(line) for line in [*head, *messages]]


def failed_cases(matrix: str) -> list[str]:
    """The failed ones of the matrix's lines: name, expected, seen, seconds."""
    rows = (line.split("\t") for line in matrix.splitlines())
    return [
        f"case {name!r}: expected {expected!r}, seen {seen!r}"
        for name, expected, seen, _ in rows
        if seen not in GOOD_CASES and not seen.startswith(GOOD_START)
    ]


def _messages(failures: Sequence[Failure], left: int) -> list[str]:
    """Each failure's name and messages; all get the same share of the lines."""
    lines: list[str] = []
    for number, failure in enumerate(failures):
        share = max((left - len(lines)) // (len(failures) - number), 0)
        if share < 2:
            break
        block = [f"{failure.name}:"]
        for message in failure.messages:
            block += [f"  {line}" for line in message[: MOST_OF_MESSAGE + 1]]
        lines += _at_most(block, share)
    return lines


def _at_most(lines: Iterable[str], most: int) -> list[str]:
    lines = list(lines)
    if len(lines) <= most:
        return lines
    return [*lines[: most - 1], f"  … and {len(lines) - most + 1} lines more, see above"]


def _short(line: str) -> str:
    return line if len(line) <= MOST_OF_LINE else line[: MOST_OF_LINE - 1] + "…"
