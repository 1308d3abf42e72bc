"""Owns the programs on the PATH of a page's shell. Runs as a program under each of their names.

It notes its words. kubectl and helm then run in earnest, with what keeps them from waiting for nodes that never come, and so do those
for which there is something that answers (`docanswers`); the others print what the next program of the line needs, and do nothing.
"""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

# kubectl itself starts it, for `kubectl leaderboard`.
PLUGIN = "kubectl-leaderboard"
# What a stand-in prints, by the first words; a number of times, then nothing.
MESSAGE = '{"Body": "{}", "ReceiptHandle": "handle"}'
PRINTS: dict[str, tuple[str, int]] = {
    "aws sqs get-queue-url": ("https://sqs.us-east-1.amazonaws.com/123456789012/queue", 99),
    "aws sqs receive-message --queue-url https://sqs.us-east-1.amazonaws.com/123456789012/queue --query": (MESSAGE, 2),
    "aws sqs receive-message": (f'{{"Messages": [{MESSAGE}]}}', 99),
    "aws sts get-caller-identity": ("123456789012", 99),
    # EvalAI's stand-in takes this token.
    "aws secretsmanager get-secret-value --secret-id evalai": ('{"auth_token": "local-host-token"}', 99),
    "aws ecr describe-repositories": ("challenge-participant-team-7", 99),
    "aws": ("stand-in", 99),
    "make --silent install-yaml": ("apiVersion: v1\nkind: ConfigMap\nmetadata: {name: installed}", 99),
    "docker create": ("0123456789ab", 99),
    PLUGIN: ("stand-in", 99),
}
# Behind these words, and behind `file://`, is the name of a file.
FILES = ("--values", "--config-file", "--template-file", "--file", "--decisions")
# Commands of the plugin that ask no cluster.
OFFLINE = ("completion", "man")
# What `leaderboard-operator import` prints, in the folder: docs/import.md shows it.
IMPORTED = "challenge.yaml"
# Added behind the words of kubectl, where the last of two flags counts.
BEHIND = {
    "delete": ["--dry-run=server", "--wait=false"],
    "wait": ["--timeout=1s"],
    "logs": ["--pod-running-timeout=1s"],
    "exec": ["--pod-running-timeout=1s"],
}
# helm waits for no Pod here. A release in another namespace would claim the same definitions.
INSTALLS = ("install", "upgrade")
OWN_NAMESPACE = "leaderboard-system"


def verb(words: Sequence[str]) -> str:
    """The first word behind the program that is no flag, and no value of `-n` or `--namespace`."""
    rest = list(words[1:])
    while rest and rest[0].startswith("-"):
        rest = rest[1:] if "=" in rest[0] else rest[2:]
    return rest[0] if rest else ""


def is_plugins(words: Sequence[str]) -> bool:
    return verb(words) == PLUGIN.partition("-")[2]


def variable(program: str) -> str:
    """What names the place of a program that runs in earnest."""
    return f"DOCUMENTS_{program.upper().replace('-', '_')}"


def changed(words: Sequence[str]) -> list[str] | None:
    """The words with which a program runs in earnest; None if it does not."""
    words, what = list(words), verb(words)
    if words[0] == "man" or (words[0] == PLUGIN and what in OFFLINE):
        return words
    if words[0] == "curl":
        return [*words, "--fail"]
    if words[0] == "kubectl" and is_plugins(words):
        return words
    if words[0] == "kubectl":
        at = words.index("--") if "--" in words else len(words)
        own = [word for word in words[:at] if word not in ("--watch", "-w")]
        return [*own, *BEHIND.get(what, []), *words[at:]]
    from_afar = any(word.startswith(("oci://", "https://")) for word in words)
    if words[0] == "helm" and what != "test" and not from_afar:
        words = [word for word in words if word != "--wait"]
        is_other = what in INSTALLS and OWN_NAMESPACE not in words
        # What one page removes, the next one asks for.
        more = ["--dry-run=client"] if is_other else ["--dry-run"] if what == "uninstall" else []
        return [*words, *more]
    return None


def missing(words: Sequence[str]) -> str:
    """The first file of a line that is not there; empty where all are."""
    behind = [word for option, word in zip(words, words[1:], strict=False) if option in FILES]
    behind += [word.removeprefix("file://") for word in words if word.startswith("file://")]
    return next((name for name in behind if not Path(name).exists()), "")


def printed(words: Sequence[str], folder: Path) -> str:
    """What a stand-in prints for these words now."""
    line = " ".join(words)
    if line.startswith("leaderboard-operator import --region"):
        return (folder / IMPORTED).read_text()
    begin = next((begin for begin in PRINTS if line.startswith(begin)), "")
    if not begin:
        return ""
    text, most = PRINTS[begin]
    counter = folder / f"printed-{list(PRINTS).index(begin)}"
    before = int(counter.read_text()) if counter.exists() else 0
    counter.write_text(str(before + 1))
    return f"{text}\n" if before < most else ""


def main(argv: Sequence[str]) -> int:
    """`argv[0]` is the program's path: its name shows which one it is."""
    words = [Path(argv[0]).name, *argv[1:]]
    folder = Path(os.environ["DOCUMENTS_FOLDER"])
    note = {"place": os.environ["DOCUMENTS_PLACE"], "words": words, "code": None, "error": ""}
    run = changed(words)
    program = os.environ.get(variable(words[0]))
    if run is None or program is None:
        if "--password-stdin" in words:
            sys.stdin.read()
        sys.stdout.write(printed(words, folder))
        name = missing(words)
        note |= {"error": f"there is no file {name}" if name else ""}
    else:
        # man starts others; kubectl is to find the plugin of this name alone.
        env = {**os.environ, "PATH": os.defpath} if words[0] == "man" else None
        done = subprocess.run([program, *run[1:]], env=env, capture_output=True, text=True, check=False)
        sys.stdout.write(done.stdout)
        note |= {"code": done.returncode, "error": done.stderr[-1000:]}
    # The plugin has noted itself.
    if note["code"] != 0 or not is_plugins(words):
        with (folder / "notes").open("a") as notes:
            notes.write(json.dumps(note) + "\n")
    return note["code"] or 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
