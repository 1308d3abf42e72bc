"""Owns the question what a program needs to run: its loader and its shared libraries."""

import os
import re
import struct
import subprocess
from pathlib import Path

from .errors import LabError

PT_INTERP = 3


def interpreter(content: bytes) -> str | None:
    """The loader that a 64-bit little-endian ELF program asks for; None if it is static or no such program."""
    if content[:6] != b"\x7fELF\x02\x01" or len(content) < 64:
        return None
    (headers,) = struct.unpack_from("<Q", content, 32)
    size, count = struct.unpack_from("<HH", content, 54)
    for number in range(count):
        place = headers + number * size
        if place + 56 > len(content):
            return None
        kind, _, offset, _, _, length = struct.unpack_from("<IIQQQQ", content, place)
        if kind == PT_INTERP:
            return content[offset : offset + length].rstrip(b"\0").decode()
    return None


def libraries(program: Path) -> list[Path]:
    """Everything a program is linked with, the loader included, by the names under which it is looked for."""
    if interpreter(program.read_bytes()) is None:
        return []
    # The loader's language decides the words below.
    done = subprocess.run(
        ["ldd", str(program)], capture_output=True, text=True, check=False, env={**os.environ, "LC_ALL": "C"}
    )
    if done.returncode != 0:
        raise LabError(f"ldd {program} failed ({done.stderr.strip()[-200:]})")
    return [Path(path) for path in parse_ldd(done.stdout, str(program))]


def parse_ldd(output: str, program: str) -> list[str]:
    """The paths in the output of ldd, sorted; raises on a library that is not there."""
    absent = re.search(r"^\s*(\S+) => not found", output, re.MULTILINE)
    if absent:
        raise LabError(f"{program} needs {absent.group(1)}, which this machine lacks: install it")
    return sorted(set(re.findall(r"^\s*(?:\S+ => )?(/\S+) \(0x[0-9a-f]+\)$", output, re.MULTILINE)))
