"""Owns the comparison of examples/aws/iam with the calls that the operator's programs made to the AWS stand-in in a run of the tests.

Called by `lab test` after the cluster's tests. The policies name the resources of a host's account and the tests have their own: what is
compared is the kind of a resource, such as the dead-letter queue, or the part of a key that a policy names. Pure but for reading log and
policies.
"""

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from urllib.parse import parse_qs, unquote

from . import awscalls
from .errors import LabError

# As AWS's SDK puts the name of a program into its requests.
APP = re.compile(r"\bapp/leaderboard-operator-([a-z-]+)")
# Name in the requests -> the policy of the role that has it.
PROGRAMS = {
    "controller": "controller",
    "bridge": "bridge",
    "workspace": "submission-worker",
    "logcopy": "submission-worker",
}
# It has a person's rights.
TESTS = "tests"
S3_SIGNED = re.compile(r"/s3/aws4_request\b")
# A request of S3 is its method and the first of these that is in its query; "": the bucket or the object itself.
S3: Mapping[tuple[str, str], str] = {
    ("GET", "list-type"): "list_objects_v2",
    ("GET", ""): "get_object",
    ("HEAD", ""): "head_object",
    ("PUT", "partNumber"): "upload_part",
    ("PUT", ""): "put_object",
    ("POST", "uploads"): "create_multipart_upload",
    ("POST", "uploadId"): "complete_multipart_upload",
    ("DELETE", ""): "delete_object",
    ("DELETE", "uploadId"): "abort_multipart_upload",
}
QUERIES = ("list-type", "partNumber", "uploads", "uploadId")
# Allowed and maybe not called in a run of the cluster's tests, and why it is allowed all the same.
RARE: Mapping[tuple[str, str], str] = {
    (
        "log-groups",
        "logs:DescribeLogGroups",
    ): "only with logs.cloudWatch.retentionDays, as tests/api/log_groups.rs has it",
    ("log-groups", "logs:CreateLogGroup"): "only with logs.cloudWatch.retentionDays, as tests/api/log_groups.rs has it",
    (
        "log-groups",
        "logs:PutRetentionPolicy",
    ): "only with logs.cloudWatch.retentionDays, as tests/api/log_groups.rs has it",
    (
        "submission-worker",
        "logs:GetLogEvents",
    ): "only after lines without an answer, as tests/api/pod/cloudwatch.rs has it",
    (
        "controller",
        "s3:AbortMultipartUpload",
    ): "only for a large file that fails, as crates/aws/src/archive/stream has it",
    ("submission-worker", "s3:AbortMultipartUpload"): "only for an upload in parts that fails, as tests/resume has it",
}


@dataclass(frozen=True, order=True)
class Call:
    """A request of one program: the method of a client that makes it, and what it is about."""

    program: str
    operation: str
    # Kind, and for an object its key and for a stream its name behind a slash.
    resource: str

    def text(self) -> str:
        return f"{self.program}: {self.operation} of {self.resource or 'nothing'}"


def call_of(method: str, path: str, query: str, headers: Mapping[str, str], body: bytes) -> Call | None:
    """A request to AWS; None: it is none of the operator's, or one that takes no right."""
    agent = APP.search(f"{headers.get('user-agent', '')} {headers.get('x-amz-user-agent', '')}")
    if agent is None or agent[1] == TESTS:
        return None
    target = headers.get("x-amz-target")
    if target:
        return Call(agent[1], awscalls.snake(target.rpartition(".")[2]), resource_of(body))
    if not S3_SIGNED.search(headers.get("authorization", "")):
        return None
    has = parse_qs(query, keep_blank_values=True)
    part = next((name for name in QUERIES if name in has), "")
    operation = S3.get((method, part), f"{method} {part}".strip())
    if operation == "upload_part" and "x-amz-copy-source" in headers:
        operation = "upload_part_copy"
    key = unquote(path).lstrip("/").partition("/")[2]
    about = f"object/{key}" if key else "bucket"
    return Call(agent[1], operation, about)


def resource_of(body: bytes) -> str:
    """What a request in JSON is about, by the members that AWS's services have for that."""
    try:
        members = json.loads(body or b"{}")
    except ValueError:
        return ""
    if "QueueUrl" in members:
        return "dead letters" if members["QueueUrl"].endswith("-dead") else "queue"
    if "TableName" in members:
        return "table"
    if "SecretId" in members:
        return "secret"
    if "logStreamName" in members:
        return f"stream/{members['logStreamName']}"
    return "group" if any(name.startswith("logGroupName") for name in members) else ""


def kind_of(arn: str) -> str:
    """The resources of a policy, as a pattern for those of calls."""
    if arn == "*":
        return "*"
    service, name = arn.split(":")[2], arn.split(":", 5)[5]
    match service:
        case "s3":
            _, slash, key = name.partition("/")
            return f"object/{key}" if slash else "bucket"
        case "sqs":
            return "dead letters" if name.endswith("-dead") else "queue"
        case "logs":
            _, _, stream = name.partition(":log-stream:")
            return f"stream/{stream}" if stream else "group"
        case "dynamodb":
            return "table"
        case "secretsmanager":
            return "secret"
    return service


def line_of(call: Call, time: str) -> str:
    return json.dumps({"time": time, **asdict(call)})


def read(log: Path, since: str) -> Iterator[Call]:
    """The calls from a time on: of the log, and of the one that was put aside before it."""
    for file in sorted(log.parent.glob(f"{log.name}*")):
        with file.open(encoding="utf-8", errors="replace") as lines:
            for line in lines:
                try:
                    entry = json.loads(line)
                except ValueError:
                    continue
                if entry.pop("time", "") >= since:
                    yield Call(**entry)


def differences(policies: Path, calls: Iterable[Call]) -> list[str]:
    """A sentence for each call that no policy of its program allows, and for each action that is allowed and was not called."""
    made = set(calls)
    silent = set(PROGRAMS) - {call.program for call in made}
    if silent:
        return [f"no call of {' and '.join(sorted(silent))} was recorded"]
    granted = {name: awscalls.actions(policies / f"{name}.json") for name in policies_of(PROGRAMS.values())}
    lines = [fault for call in sorted(made) for fault in refused(granted, call)]
    called = {
        (policy, action)
        for call in made
        for policy in policies_of([PROGRAMS.get(call.program, "")])
        for action in awscalls.ACTIONS.get(call.operation, ())
    }
    allowed = {(policy, action) for policy, rights in granted.items() for action, _ in rights}
    excused = RARE.keys() | awscalls.INDIRECT.keys()
    lines += [
        f"{policy} is allowed {action}, and no call was recorded that needs it (or say why in awsrecorded.py)"
        for policy, action in sorted(allowed - called - excused)
    ]
    lines += [
        f"an exception of awsrecorded.py that no policy has: {policy} {action}"
        for policy, action in sorted(RARE.keys() - allowed)
    ]
    return sorted(set(lines), key=lines.index)


def policies_of(names: Iterable[str]) -> list[str]:
    """Each program's own policy, and those that a host adds to it."""
    own = list(dict.fromkeys(names))
    return own + [policy for policy, of in awscalls.ADDED.items() if of in own]


def refused(granted: Mapping[str, Sequence[tuple[str, list[str]]]], call: Call) -> Iterator[str]:
    policy = PROGRAMS.get(call.program)
    if policy is None:
        yield f"{call.program}: a program that awsrecorded.py does not know"
        return
    if call.operation not in awscalls.ACTIONS:
        yield f"{call.text()}: no action in awscalls.py"
        return
    rights = [right for name in policies_of([policy]) for right in granted[name]]
    for action in awscalls.ACTIONS[call.operation]:
        kinds = [kind_of(arn) for name, arns in rights if name == action for arn in arns]
        if not any(fnmatchcase(call.resource, kind) for kind in kinds):
            yield f"{call.text()}: {action} is not allowed there"


def check(policies: Path, log: Path, since: str) -> str:
    """Compares both, the log from a time on; raises with what differs."""
    calls = set(read(log, since))
    faults = differences(policies, calls)
    if faults:
        raise LabError(f"examples/aws/iam: {'; '.join(faults)}")
    kinds = {(PROGRAMS[call.program], action) for call in calls for action in awscalls.ACTIONS[call.operation]}
    return f"examples/aws/iam: {len(kinds)} actions used, each allowed to its program; {len(RARE)} may be unused"
