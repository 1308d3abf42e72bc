"""Owns whether what the documents show can be typed: each command runs in a shell, page by page.

Called by `charttest`. The shell is bash with nothing on its PATH but standard tools and stand-ins (`docprograms`). kubectl and helm run
in earnest, against an API server without nodes, and curl against EvalAI's stand-in (`docanswers`); every other program is noted with
its words, which are then held against what is known of it: AWS's models, the Makefile, `local/lab`, the repository's files. The
operator's own parsers read the words of its two programs: `tests/support/pages.rs`. `docpages` reads the pages, `docscene` has the
manifests.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from . import docanswers, docpages, docprograms, docscene, pythonenv
from .docpages import Block
from .errors import LabError
from .kube import Kube
from .settings import Settings

# What a line may use besides the programs below.
TOOLS = [
    "bash",
    "awk",
    "cat",
    "chmod",
    "cp",
    "cut",
    "env",
    "grep",
    "jq",
    "mkdir",
    "python3",
    "rm",
    "sed",
    "sha256sum",
    "sh",
    "shred",
    "sleep",
    "touch",
    "tr",
]
# Noted, and held against nothing but the files that they name.
ELSEWHERE = {
    "cosign": "needs a release that is signed",
    "curl": "needs curl; runs where the machine has it",
    "docker": "needs a container engine",
    "eksctl": "needs AWS",
    "gh": "needs a release",
    "man": "needs man-db; runs where the machine has it",
    "oras": "needs a registry",
}
# Blocks that nobody types, by what they begin with.
NOT_TYPED = {
    'set -e\n: "${': "the command of an init container, which contractcheck.py compares with the Job",
    "kubectl logs -c private-contents": "named as what no longer works",
    "aws s3 sync": "the name of a command",
    "kubectl describe workloads": "Kueue's own kind is not here",
    "helm upgrade --wait": "the name of an option",
}
# Answers to a line that is right, of a server without nodes and without the object.
ANSWERS = re.compile(
    r"\(NotFound\): pods |\(AlreadyExists\)|already exists|timed out waiting|Metrics API not available"
    r"|release: not found"
)
MAY_MISS = {"create", "exec", "get --raw", "logs", "top", "uninstall", "wait"}
# What stands for what the reader puts in.
PLACEHOLDERS = {
    "<name>": "sample",
    "<pod>": "sample",
    "NAMESPACE": "leaderboard",
    "NAME": "sample",
    "POD": "sample",
    "ID": "7",
    "KIND": "submissions",
    "REGISTRY": "registry.example",
    "REGION": "us-east-1",
    "arn:aws:iam::…:role/…": "arn:aws:iam::123456789012:role/a",
}
PATIENCE = 180


@dataclass(frozen=True)
class Note:
    """One program that a page's shell has started: from which block, with which words, and what came of it if it ran."""

    place: str
    words: tuple[str, ...]
    code: int | None
    error: str

    @property
    def program(self) -> str:
        return self.words[0]

    def __str__(self) -> str:
        return f"{self.place}: {' '.join(self.words)[:100]}"


def check(settings: Settings, kube: Kube) -> str:
    """Everything, on an API server with nothing on it; raises with what is wrong."""
    found = docpages.of_repository(settings.repository)
    docscene.prepare(settings.repository, kube)
    applied, faults = docscene.manifests(settings.repository, kube, found)
    with (
        tempfile.TemporaryDirectory(prefix="leaderboard-documents-") as folder,
        docanswers.running(settings, Path(folder)) as more,
    ):
        notes, said = typed(settings.repository, Kube(kube.tools, {**kube.env, **more}), Path(folder), found)
    faults += [*said, *judged(notes), *of_words(settings, notes)]
    if faults:
        raise LabError("; ".join(faults[:12]))
    counts = Counter(how(note) for note in notes)
    return ", ".join(f"{counts[name]} {name}" for name in sorted(counts)) + f"; {applied} manifests taken"


def how(note: Note) -> str:
    """How far a command was tried."""
    if note.code is not None:
        return "commands run" if note.code == 0 else "answered"
    # helm that asks a registry, or waits for a Pod.
    return "for elsewhere" if note.program in {*ELSEWHERE, "helm"} else "parsed"


def typed(repository: Path, kube: Kube, folder: Path, found: Sequence[Block]) -> tuple[list[Note], list[str]]:
    """Types each page into a shell of its own; gives what was started, and what the shells report against it."""
    faults: list[str] = []
    programs = folder / "programs"
    programs.mkdir()
    install(programs)
    (folder / "notes").touch()
    for number, page in enumerate(dict.fromkeys(block.page for block in found)):
        home = folder / str(number)
        furnish(repository, home)
        script = text([block for block in found if block.page == page])
        script = script.replace(docanswers.EVALAI, kube.env.get("DOCUMENTS_EVALAI", docanswers.EVALAI))
        script = script.replace(f"/queues/{docanswers.PLACEHOLDER}/", f"/queues/{docanswers.QUEUE}/")
        env = {
            **kube.env,
            "PATH": str(programs),
            "HOME": str(home / "home"),
            "MANPATH": str(home / "home" / ".local" / "share" / "man"),
            "MANPAGER": "cat",
            "KUBE_EDITOR": "/bin/true",
            "PYTHONPATH": str(repository / "local"),
            # Hundreds of starts: none is to compile what it runs.
            "PYTHONPYCACHEPREFIX": str(folder / "compiled"),
            "DOCUMENTS_FOLDER": str(folder),
            "DOCUMENTS_KUBECTL": str(kube.tools / "kubectl"),
            "DOCUMENTS_HELM": str(kube.tools / "helm"),
        }
        argv = [str(programs / "bash"), "-c", script]
        with (folder / "said").open("w+") as said:
            try:
                shell = {
                    "cwd": home,
                    "env": env,
                    "stdin": subprocess.DEVNULL,
                    "stdout": subprocess.DEVNULL,
                    "stderr": said,
                }
                subprocess.run(argv, **shell, timeout=PATIENCE, check=False)
            except subprocess.TimeoutExpired:
                faults.append(f"{page}: its commands did not end within {PATIENCE} s")
            said.seek(0)
            faults += [f"{page}: the shell says: {line.strip()}" for line in said if line.strip()]
    lines = (folder / "notes").read_text().splitlines()
    notes = [Note(one["place"], tuple(one["words"]), one["code"], one["error"]) for one in map(json.loads, lines)]
    return notes, faults


def install(programs: Path) -> None:
    """Standard tools, and a stand-in under each other name."""
    for name in TOOLS:
        found = sys.executable if name == "python3" else shutil.which(name)
        if found is None:
            raise LabError(f"{name} is missing, which the documents use: apt-get install {name}")
        (programs / name).symlink_to(found)
    stand_in = programs / "stand-in"
    stand_in.write_text(f'#!{shutil.which("bash")}\nexec python3 -S -m labkit.docprograms "$0" "$@"\n')
    stand_in.chmod(0o755)
    for name in ("kubectl", "helm", "aws", "cargo", "make", "leaderboard-operator", docprograms.PLUGIN, *ELSEWHERE):
        (programs / name).symlink_to("stand-in")


def furnish(repository: Path, home: Path) -> None:
    """A folder like the repository's, as far as the pages name it, that may be changed; and the files that they have the reader make."""
    (home / "home" / "bin").mkdir(parents=True)
    shutil.copytree(repository / "examples", home / "examples")
    shutil.copy(repository / docscene.EXAMPLE, home / "examples" / "aws" / "my-leaderboard-20.yaml")
    for name in ("charts", "Dockerfile"):
        (home / name).symlink_to(repository / name)
    (home / "examples" / "aws" / "token.json").write_text('{"auth_token": "a-token"}')
    (home / "predictions.csv").write_text("id,category\n")
    (home / "values.yaml").write_text("namespaces: [leaderboard]\n")
    (home / "local").mkdir()
    (home / "local" / "quickstart").symlink_to(repository / "local" / "quickstart")
    for script in ("local/lab", "examples/contents/check.sh", "examples/participants/try.sh"):
        (home / script).unlink(missing_ok=True)
        (home / script).symlink_to(home.parent / "programs" / "stand-in")


def text(blocks: Sequence[Block]) -> str:
    """The script of a page. Each block is noted in the environment, where its programs find it."""
    lines = []
    for block in blocks:
        if block.language not in ("sh", "span") or block.text.startswith(tuple(NOT_TYPED)):
            continue
        lines += [f"export DOCUMENTS_PLACE='{block.place}'", filled(block.text)]
    return "\n".join(lines)


def filled(line: str) -> str:
    for name, value in PLACEHOLDERS.items():
        # Not within `QUEUE_NAME`, nor where the line itself replaces `<REGION>`.
        line = re.sub(rf"(?<![\w<]){name}(?![\w>])", value, line)
    return line


def judged(notes: Sequence[Note]) -> Iterator[str]:
    """Lines that kubectl or helm refuses, and files that are not there."""
    for note in notes:
        if note.code is None and note.error:
            yield f"{note}: {note.error}"
        verb = docprograms.verb(note.words) + (" --raw" if "--raw" in note.words else "")
        is_answer = verb in MAY_MISS and ANSWERS.search(note.error)
        if note.code and not is_answer:
            yield f"{note}: {note.error.strip()[-200:]}"


def of_words(settings: Settings, notes: Sequence[Note]) -> Iterator[str]:
    """Lines whose words are not right, of the programs that did not run."""
    yield from aws_faults(settings, [note for note in notes if note.program == "aws"])
    targets = set(re.findall(r"^([a-z-]+):", (settings.repository / "Makefile").read_text(), re.MULTILINE))
    for note in notes:
        words = note.words[1:]
        if note.program == "make":
            yield from (
                f"{note}: no target {word}" for word in words if not re.match("-|.*=", word) and word not in targets
            )
        elif note.program == "lab" and not re.search(
            rf'add_parser\(\s*"{words[0]}"', (settings.local / "labkit" / "cli.py").read_text()
        ):
            yield f"{note}: no command {words[0]}"
        elif note.program in ("check.sh", "try.sh"):
            (script,) = (settings.repository / "examples").rglob(note.program)
            known = script.read_text()
            yield from (f"{note}: no option {word}" for word in words if word.startswith("--") and word not in known)
        elif note.program == "cargo":
            yield from cargo_faults(settings.repository, note)
        elif note.program == "docker":
            yield from docker_faults(settings.repository, note)


def aws_faults(settings: Settings, notes: Sequence[Note]) -> Iterator[str]:
    """By AWS's own models. A line of prose may leave options out."""
    env = {**os.environ, "PYTHONPATH": str(settings.local), "PYTHONDONTWRITEBYTECODE": "1"}
    argv = [str(pythonenv.ensure(settings) / "python"), "-m", "labkit.awscommands"]
    given = json.dumps([note.words[1:] for note in notes])
    done = subprocess.run(argv, env=env, input=given, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise LabError(f"awscommands.py failed: {done.stderr.strip()[-300:]}")
    for note, faults in zip(notes, json.loads(done.stdout), strict=True):
        is_prose = note.place.endswith(docpages.PROSE)
        yield from (f"{note}: {fault}" for fault in faults if not (is_prose and fault.endswith(" is missing")))


def cargo_faults(repository: Path, note: Note) -> Iterator[str]:
    """Packages, folders and tests that are not there."""
    options = dict(zip(note.words, note.words[1:], strict=False))
    packages = {
        re.search(r'^name = "(.+)"', file.read_text(), re.MULTILINE)[1]: file.parent for file in manifests(repository)
    }
    folder = packages.get(options.get("-p", "leaderboard-operator"), repository / "nowhere")
    paths = [folder, repository / options.get("--path", "")]
    paths += [folder / "tests" / f"{options['--test']}.rs"] if "--test" in options else []
    yield from (f"{note}: there is no {path}" for path in paths if not path.exists())


def manifests(repository: Path) -> list[Path]:
    return [repository / "Cargo.toml", *sorted((repository / "crates").glob("*/Cargo.toml"))]


def docker_faults(repository: Path, note: Note) -> Iterator[str]:
    """Targets that the file of a build lacks."""
    options = dict(zip(note.words, note.words[1:], strict=False))
    # That of the folder which is built, unless another one is named.
    named = options.get("--file", f"{note.words[-1]}/Dockerfile")
    # The reader's own copy of an example.
    file = repository / named.replace("my-challenge/", "examples/challenges/guessing-game/")
    if "--target" in options and f" AS {options['--target']}\n" not in file.read_text():
        yield f"{note}: {file.name} has no target {options['--target']}"
