"""Owns the making of images from files of this machine, and their way into the registry; without a container engine.

Called by `lab image` and by `lab up` (the pause image).
"""

import os
import platform
import subprocess
import sys
import sysconfig
import tempfile
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from . import elf, layer, pythonenv, pythonimage, tools
from .aws import create_repositories
from .console import say
from .errors import LabError
from .image_spec import FileSpec, ImageSpec, parse
from .settings import Settings, without_proxy

# The registry is on this machine: no proxy is asked.
DIRECT = urllib.request.build_opener(urllib.request.ProxyHandler({}))
ARCHITECTURES = {"x86_64": "amd64", "aarch64": "arm64"}


@dataclass(frozen=True)
class Search:
    """Where binaries are looked for: names given by hand, else cargo's target folder."""

    given: Mapping[str, Path]
    target: Path
    profile: str

    def candidates(self, name: str) -> list[Path]:
        """The places where cargo may have put a binary, newest first."""
        folder = "debug" if self.profile == "dev" else self.profile
        triple = f"{platform.machine()}-unknown-linux-gnu"
        places = [
            self.target / folder / name,
            self.target / triple / folder / name,
            self.target / triple / "release" / name,
        ]
        return sorted((place for place in places if place.is_file()), key=lambda place: -place.stat().st_mtime)


def make(settings: Settings, file: Path, search: Search, archive: Path | None) -> list[str]:
    """Builds the images of a file and pushes those that the registry lacks, or writes them into `archive` (one image only).

    Returns the pushed references, `registry/repository:tag@digest`.
    """
    found = specs(file)
    if archive is not None:
        if len(found) != 1:
            raise LabError(f"--tar takes a file with one image, and {file.name} has {len(found)}")
        built = build(settings, found[0], search)
        archive.write_bytes(layer.archive(built, found[0].name))
        return [f"{found[0].name}@{built.digest}"]
    return push_all(settings, found, search)


def specs(file: Path) -> list[ImageSpec]:
    """The images that a file describes."""
    try:
        return list(parse(file.read_text(), file.name))
    except OSError as error:
        raise LabError(f"{file} can't be read: {error.strerror}") from error


def push_all(settings: Settings, specs: Sequence[ImageSpec], search: Search) -> list[str]:
    """Builds images and pushes those that the registry lacks; returns their references."""
    check_registry(settings)
    create_repositories(settings, sorted({spec.repository for spec in specs}))
    crane = tools.ensure(settings, ["crane"]) / "crane"
    return [push(settings, crane, spec, build(settings, spec, search)) for spec in specs]


def check_registry(settings: Settings) -> None:
    try:
        DIRECT.open(f"{settings.aws_endpoint}/v2/", timeout=5).close()
    except urllib.error.HTTPError:
        return
    except OSError as error:
        raise LabError(f"no registry answers at {settings.registry}: run `local/lab up` first") from error


def push(settings: Settings, crane: Path, spec: ImageSpec, image: layer.Image) -> str:
    """Pushes an image unless the registry's tag has that very digest already."""
    reference = f"{settings.registry}/{spec.name}"
    pinned = f"{reference}@{image.digest}"
    if stored_digest(settings, spec) == image.digest:
        say(f"{spec.name} is in the registry already")
        return pinned
    with tempfile.TemporaryDirectory(prefix="leaderboard-image-") as folder:
        for path, content in layer.layout(image, reference).items():
            place = Path(folder) / path
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_bytes(content)
        argv = [str(crane), "push", "--insecure", folder, reference]
        done = subprocess.run(argv, env=without_proxy(os.environ), capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise LabError(f"pushing {reference} failed ({done.stderr.strip()[-300:]}); see `local/lab status`")
    if stored_digest(settings, spec) != image.digest:
        raise LabError(
            f"the registry changed {reference} on its way: run `local/lab down`, `local/lab up` and push again"
        )
    say(f"pushed {spec.name} ({sum(len(image.blobs[one]) for one in image.layers) / 1e6:.1f} MB)")
    return pinned


def stored_digest(settings: Settings, spec: ImageSpec) -> str | None:
    """The digest that the registry has for the image's tag."""
    url = f"{settings.aws_endpoint}/v2/{spec.repository}/manifests/{spec.tag}"
    request = urllib.request.Request(url, method="GET", headers={"Accept": layer.MANIFEST_TYPE})
    try:
        with DIRECT.open(request, timeout=30) as answer:
            return f"sha256:{layer.sha256(answer.read())}"
    except OSError:
        return None


def build(settings: Settings, spec: ImageSpec, search: Search) -> layer.Image:
    entries = [layer.Entry(item.path, item.mode, uid=item.uid, gid=item.gid) for item in spec.dirs]
    for item in spec.files:
        if item.kind != "python":
            entries += file_entries(settings, item, search, spec.name)
    entries += [layer.Entry(item.to, 0o777, target=item.target) for item in spec.symlinks]
    below = [python(settings, item) for item in spec.files if item.kind == "python"]
    return layer.build(entries, run_config(spec), architecture(), *below)


def python(settings: Settings, item: FileSpec) -> layer.Packed:
    """The layer of an entry that speaks of Python. Equal ones are one layer, which node and registry have once."""
    site = Path(sysconfig.get_path("purelib", vars={"base": str(pythonenv.ensure(settings).parent)}))
    return pythonimage.packed(site, tuple(name for name in item.value.split(",") if name), item.to)


def architecture() -> str:
    return ARCHITECTURES.get(platform.machine(), platform.machine())


def run_config(spec: ImageSpec) -> dict[str, object]:
    """The part of the image's configuration that defines how it is run; what is empty is left out."""
    default_path = {"PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"}
    values: dict[str, object] = {
        "Env": [f"{key}={value}" for key, value in sorted((default_path | dict(spec.env)).items())],
        "Entrypoint": list(spec.entrypoint),
        "Cmd": list(spec.cmd),
        "User": spec.user,
        "WorkingDir": spec.workdir,
    }
    return {key: value for key, value in values.items() if value}


def file_entries(settings: Settings, item: FileSpec, search: Search, image: str) -> Iterator[layer.Entry]:
    """What one entry of `files` puts into the layer: a file, its libraries, or a whole folder."""
    if item.kind == "text":
        yield layer.Entry(
            item.to, 0o644 if item.mode is None else item.mode, item.value.encode(), uid=item.uid, gid=item.gid
        )
        return
    if item.kind == "made":
        yield from made(settings, item, image)
        return
    source = locate(settings, item, search, image)
    if source.is_dir():
        yield from folder_entries(source, item)
        return
    content = source.read_bytes()
    if item.libs:
        for library in elf.libraries(source):
            yield layer.Entry(str(library), 0o755, library.read_bytes())
    elif item.kind == "bin" and elf.interpreter(content) is not None:
        raise LabError(f"{image}: {source} needs shared libraries: add libs = true to its entry, or build it static")
    mode = item.mode if item.mode is not None else 0o755 if os.access(source, os.X_OK) else 0o644
    yield layer.Entry(item.to, mode, content, uid=item.uid, gid=item.gid)


def made(settings: Settings, item: FileSpec, image: str) -> Iterator[layer.Entry]:
    """What a Python program of the repository writes into the folder that is its only argument, or a part of that."""
    program, _, part = item.value.partition(" ")
    with tempfile.TemporaryDirectory(prefix="leaderboard-made-") as folder:
        argv = [sys.executable, str(settings.repository / program), folder]
        done = subprocess.run(argv, capture_output=True, text=True, check=False)
        written = Path(folder) / part
        if done.returncode != 0 or not written.is_dir():
            raise LabError(f"{image}: {program} writes no folder {part!r} ({done.stderr.strip()[-300:]})")
        yield from folder_entries(written, item)


def locate(settings: Settings, item: FileSpec, search: Search, image: str) -> Path:
    """The file or folder of this machine that an entry speaks of."""
    if item.kind == "host":
        place = Path(item.value)
    elif item.kind == "repo":
        place = settings.repository / item.value
    elif item.value in search.given:
        place = search.given[item.value]
    else:
        found = search.candidates(item.value)
        # A program that shall run without libraries is the static one, though a dynamic one may be newer.
        static = [path for path in found if elf.interpreter(path.read_bytes()) is None]
        chosen = found if item.libs else static or found
        if not chosen:
            raise LabError(
                f"{image}: no binary {item.value} is built below {search.target}: run "
                f"`cargo build --profile {search.profile}`, or give --bin {item.value}=PATH"
            )
        return chosen[0]
    if not place.exists():
        raise LabError(f"{image}: {place} does not exist")
    return place


def folder_entries(source: Path, item: FileSpec) -> Iterator[layer.Entry]:
    """A folder with everything below it; links stay links. `mode` is for its files."""
    for root, folders, names in os.walk(source):
        folders.sort()
        inside = Path(item.to) / Path(root).relative_to(source)
        yield layer.Entry(str(inside), 0o755, uid=item.uid, gid=item.gid)
        for name in sorted(names + [one for one in folders if (Path(root) / one).is_symlink()]):
            place = Path(root) / name
            to = str(inside / name)
            if place.is_symlink():
                yield layer.Entry(to, 0o777, target=os.readlink(place), uid=item.uid, gid=item.gid)
            else:
                usual = 0o755 if os.access(place, os.X_OK) else 0o644
                mode = usual if item.mode is None else item.mode
                yield layer.Entry(to, mode, place.read_bytes(), uid=item.uid, gid=item.gid)


def write_pause(program: Path, name: str, archive: Path) -> None:
    """Writes the image that holds a Pod's namespaces open, as an archive for containerd."""
    image = layer.build(
        [layer.Entry("/pause", 0o755, program.read_bytes())], {"Entrypoint": ["/pause"]}, architecture()
    )
    archive.parent.mkdir(parents=True, exist_ok=True)
    archive.write_bytes(layer.archive(image, f"docker.io/{name}"))


def target_folder(repository: Path, env: Mapping[str, str]) -> Path:
    """cargo's target folder."""
    return Path(env.get("CARGO_TARGET_DIR") or repository / "target").absolute()


def given_binaries(pairs: Sequence[str]) -> dict[str, Path]:
    """The values of `--bin NAME=PATH`."""
    given = {}
    for pair in pairs:
        name, equals, path = pair.partition("=")
        if not equals or not Path(path).is_file():
            raise LabError(f"--bin {pair} must be NAME=PATH with an existing file")
        given[name] = Path(path).absolute()
    return given
