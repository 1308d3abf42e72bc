"""Owns what an image needs to run Python: this machine's interpreter with its library, and packages of the lab's environment.

Called by `image`. Everything stays where it is on this machine, as the interpreter looks for it there; only the packages are moved.
"""

import os
import re
import subprocess
import sys
import sysconfig
from collections.abc import Iterator, Sequence
from functools import cache
from importlib.metadata import Distribution, distributions
from pathlib import Path

from .elf import parse_ldd
from .errors import LabError
from .layer import Entry, Packed, pack

PROGRAM = "/usr/local/bin/python3"
# Parts of the library that no server needs, most of its bytes.
IDLE = {
    "__pycache__",
    "site-packages",
    "dist-packages",
    "test",
    "tests",
    "idlelib",
    "tkinter",
    "lib2to3",
    "ensurepip",
    "turtledemo",
}
NAME = re.compile(r"[A-Za-z0-9._-]+")


@cache
def packed(site: Path, packages: tuple[str, ...], to: str) -> Packed:
    """What `entries` gives, as a layer that is made once for all images of a run."""
    return pack(entries(site, packages, to))


def entries(site: Path, packages: Sequence[str], to: str) -> Iterator[Entry]:
    """The interpreter, and in `to` the packages with all that they require; `site` is where they are installed."""
    interpreter = Path(sys.executable).resolve()
    yield Entry(str(interpreter), 0o755, interpreter.read_bytes())
    yield Entry(PROGRAM, 0o777, target=str(interpreter))
    yield from libraries(interpreter)
    yield from tree(Path(sysconfig.get_path("stdlib")))
    for package in closure(site, packages):
        for file in package.files or []:
            # As its record names it, a program is in a folder above this one.
            place = Path(os.path.normpath(str(file.locate())))
            # Programs lie outside; what is compiled holds the day in it.
            if place.is_relative_to(site) and "__pycache__" not in file.parts:
                yield from with_libraries(place, f"{to}/{place.relative_to(site)}")


def closure(site: Path, names: Sequence[str]) -> list[Distribution]:
    """The named packages and all that they require, but for their extras."""
    installed = {normal(one.metadata["Name"]): one for one in distributions(path=[str(site)])}
    found: dict[str, Distribution] = {}
    waiting = [normal(name) for name in names]
    while waiting:
        name = waiting.pop()
        if name in found:
            continue
        if name not in installed:
            raise LabError(f"the Python package {name} is not in local/requirements.txt: add it there")
        found[name] = installed[name]
        for required in installed[name].requires or []:
            word, _, condition = required.partition(";")
            other = NAME.match(word)
            # A condition is about extras, or about older versions of Python.
            if other and not condition:
                waiting.append(normal(other[0]))
    return [found[name] for name in sorted(found)]


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def tree(library: Path) -> Iterator[Entry]:
    """The standard library."""
    for root, folders, names in os.walk(library):
        folders[:] = sorted(one for one in folders if one not in IDLE and not one.startswith("config-"))
        for name in sorted(names):
            place = Path(root) / name
            # Debian links some files to /etc.
            if place.exists():
                yield from with_libraries(place, str(place))


def with_libraries(place: Path, to: str) -> Iterator[Entry]:
    yield Entry(to, 0o644, place.read_bytes())
    if place.suffix == ".so" or ".so." in place.name:
        yield from libraries(place)


def libraries(program: Path) -> Iterator[Entry]:
    """What a program or a module is linked with; a module whose library this machine lacks is left to fail when it is imported."""
    done = subprocess.run(
        ["ldd", str(program)], capture_output=True, text=True, check=False, env={**os.environ, "LC_ALL": "C"}
    )
    if done.returncode != 0 or "not found" in done.stdout:
        return
    for path in parse_ldd(done.stdout, str(program)):
        yield Entry(path, 0o755, Path(path).read_bytes())
