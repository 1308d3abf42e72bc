"""Owns the format of image files (TOML): parses them into types that can't hold nonsense. Pure; the format is in local/README.md."""

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

from .errors import LabError

SOURCES = ("bin", "host", "made", "python", "repo", "text")
REPOSITORY = re.compile(r"[a-z0-9]+(?:[._/-][a-z0-9]+)*")
TAG = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,127}")


@dataclass(frozen=True)
class FileSpec:
    """One entry of `files`: `kind` is one of SOURCES; `value` is what follows the colon."""

    kind: str
    value: str
    to: str
    mode: int | None
    libs: bool
    uid: int
    gid: int


@dataclass(frozen=True)
class DirSpec:
    path: str
    mode: int
    uid: int
    gid: int


@dataclass(frozen=True)
class LinkSpec:
    to: str
    target: str


@dataclass(frozen=True)
class ImageSpec:
    """One image: what is in it and how it is run."""

    repository: str
    tag: str
    files: tuple[FileSpec, ...]
    dirs: tuple[DirSpec, ...]
    symlinks: tuple[LinkSpec, ...]
    env: Mapping[str, str]
    entrypoint: tuple[str, ...]
    cmd: tuple[str, ...]
    user: str
    workdir: str

    @property
    def name(self) -> str:
        return f"{self.repository}:{self.tag}"


class Reader:
    """Takes keys out of a TOML table, naming the place in every complaint; `done` refuses what nobody took."""

    def __init__(self, table: object, place: str) -> None:
        if not isinstance(table, dict):
            raise LabError(f"{place} must be a table")
        self.table: dict[str, Any] = dict(table)
        self.place = place

    def text(self, key: str, default: str | None = None) -> str:
        value = self.table.pop(key, default)
        if not isinstance(value, str):
            raise LabError(f"{self.place}: {key} must be a text")
        return value

    def flag(self, key: str) -> bool:
        value = self.table.pop(key, False)
        if not isinstance(value, bool):
            raise LabError(f"{self.place}: {key} must be true or false")
        return value

    def number(self, key: str) -> int:
        value = self.table.pop(key, 0)
        if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= 0o7777777:
            raise LabError(f"{self.place}: {key} must be a number from 0 on")
        return value

    def texts(self, key: str) -> tuple[str, ...]:
        value = self.table.pop(key, [])
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            raise LabError(f"{self.place}: {key} must be a list of texts")
        return tuple(value)

    def tables(self, key: str) -> list[object]:
        value = self.table.pop(key, [])
        if not isinstance(value, list):
            raise LabError(f"{self.place}: {key} must be a list of tables")
        return value

    def path(self, key: str) -> str:
        value = self.text(key)
        if not value.startswith("/") or ".." in PurePosixPath(value).parts or value != str(PurePosixPath(value)):
            raise LabError(f"{self.place}: {key} = {value!r} must be an absolute path in its shortest form")
        return value

    def mode(self, key: str) -> int | None:
        value = self.text(key, "")
        if value and not re.fullmatch(r"[0-7]{3,4}", value):
            raise LabError(f'{self.place}: {key} = {value!r} must be three or four octal digits such as "0755"')
        return int(value, 8) if value else None

    def done(self) -> None:
        if self.table:
            raise LabError(f"{self.place}: nothing is called {', '.join(sorted(self.table))}; see local/README.md")


def parse(text: str, name: str) -> list[ImageSpec]:
    """The images of one file; `name` is what complaints call it. Raises LabError at the first thing that is wrong."""
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise LabError(f"{name} is not TOML: {error}") from error
    reader = Reader(content, name)
    images = [
        parse_image(table, f"{name}: image {number}") for number, table in enumerate(reader.tables("image"), start=1)
    ]
    reader.done()
    if not images:
        raise LabError(f"{name} has no [[image]]")
    names = [image.name for image in images]
    twice = sorted({one for one in names if names.count(one) > 1})
    if twice:
        raise LabError(f"{name} has {twice[0]} twice")
    return images


def parse_image(table: object, place: str) -> ImageSpec:
    reader = Reader(table, place)
    repository, tag = reader.text("repository"), reader.text("tag")
    if not REPOSITORY.fullmatch(repository) or not TAG.fullmatch(tag):
        raise LabError(f"{place}: {repository}:{tag} is no image name")
    reader.place = f"{place} ({repository}:{tag})"
    env = Reader(reader.table.pop("env", {}), f"{reader.place}: env")
    spec = ImageSpec(
        repository=repository,
        tag=tag,
        files=tuple(
            parse_file(item, f"{reader.place}: file {n}") for n, item in enumerate(reader.tables("files"), start=1)
        ),
        dirs=tuple(
            parse_dir(item, f"{reader.place}: dir {n}") for n, item in enumerate(reader.tables("dirs"), start=1)
        ),
        symlinks=tuple(
            parse_link(item, f"{reader.place}: symlink {n}")
            for n, item in enumerate(reader.tables("symlinks"), start=1)
        ),
        env={key: env.text(key) for key in sorted(env.table)},
        entrypoint=reader.texts("entrypoint"),
        cmd=reader.texts("cmd"),
        user=reader.text("user", ""),
        workdir=reader.text("workdir", ""),
    )
    reader.done()
    return spec


def parse_file(table: object, place: str) -> FileSpec:
    reader = Reader(table, place)
    kind, colon, value = reader.text("from").partition(":")
    if kind not in SOURCES or not colon:
        raise LabError(f"{place}: from must begin with one of {', '.join(f'{source}:' for source in SOURCES)}")
    if kind == "host" and not value.startswith("/"):
        raise LabError(f"{place}: host: takes an absolute path, not {value!r}")
    if kind in ("made", "repo") and (value.startswith("/") or ".." in PurePosixPath(value).parts):
        raise LabError(f"{place}: {kind}: takes a path inside the repository, not {value!r}")
    spec = FileSpec(
        kind,
        value,
        reader.path("to"),
        reader.mode("mode"),
        reader.flag("libs"),
        reader.number("uid"),
        reader.number("gid"),
    )
    reader.done()
    return spec


def parse_dir(table: object, place: str) -> DirSpec:
    reader = Reader(table, place)
    mode = reader.mode("mode")
    spec = DirSpec(reader.path("path"), 0o755 if mode is None else mode, reader.number("uid"), reader.number("gid"))
    reader.done()
    return spec


def parse_link(table: object, place: str) -> LinkSpec:
    reader = Reader(table, place)
    spec = LinkSpec(reader.path("to"), reader.text("target"))
    reader.done()
    return spec
