"""Owns what an engine's image must be: reads an OCI layout and compares it with the image file of our own maker. Starts nothing."""

import gzip
import io
import json
import tarfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from . import elf
from .image_spec import FileSpec, ImageSpec
from .layer import sha256

GZIP = b"\x1f\x8b"
ELF = b"\x7fELF"
# Of a release, as a registry keeps it.
MOST_PUSHED_BYTES = 30 << 20


@dataclass(frozen=True)
class Member:
    """A file, folder or link of a layer."""

    mode: int
    is_dir: bool
    # Empty for all but files.
    content: bytes = b""


@dataclass(frozen=True)
class Layer:
    # Of its tar.
    digest: str
    tar_bytes: int
    # As the engine pushes it.
    pushed_bytes: int
    # By absolute path.
    members: dict[str, Member]


@dataclass(frozen=True)
class Built:
    config: dict[str, Any]
    layers: list[Layer]


def read(folder: Path) -> Built:
    """The one image of an OCI layout."""
    blobs = folder / "blobs" / "sha256"

    def blob(descriptor: dict[str, Any]) -> bytes:
        return (blobs / descriptor["digest"].removeprefix("sha256:")).read_bytes()

    (manifest,) = json.loads((folder / "index.json").read_text())["manifests"]
    parts = json.loads(blob(manifest))
    config = json.loads(blob(parts["config"]))["config"]
    return Built(config, [read_layer(blob(one)) for one in parts["layers"]])


def read_layer(pushed: bytes) -> Layer:
    content = gzip.decompress(pushed) if pushed.startswith(GZIP) else pushed
    members = {}
    with tarfile.open(fileobj=io.BytesIO(content)) as archive:
        for info in archive.getmembers():
            file = archive.extractfile(info) if info.isreg() else None
            path = str(PurePosixPath("/") / info.name)
            # Some engines write the kind of a file into its mode.
            members[path] = Member(info.mode & 0o7777, info.isdir(), file.read() if file else b"")
    return Layer(f"sha256:{sha256(content)}", len(content), len(pushed), members)


def faults(built: Built, base: Sequence[str], spec: ImageSpec) -> list[str]:
    """Where the image differs from a base of these digests with the programs of `spec`, run as `spec` has it."""
    found = [*of_config(built.config, spec)]
    if [layer.digest for layer in built.layers[: len(base)]] != list(base):
        return [*found, "its first layers are not those of its base"]
    own = {path: member for layer in built.layers[len(base) :] for path, member in layer.members.items()}
    under = {path for layer in built.layers[: len(base)] for path in layer.members}
    return [*found, *of_files(own, under, {item.to: item for item in programs(spec)})]


def programs(spec: ImageSpec) -> list[FileSpec]:
    """What is built; all else is the base's."""
    return [item for item in spec.files if item.kind == "bin"]


def of_config(config: dict[str, Any], spec: ImageSpec) -> Iterator[str]:
    for key, expected in (("Entrypoint", list(spec.entrypoint)), ("Cmd", list(spec.cmd)), ("User", spec.user)):
        seen = config.get(key) or type(expected)()
        if seen != expected:
            yield f"{key} is {seen!r}, and {expected!r} expected"
    paths = [value.removeprefix("PATH=") for value in config.get("Env") or [] if value.startswith("PATH=")]
    folders = ":".join(paths).split(":")
    for name in spec.entrypoint[:1]:
        if not any(f"{folder}/{name}" == item.to for folder in folders for item in programs(spec)):
            yield f"{name} is in no folder of its PATH, {':'.join(folders) or 'which is empty'}"


def of_files(own: dict[str, Member], base: set[str], expected: dict[str, FileSpec]) -> Iterator[str]:
    """What is wrong with the files on top of the base's."""
    folders = {str(parent) for path in expected for parent in PurePosixPath(path).parents}
    for path, member in sorted(own.items()):
        if path not in expected and not (member.is_dir and path in folders):
            yield f"{path} is in it, which neither its base nor the list of programs has"
    for path, item in sorted(expected.items()):
        member = own.get(path)
        if member is None:
            yield f"{path} is missing"
            continue
        if item.mode is not None and member.mode != item.mode:
            yield f"{path} has mode {member.mode:o}, and {item.mode:o} expected"
        yield from of_program(path, member.content, item.libs, base)


def of_program(path: str, content: bytes, libs: bool, base: set[str]) -> Iterator[str]:
    loader = elf.interpreter(content)
    if not content.startswith(ELF):
        yield f"{path} is no program"
    elif libs and loader is None:
        yield f"{path} is static, and a program with libraries expected"
    elif not libs and loader is not None:
        yield f"{path} needs {loader}, and a static program expected"
    elif loader is not None and loader not in base:
        yield f"{path} needs {loader}, which its base lacks"


def too_large(built: Built) -> list[str]:
    """That an image of a release has more bytes than it may have."""
    pushed = sum(one.pushed_bytes for one in built.layers)
    if pushed <= MOST_PUSHED_BYTES:
        return []
    return [f"it has {mib(pushed)} compressed, and {mib(MOST_PUSHED_BYTES)} are the most"]


def sizes(built: Built, base: int) -> str:
    """How large the layers are, the first `base` of them the base's; for people."""

    def of(layers: Sequence[Layer]) -> str:
        return (
            f"{mib(sum(one.tar_bytes for one in layers))} ({mib(sum(one.pushed_bytes for one in layers))} compressed)"
        )

    files = ", ".join(
        f"{PurePosixPath(path).name} {mib(len(member.content))}"
        for one in built.layers[base:]
        for path, member in sorted(one.members.items())
        if not member.is_dir
    )
    return f"{of(built.layers)}: base {of(built.layers[:base])}, programs {of(built.layers[base:])} with {files}"


def mib(size: int) -> str:
    return f"{size / (1 << 20):.1f} MiB"
