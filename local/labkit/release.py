"""Owns the version, which stands in three places that must agree, and the manifest by which krew installs the plugin."""

import hashlib
import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from . import doccheck
from .errors import LabError

# Of the archives: what krew calls the machine, and how the program is called in it.
PLATFORMS = {
    "linux-amd64": ("linux", "amd64", "kubectl-leaderboard"),
    "linux-arm64": ("linux", "arm64", "kubectl-leaderboard"),
    "darwin-amd64": ("darwin", "amd64", "kubectl-leaderboard"),
    "darwin-arm64": ("darwin", "arm64", "kubectl-leaderboard"),
    "windows-amd64": ("windows", "amd64", "kubectl-leaderboard.exe"),
}


def version(repository: Path) -> str:
    """The version of programs and chart; raises unless all places have the same."""
    cargo = tomllib.loads((repository / "Cargo.toml").read_text())
    own: str = cargo["workspace"]["package"]["version"]
    apart = [member for member in (".", *cargo["workspace"]["members"]) if not shares(repository / member)]
    if apart:
        raise LabError(f"{', '.join(apart)} has a version of its own: write `version.workspace = true`")
    chart = (repository / "charts" / "leaderboard-operator" / "Chart.yaml").read_text()
    for key in ("version", "appVersion"):
        found = re.search(rf"^{key}: \"?([^\"\s]+)\"?$", chart, re.MULTILINE)
        if found is None or found[1] != own:
            raise LabError(
                f"Chart.yaml: {key} is {found[1] if found else 'missing'}, Cargo.toml says {own}: write that"
            )
    return own


def shares(member: Path) -> bool:
    return bool(tomllib.loads((member / "Cargo.toml").read_text())["package"]["version"] == {"workspace": True})


def owner(repository: Path) -> str:
    """The account on GitHub whose repository and registry the project is published in."""
    cargo = tomllib.loads((repository / "Cargo.toml").read_text())
    found = re.fullmatch(
        r"https://github\.com/([\w.-]+)/leaderboard-operator", cargo["workspace"]["package"]["repository"]
    )
    if found is None:
        raise LabError("Cargo.toml: repository is not https://github.com/OWNER/leaderboard-operator")
    return found[1]


def owned(name: str) -> re.Pattern[str]:
    """Where an account stands in a text: in an image, an address, the name of a team or of the repository."""
    own = re.escape(name)
    return re.compile(rf"(?<=ghcr\.io/){own}(?=[/#`])|(?:(?<=github\.com/)|(?<=[@ ])){own}(?=/leaderboard-operator)")


def set_owner(repository: Path, name: str) -> list[str]:
    """Writes another account wherever the present one stands; returns the files that it has changed."""
    if not re.fullmatch(r"[A-Za-z0-9](?:-?[A-Za-z0-9])*", name):
        raise LabError(f"{name} is no account of GitHub: it has letters, digits and single hyphens")
    pattern, changed = owned(owner(repository)), []
    for file in doccheck.tracked(repository):
        path = repository / file
        if path.is_symlink() or not path.is_file() or b"\0" in (content := path.read_bytes()):
            continue
        text = content.decode(errors="surrogateescape")
        # An image's name is in lower case.
        new = pattern.sub(lambda at: name.lower() if at.string[: at.start()].endswith("ghcr.io/") else name, text)
        if new != text:
            path.write_bytes(new.encode(errors="surrogateescape"))
            changed.append(file)
    return changed


def archive(release: str, platform: str) -> str:
    """The file name of the plugin for a machine."""
    return f"kubectl-leaderboard-{release}-{platform}.tar.gz"


def krew(release: str, base: str, sums: Mapping[str, str]) -> dict[str, Any]:
    """The manifest of the plugin. `base` is the address of the folder with the archives, `sums` their SHA-256 by name."""
    return {
        "apiVersion": "krew.googlecontainertools.github.com/v1alpha2",
        "kind": "Plugin",
        "metadata": {"name": "leaderboard"},
        "spec": {
            "version": f"v{release}",
            "shortDescription": "Explain, cancel and resume challenge submissions",
            "description": "Explains why a submission of leaderboard-operator waits, runs or failed, and cancels or resumes it.\n",
            "platforms": [platform(release, base.rstrip("/"), name, sums) for name in PLATFORMS],
        },
    }


def platform(release: str, base: str, name: str, sums: Mapping[str, str]) -> dict[str, Any]:
    system, machine, program = PLATFORMS[name]
    file = archive(release, name)
    if file not in sums:
        raise LabError(f"{file} is not among the given archives: krew needs one for each machine")
    return {
        "selector": {"matchLabels": {"os": system, "arch": machine}},
        "uri": f"{base}/{file}",
        "sha256": sums[file],
        "bin": program,
        "files": [{"from": name, "to": "."} for name in (program, "LICENSE")] + [{"from": "man1/*", "to": "man1"}],
    }


def krew_manifest(repository: Path, base: str, archives: Sequence[Path]) -> str:
    """The manifest as JSON, which is YAML too."""
    sums = {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in archives}
    return json.dumps(krew(version(repository), base, sums), indent=2)
