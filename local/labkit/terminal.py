"""Owns what a command shows on a terminal: runs it on one, and draws what it wrote as an SVG. Knows no command."""

import fcntl
import html
import os
import pty
import re
import struct
import subprocess
import termios
from collections.abc import Iterator, Mapping, Sequence

# Code of a colour -> what a dark terminal shows, as those of the page.
COLOURS = {31: "#ffaba4", 32: "#7fe0bd", 33: "#ffd690", 34: "#8ab8ff", 35: "#d9b8ff", 36: "#7fd4ea"}
DIM = 2
SEQUENCE = re.compile(r"\x1b\[([0-9;]*)m")
ROWS = 60
# The shape of a picture, in pixels: a letter of the font at this size is that wide.
SIZE, WIDE, HIGH = 14, 8.4, 19
LEFT, TOP = 18, 40
TEXT, PROMPT = "#e8eaee", "#7fe0bd"
HEAD = """<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}"
    role="img" aria-label="{label}">
<rect width="{width}" height="{height}" rx="9" fill="#0f1216"/>
<g fill="#3c4450"><circle cx="20" cy="18" r="5.5"/><circle cx="38" cy="18" r="5.5"/><circle cx="56" cy="18" r="5.5"/></g>
<g font-family="ui-monospace, 'DejaVu Sans Mono', Menlo, Consolas, monospace" font-size="{size}" fill="{text}">
"""


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


def picture(commands: Sequence[tuple[str, str]]) -> str:
    """An SVG of a terminal with these commands and what each has written."""
    lines = []
    for command, text in commands:
        prompt = f'<tspan fill="{PROMPT}" font-weight="bold">$</tspan>'
        lines.append((len(command) + 2, f'{prompt}<tspan font-weight="bold">{kept(" " + command)}</tspan>'))
        lines += [(len(plain(line)), marked_up(line)) for line in text.split("\n")]
        lines.append((0, ""))
    lines.pop()
    width = round(2 * LEFT + WIDE * max(length for length, _ in lines))
    height = TOP + HIGH * len(lines) + 10
    label = html.escape(", ".join(command for command, _ in commands), quote=True)
    parts = [HEAD.format(width=width, height=height, label=label, size=SIZE, text=TEXT)]
    for row, (length, markup) in enumerate(lines):
        if length:
            # The length makes columns straight in any font.
            place = f'x="{LEFT}" y="{TOP + HIGH * (row + 1) - 6}" textLength="{WIDE * length:.1f}"'
            parts.append(f"<text {place}>{markup}</text>\n")
    return "".join([*parts, "</g>\n</svg>\n"])


def marked_up(line: str) -> str:
    """A line as the content of an SVG's text, with an element for each stretch in a colour."""
    parts, style = [], ""
    for at, part in enumerate(SEQUENCE.split(line)):
        if at % 2:
            style = style_of(part)
        elif part:
            parts.append(f"<tspan {style}>{kept(part)}</tspan>" if style else kept(part))
    return "".join(parts)


def kept(text: str) -> str:
    """A text with each of its spaces, of which an SVG would keep one."""
    return html.escape(text).replace(" ", "&#160;")


def style_of(codes: str) -> str:
    """What stands after the last sequence alone: our programs end each stretch before they begin another, and each line with it."""
    numbers = [int(code) for code in codes.split(";") if code]
    styles = [f'fill="{COLOURS[number]}"' for number in numbers if number in COLOURS]
    return " ".join([*styles, *(['opacity="0.65"'] if DIM in numbers else [])])
