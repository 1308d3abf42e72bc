"""Owns the build of the repository's Dockerfile on this machine, and the check of what comes of it.

Called by `lab test` and `lab dockerfile`. No registry of images is asked: a stand-in for each base image is made of what the machine has.
That of the compiler's image is an empty one into which the machine's own compilers are mounted; that of the runtime's is the image of
`operator-image.toml` without its programs. What cargo has built here goes into the caches of the build, so that it need not compile
the crates of others again; the operator's own are compiled each time.
"""

import hashlib
import os
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from . import build, elf, engine, enginecheck, image, layer, release
from .console import say, seconds
from .engine import Engine, volumes
from .errors import LabError
from .image_spec import ImageSpec, parse
from .settings import Settings

BUILD, BASE, BUILT = "localhost/stand-in/build:1", "localhost/stand-in/base:1", "localhost/leaderboard-operator:test"
# Given to the build, and printed by the program in the image.
REVISION = "0123abc"
# What the Dockerfile keeps between builds.
REGISTRY, TARGET = "/usr/local/cargo/registry", "/src/target"
CACHES = f"--mount=type=cache,target={REGISTRY} --mount=type=cache,target={TARGET}"
TOOLCHAIN = "/usr/local/toolchain"
# Where compilers, linkers and C libraries are, and nothing that a build has no use for.
TOP = ("bin", "lib", "lib32", "lib64", "libx32", "sbin")
USR = (*TOP, "include", "libexec")
# The crates of this repository begin so; what cargo has of them is of another tree, or of an older one.
OWN = "leaderboard-"
# With nothing of the tree's target folder in its caches.
USUAL_MINUTES = {"local": 5, "release": 25}


def run(settings: Settings, profile: str) -> None:
    """Builds the Dockerfile with cargo's `profile` and checks the image."""
    engine.ensure(settings)
    # Its libraries are those of the image's base.
    build.programs(settings)
    spec = parse((settings.local / "operator-image.toml").read_text(), "operator-image.toml")[0]
    with engine.opened(settings) as own:
        work = own.storage / "work"
        work.mkdir()
        mounts = {**machine_mounts(Path("/")), sysroot(settings): TOOLCHAIN}
        load(own, build_image(Path("/"), cargo_home(os.environ)), BUILD, work)
        base = base_image(settings, spec)
        load(own, base, BASE, work)
        started = time.monotonic()
        warm(settings, own, profile, mounts, work)
        say(f"the caches of the build are warm ({seconds(time.monotonic() - started)})")
        make(settings, own, profile, mounts)
        own.layout(BUILT, work / "layout")
        built = enginecheck.read(work / "layout")
        found = enginecheck.faults(built, [plain_digest(base)], spec)
        if profile == "release":
            found += enginecheck.too_large(built)
        if found:
            raise LabError(f"the image of the Dockerfile: {'; '.join(found)}")
        try_programs(settings, own, spec)
        say(f"the image of the Dockerfile is as expected, {enginecheck.sizes(built, 1)}")


def make(settings: Settings, own: Engine, profile: str, mounts: Mapping[Path, str]) -> None:
    """Builds the Dockerfile of the repository as it is."""
    arguments = {"BUILD_IMAGE": BUILD, "BASE_IMAGE": BASE, "REVISION": REVISION, **selection(profile)}
    options = [word for name, value in arguments.items() for word in ("--build-arg", f"{name}={value}")]
    started = time.monotonic()
    say(f"building the Dockerfile (from nothing {USUAL_MINUTES.get(profile, 25)} min, else a minute)")
    root = settings.repository
    log = settings.logs / "dockerfile.log"
    own.build(root / "Dockerfile", root, BUILT, [*options, *volumes(mounts)], "building the Dockerfile", log)
    say(f"the Dockerfile is built ({seconds(time.monotonic() - started)})")


def selection(profile: str) -> dict[str, str]:
    """Arguments of the Dockerfile for cargo: what is built in the profile of the tests has their choice of packages, and so the features
    with which all dependencies are compiled already. A release has the Dockerfile's own choice."""
    packages = {"PACKAGES": " ".join(build.SELECTION)} if profile == build.PROFILE else {}
    return {"PROFILE": profile, **packages}


def try_programs(settings: Settings, own: Engine, spec: ImageSpec) -> None:
    """Runs the programs of the image in it: they print which build they are."""
    version = release.version(settings.repository)
    printed = {"leaderboard-operator": f"leaderboard-operator {version} ({REVISION})"}
    for item in enginecheck.programs(spec):
        name = Path(item.to).name
        expected = printed.get(name, f"{name} {version}")
        line = own.output(BUILT, [item.to, "--version"])
        if line != expected:
            raise LabError(f"the image of the Dockerfile: {name} --version prints {line!r}, and {expected!r} expected")


def plain_digest(made: layer.Image) -> str:
    return enginecheck.read_layer(made.blobs[made.layer]).digest


def load(own: Engine, made: layer.Image, name: str, work: Path) -> None:
    archive = work / f"{made.manifest}.tar"
    archive.write_bytes(layer.archive(made, name))
    own.load(archive, name)
    archive.unlink()


def base_image(settings: Settings, spec: ImageSpec) -> layer.Image:
    """What the runtime's image has: C library, authorities, users. How it is run is for the Dockerfile to say."""
    nothing = image.Search({}, Path(), "")
    entries = [layer.Entry(item.path, item.mode, uid=item.uid, gid=item.gid) for item in spec.dirs]
    for item in spec.files:
        if item.kind != "bin":
            entries += image.file_entries(settings, item, nothing, spec.name)
        elif item.libs:
            libraries = elf.libraries(build.program(settings, item.value))
            entries += [layer.Entry(str(library), 0o755, library.read_bytes()) for library in libraries]
    return layer.build(entries, {"Env": image.run_config(spec)["Env"]}, image.architecture())


def build_image(root: Path, home: Path) -> layer.Image:
    """The compiler's image without its compilers, which are mounted. cargo's home is named as here: cargo compiles a crate again
    whose source has another path."""
    links = [layer.Entry(f"/{place}", 0o777, target=os.readlink(root / place)) for place in system(root, links=True)]
    if str(home / "registry") != REGISTRY:
        links.append(layer.Entry(str(home / "registry"), 0o777, target=REGISTRY))
    env = {
        "PATH": f"{TOOLCHAIN}/bin:/usr/local/bin:/usr/bin:/bin",
        "CARGO_HOME": str(home),
        "CARGO_NET_OFFLINE": "true",
        "CARGO_TERM_COLOR": "never",
    }
    entries = [layer.Entry("/tmp", 0o1777), layer.Entry(REGISTRY, 0o755), *links]
    return layer.build(entries, {"Env": [f"{key}={value}" for key, value in env.items()]}, image.architecture())


def machine_mounts(root: Path) -> dict[Path, str]:
    """The machine's folders with a C compiler: place on the machine -> place in the build."""
    places = [*system(root, links=False), *(["etc/alternatives"] if (root / "etc/alternatives").is_dir() else [])]
    config = cargo_home(os.environ) / "config.toml"
    own = {config: str(config)} if config.is_file() else {}
    return {**{root / place: f"/{place}" for place in places}, **own}


def system(root: Path, links: bool) -> list[str]:
    """Of the machine's folders of programs and libraries those that are links, or those that are not."""
    places = [*TOP, *(f"usr/{name}" for name in USR)]
    return [place for place in places if (root / place).is_dir() and (root / place).is_symlink() == links]


def cargo_home(env: Mapping[str, str]) -> Path:
    return Path(env.get("CARGO_HOME") or Path(env.get("HOME") or Path.home()) / ".cargo").absolute()


def sysroot(settings: Settings) -> Path:
    """The folder of the compiler that cargo uses in this repository."""
    return Path(rustc(settings, "--print", "sysroot"))


def rustc(settings: Settings, *arguments: str) -> str:
    build.check_cargo()
    argv = ["rustc", *arguments]
    done = subprocess.run(argv, cwd=settings.repository, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise LabError(f"rustc {' '.join(arguments)} failed: {done.stderr.strip()[-300:]}")
    return done.stdout.strip()


def warm(settings: Settings, own: Engine, profile: str, mounts: Mapping[Path, str], work: Path) -> None:
    """Fills the caches of the build from cargo's folders of this machine, unless a build before has; of own crates nothing stays."""
    mark = own.caches / "key"
    key = cache_key(settings, profile)
    target = image.target_folder(settings.repository, os.environ)
    options = volumes({**mounts, cargo_home(os.environ) / "registry": "/warm/registry", target: "/warm/target"})
    if mark.exists() and mark.read_text() == key:
        try:
            in_caches(settings, own, [], options, work)
            return
        except LabError as error:
            # They are copies: whatever broke them, new ones are as good.
            say(f"the caches of the build are thrown away and filled anew: {error}")
    engine.forget(own)
    # What the image's build finds of others in its caches, it need not compile.
    build.released_runner(settings)
    built = [folder for folder in folders(profile) if (target / folder / "deps").is_dir()]
    in_caches(settings, own, seed(built), options, work)
    mark.write_text(key)


def in_caches(settings: Settings, own: Engine, commands: Sequence[str], options: Sequence[str], work: Path) -> None:
    """Runs commands in a build that has the caches, then removes there what cargo knows of own crates."""
    clean = f"rm -rf {TARGET}/*/.fingerprint/{OWN}* {TARGET}/*/*/.fingerprint/{OWN}*"
    context = work / "warm"
    context.mkdir(exist_ok=True)
    file = context / "Dockerfile"
    file.write_text(f"FROM {BUILD}\nRUN {CACHES} {' && '.join([*commands, clean])}\n")
    log = settings.logs / "dockerfile-caches.log"
    own.build(file, context, "localhost/warm:1", options, "filling the caches of the build", log)


def cache_key(settings: Settings, profile: str) -> str:
    """What the crates of others are compiled from."""
    lock = (settings.repository / "Cargo.lock").read_bytes()
    words = [rustc(settings, "--version", "--verbose"), *selection(profile).values(), str(cargo_home(os.environ))]
    return hashlib.sha256(lock + "\n".join(words).encode()).hexdigest()


def folders(profile: str) -> list[str]:
    """Those of the target folder that the Dockerfile's two builds use."""
    return list(dict.fromkeys([profile, "release", f"{build.triple()}/release"]))


def seed(built: list[str]) -> list[str]:
    """Shell commands that copy what cargo has downloaded and compiled here: libraries and build scripts, no programs."""
    commands = [f"cp -a /warm/registry/. {REGISTRY}/"]
    for folder in built:
        to = f"{TARGET}/{folder}"
        commands += [
            f"mkdir -p {to}/deps",
            f"cd /warm/target/{folder}",
            f"cp -a .fingerprint build {to}/",
            # A compiler that was interrupted leaves a folder with files of such names.
            rf"find deps -maxdepth 1 \( -name 'lib*' -o -name '*.d' \) -exec cp -a -t {to}/deps {{}} +",
        ]
    return commands
