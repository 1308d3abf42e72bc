"""Owns the documents as a book: stages them with what they link to, builds them with mdBook, and checks each link of what comes out.

Called by `lab book` and `charttest`. The pages link to files outside of docs/, as they are read on a server of git; so the book's
source is a folder of the same shape with those files in it. Pages among them are chapters at the end.
"""

import os
import posixpath
import re
import shutil
import subprocess
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

from . import build, doccheck, tools
from .console import run_long, say
from .errors import LabError
from .settings import Settings

VERSION = "0.5.4"
# Without search, whose index is no part of what is checked. On two cores.
SECONDS = 40
SUMMARY = "docs/SUMMARY.md"
STAGED, BUILT = Path("target/book-source"), Path("target/book")
ENTRY = re.compile(r"\]\(([^)]+)\)")
COMPLAINT = re.compile(r"^\s*(?:\S+ )?(?:WARN|ERROR) .*$", re.MULTILINE)
# Pages that mdBook makes of others.
COPIES = ("print.html", "404.html", "toc.html")


def make(settings: Settings, search: bool = False) -> str:
    """Builds the book, with or without a search; raises with what mdBook complains about, and with links that lead nowhere."""
    program = ensure(settings, search)
    repository = settings.repository
    chapters = stage(repository, repository / STAGED)
    argv = [str(program), "build", str(repository)]
    done = subprocess.run(argv, capture_output=True, text=True, check=False)
    said = COMPLAINT.findall(done.stdout + done.stderr)
    if done.returncode != 0 or said:
        raise LabError(f"mdbook: {'; '.join(said) or done.stderr.strip()[-400:]}")
    faults = list(link_faults(repository / BUILT))
    if faults:
        raise LabError("; ".join(faults[:12]))
    return f"{chapters} chapters in {BUILT}"


def ensure(settings: Settings, search: bool) -> Path:
    """mdBook, built once, and once more for books with a search."""
    folder = settings.cache / f"mdbook-{VERSION}{'-search' if search else ''}"
    program = folder / "bin" / "mdbook"
    with tools.lock(settings.cache / "mdbook.lock", "mdBook"):
        if not program.exists():
            build.check_cargo()
            say(f"building mdBook, once ({SECONDS} s on two cores)")
            # Unoptimized: it is built longer than it ever runs.
            argv = ["cargo", "install", "--locked", "--debug", "--no-default-features", "--version", VERSION]
            argv += ["--features", "search"] if search else []
            env = {**os.environ, "CARGO_PROFILE_DEV_DEBUG": "0", "CARGO_TARGET_DIR": str(folder / "target")}
            log = settings.logs / "mdbook.log"
            run_long([*argv, "--root", str(folder), "mdbook"], "building mdBook", log, env=env, usual=SECONDS)
            shutil.rmtree(folder / "target")
    return program


def stage(repository: Path, source: Path) -> int:
    """Fills the book's source anew; returns how many chapters it has."""
    shutil.rmtree(source, ignore_errors=True)
    shutil.copytree(repository / "docs", source / "docs")
    others = [name for name in outside(repository) if name != "README.md"]
    for name in ["README.md", *others]:
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(repository / name, source / name)
    # The book has its table of contents at its side, and no page of it.
    readme = source / "README.md"
    readme.write_text(re.sub(rf"\[([^\]]*)\]\({SUMMARY}\)", r"\1", readme.read_text()))
    summary = (source / SUMMARY).read_text()
    (source / SUMMARY).unlink()
    rest = ENTRY.sub(in_source, summary.removeprefix("# Summary\n"))
    pages = [name for name in others if name.endswith(".md") and f"]({name})" not in rest]
    lines = [f"- [{title(repository / name)}]({name})" for name in pages]
    head = "# Summary\n\n[leaderboard-operator](README.md)\n"
    text = "\n".join([head + rest.rstrip(), "\n# Pages outside docs\n", *lines, ""])
    (source / "SUMMARY.md").write_text(text)
    return len(ENTRY.findall(text))


def in_source(entry: re.Match[str]) -> str:
    """An entry of the summary, as seen from the top of the source."""
    return f"]({posixpath.normpath(f'docs/{entry[1]}')})"


def title(page: Path) -> str:
    return doccheck.HEADING.findall(page.read_text())[0]


def outside(repository: Path) -> list[str]:
    """The files that the book's pages link to and that are not in docs/, and what the pages among them link to."""
    found: set[str] = set()
    todo = [repository / "README.md", *(repository / "docs").rglob("*.md")]
    while todo:
        page = todo.pop()
        for link in doccheck.LINK.findall(doccheck.CODE.sub("", doccheck.FENCE.sub("", page.read_text()))):
            target = (page.parent / link.partition("#")[0]).resolve()
            if re.match(r"[a-z]+:|#", link) or target.is_dir():
                continue
            name = target.relative_to(repository).as_posix()
            if name.startswith("docs/") or name in found:
                continue
            found.add(name)
            if target.suffix == ".md":
                todo.append(target)
    return sorted(found)


class Html(HTMLParser):
    """What a page links to, and the places in it."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.places: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value for name, value in attrs if value}
        self.links += [given[name] for name in ("href", "src") if name in given]
        self.places |= {given["id"]} if "id" in given else set()


def link_faults(built: Path) -> Iterator[str]:
    """Links within the book that lead nowhere."""
    pages = {file: Html(file.read_text()) for file in sorted(built.rglob("*.html")) if file.name not in COPIES}
    for file, page in pages.items():
        for link in page.links:
            target, _, place = link.partition("#")
            if re.match(r"[a-z]+:", link):
                continue
            to = (file.parent / unquote(target)).resolve() if target else file
            if not to.exists():
                yield f"{file.relative_to(built)}: {link} leads nowhere"
            elif place and to in pages and unquote(place) not in pages[to].places:
                yield f"{file.relative_to(built)}: {link}: there is no such place"
