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
# What the pipeline before this one has in Secrets Manager.
SECRET = "aws secretsmanager get-secret-value --secret-id"
IMAGES = "123456789012.dkr.ecr.us-west-2.amazonaws.com"


def board(number: int) -> dict[str, str]:
    """The entry of a Leaderboard."""
    name = f"leaderboard-{number}"
    keys = ("name", "s3_bucket", "dynamodb_submissions_table", "cloudwatch_log_group")
    images = ("simulator", "leaderboard", "logcopy")
    return {**dict.fromkeys(keys, name), **{f"{image}_image": f"{IMAGES}/{image}-{number}:latest" for image in images}}


PHASES = {"4170": "10-sensors", "4171": "10-map", "4172": "20-sensors", "4173": "20-map"}
ENTRIES = {
    name: json.dumps(entry)
    for name, entry in {
        "evalai": {"auth_token": "local-host-token", "api_server": "https://eval.ai"},
        "evalai-tracks": {phase: f"leaderboard-{track}" for phase, track in PHASES.items()},
        "leaderboard-10": board(10),
        "leaderboard-20": board(20),
    }.items()
}


def answer(name: str) -> dict[str, str]:
    """What `aws` prints of an entry without its text."""
    return {"ARN": f"arn:aws:secretsmanager:us-west-2:123456789012:secret:{name}-Ab12Cd", "Name": name}


# A run of this operator that goes on, as `aws dynamodb scan` prints it.
ROW = {
    "team_id": {"S": "7"},
    "submission_id": {"S": "101"},
    "submission_status": {"S": "RUNNING"},
    "track_id": {"S": "4172"},
    "attempt": {"N": "2"},
}
# What a stand-in prints, by the first words; a number of times, then nothing.
MESSAGE = '{"Body": "{}", "ReceiptHandle": "handle"}'
PRINTS: dict[str, tuple[str, int]] = {
    "aws sqs get-queue-url": ("https://sqs.us-east-1.amazonaws.com/123456789012/queue", 99),
    "aws sqs receive-message --queue-url https://sqs.us-east-1.amazonaws.com/123456789012/queue --query": (MESSAGE, 2),
    "aws sqs receive-message": (f'{{"Messages": [{MESSAGE}]}}', 99),
    "aws sts get-caller-identity": ("123456789012", 99),
    f"{SECRET} evalai --query {{ARN: ARN, Name: Name}}": (json.dumps(answer("evalai")), 99),
    **{
        f"{SECRET} {name} --output json": (json.dumps({**answer(name), "SecretString": text}), 99)
        for name, text in ENTRIES.items()
    },
    # EvalAI's stand-in takes this token.
    f"{SECRET} evalai": (ENTRIES["evalai"], 99),
    "aws dynamodb scan --table-name leaderboard-20 --output json": (json.dumps({"Items": [ROW]}), 99),
    "aws ec2 describe-network-interfaces": ("192.168.255.5", 99),
    "aws ecr describe-repositories": ("challenge-participant-team-7", 99),
    # What examples/aws/up.sh reads as JSON.
    **{
        f"aws cloudformation describe-stacks --stack-name {name} --query Stacks[0].Parameters": ("[]", 99)
        for name in ("leaderboard-queue", "leaderboard-10", "leaderboard-20", "leaderboard-registry")
    },
    "aws iam get-policy-version": ("{}", 99),
    "aws iam get-user-policy": ("{}", 99),
    "aws": ("stand-in", 999),
    "make --silent install-yaml": ("apiVersion: v1\nkind: ConfigMap\nmetadata: {name: installed}", 99),
    "docker create": ("0123456789ab", 99),
    PLUGIN: ("stand-in", 99),
}
# Behind these words, and behind `file://`, is the name of a file.
FILES = ("--values", "--config-file", "--template-file", "--file")
# Commands of the plugin that ask no cluster.
OFFLINE = ("completion", "import", "man")
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


def as_started(words: Sequence[str]) -> list[str]:
    """A plugin's line as kubectl starts it, which `tests/api/plugin/rights.rs` shows: a hundred lines need no kubectl for that. Where flags
    come before the plugin's name, kubectl has to judge."""
    return [PLUGIN, *words[2:]] if list(words[:2]) == ["kubectl", "leaderboard"] else list(words)


def variable(program: str) -> str:
    """What names the place of a program that runs in earnest."""
    return f"DOCUMENTS_{program.upper().replace('-', '_')}"


def changed(words: Sequence[str]) -> list[str] | None:
    """The words with which a program runs in earnest; None if it does not."""
    words, what = list(words), verb(words)
    # In prose the name of the command stands alone.
    is_name = what == "import" and words[-1] == what
    if words[0] == "man" or (words[0] == PLUGIN and what in OFFLINE and not is_name):
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
    words = as_started([Path(argv[0]).name, *argv[1:]])
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
