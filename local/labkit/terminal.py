"""Owns what a command shows on a terminal: runs it on one, and draws what it wrote as a picture. Knows no command."""

import fcntl
import html
import os
import pty
import re
import struct
import subprocess
import termios
from collections.abc import Iterator, Mapping, Sequence

from .browser import Tab

# Code of a colour -> what a dark terminal shows, as those of the page.
COLOURS = {31: "#ffaba4", 32: "#7fe0bd", 33: "#ffd690", 34: "#8ab8ff", 35: "#d9b8ff", 36: "#7fd4ea"}
DIM = 2
SEQUENCE = re.compile(r"\x1b\[([0-9;]*)m")
ROWS = 60
# A picture has two pixels for one of a small screen, so that letters stay sharp.
SCALE = 2
PAGE = """<!doctype html><meta charset="utf-8"><style>
* { margin: 0 }
body { background: #0f1216 }
pre { display: inline-block; padding: 14px 18px; background: #0f1216; color: #e8eaee; font: 14px/1.35 "DejaVu Sans Mono", monospace }
.prompt { color: #7fe0bd; font-weight: bold }
.command { font-weight: bold }
</style><pre>BODY</pre>"""


def shown(argv: Sequence[str], env: Mapping[str, str], columns: int) -> str:
    """What a command writes to a terminal of so many columns, with its colours. How it ends is its own affair: it shows that there."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, columns, 0, 0))
    with subprocess.Popen(argv, env=dict(env), stdin=subprocess.DEVNULL, stdout=theirs, stderr=theirs):
        os.close(theirs)
        written = b"".join(everything(ours))
    os.close(ours)
    return written.decode().replace("\r\n", "\n").rstrip("\n")


def everything(terminal: int) -> Iterator[bytes]:
    """What is written to it until nobody has it open any more, which Linux reports as an error."""
    while True:
        try:
            part = os.read(terminal, 65536)
        except OSError:
            return
        if not part:
            return
        yield part


def plain(text: str) -> str:
    return SEQUENCE.sub("", text)


def marked_up(text: str) -> str:
    """The text as HTML, with an element for each stretch in a colour."""
    parts, style = [], ""
    for at, part in enumerate(SEQUENCE.split(text)):
        if at % 2:
            style = style_of(part)
        elif part:
            escaped = html.escape(part)
            parts.append(f'<span style="{style}">{escaped}</span>' if style else escaped)
    return "".join(parts)


def style_of(codes: str) -> str:
    """What stands after the last sequence alone: our programs end each stretch before they begin another."""
    numbers = [int(code) for code in codes.split(";") if code]
    styles = [f"color: {COLOURS[number]}" for number in numbers if number in COLOURS]
    return "; ".join([*styles, *(["opacity: 0.65"] if DIM in numbers else [])])


def picture(tab: Tab, commands: Sequence[tuple[str, str]]) -> bytes:
    """A PNG of a terminal with these commands and what each has written."""
    stretches = [
        f'<span class="prompt">$</span> <span class="command">{html.escape(command)}</span>\n{marked_up(text)}'
        for command, text in commands
    ]
    tab.prefer()
    tab.size(2000, 2000, SCALE)
    tab.open("about:blank")
    tab.fill(PAGE.replace("BODY", "\n\n".join(stretches)))
    width, height = tab.run(
        "(({ width, height }) => [width, height])(document.querySelector('pre').getBoundingClientRect())"
    )
    return tab.picture(width, height)
