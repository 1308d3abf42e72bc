"""Owns which calls to AWS each program can make, found in its source, and which rights they take.

Pure but for reading files. What AWS's services know as operations is handed in, so that no call can be overlooked.
"""

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

# Program -> the folders whose code it alone runs.
PROGRAMS: Mapping[str, tuple[str, ...]] = {
    "controller": ("src/runtime", "src/leaderboards", "src/submissions", "src/ask", "crates/evalai"),
    "bridge": ("src/bridge", "src/intake"),
    "submission-worker": ("crates/pod",),
}
# The crate with a module for each service.
SERVICES_FOLDER = "crates/aws/src"
# Operation, as a client's method -> the actions that IAM checks. The names of two in three differ.
ACTIONS: Mapping[str, tuple[str, ...]] = {
    "get_object": ("s3:GetObject",),
    "head_object": ("s3:GetObject",),
    "list_objects_v2": ("s3:ListBucket",),
    "put_object": ("s3:PutObject",),
    "delete_object": ("s3:DeleteObject",),
    "create_multipart_upload": ("s3:PutObject",),
    "upload_part": ("s3:PutObject",),
    "upload_part_copy": ("s3:GetObject", "s3:PutObject"),
    "complete_multipart_upload": ("s3:PutObject",),
    "abort_multipart_upload": ("s3:AbortMultipartUpload",),
    "describe_table": ("dynamodb:DescribeTable",),
    "get_item": ("dynamodb:GetItem",),
    "update_item": ("dynamodb:UpdateItem",),
    "get_secret_value": ("secretsmanager:GetSecretValue",),
    "receive_message": ("sqs:ReceiveMessage",),
    "delete_message_batch": ("sqs:DeleteMessage",),
    "change_message_visibility_batch": ("sqs:ChangeMessageVisibility",),
    "send_message": ("sqs:SendMessage",),
    "get_queue_attributes": ("sqs:GetQueueAttributes",),
    "create_log_stream": ("logs:CreateLogStream",),
    "put_log_events": ("logs:PutLogEvents",),
    "get_log_events": ("logs:GetLogEvents",),
    "describe_log_groups": ("logs:DescribeLogGroups",),
    "create_log_group": ("logs:CreateLogGroup",),
    "put_retention_policy": ("logs:PutRetentionPolicy",),
    # Of the roles' trust, not of a policy.
    "assume_role_with_web_identity": (),
}
# Granted although no call has this name, and why. By policy.
INDIRECT: Mapping[tuple[str, str], str] = {
    ("log-groups", "logs:TagResource"): "CloudWatch checks it when a group is made with tags",
    ("kms", "kms:Decrypt"): "S3 asks KMS with the caller's rights: to read, and to join parts",
    ("kms", "kms:GenerateDataKey"): "S3 asks KMS with the caller's rights: to store",
}
# Policies that a host adds to a program's own where they are needed.
ADDED = {"log-groups": "controller"}
SERVICES = ("s3", "sqs", "dynamodb", "logs", "secretsmanager", "sts")
FUNCTION = re.compile(r"^ *(?:pub(?:\([a-z]+\))? )?(?:async )?fn (\w+)", re.MULTILINE)
METHOD = re.compile(r"\.(\w+)\(\)")
OWN_METHOD = re.compile(r"\bself\s*\.(\w+)\(")
ARCHIVE_METHOD = re.compile(r"\barchive\s*\.(\w+)\(")
ACTION = re.compile(r"\b(?:s3|sqs|dynamodb|logs|secretsmanager|ecr|kms):[A-Z]\w+\b")
TESTS = re.compile(r"^#\[cfg\(test\)\].*", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Calls:
    """What one function does: operations, and the methods of its own type that it uses."""

    operations: frozenset[str] = frozenset()
    methods: frozenset[str] = frozenset()


@dataclass
class Source:
    """The operator's source, and the operations that AWS's services have."""

    repository: Path
    operations: frozenset[str]
    texts: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        sources = [*(self.repository / "src").rglob("*.rs"), *(self.repository / "crates").glob("*/src/**/*.rs")]
        for file in sorted(sources):
            if "tests" not in file.stem and "tests" not in file.parts:
                name = str(file.relative_to(self.repository))
                self.texts[name] = TESTS.sub("", file.read_text())

    def below(self, folder: str) -> str:
        """The text of a folder, or of a module with its folder."""
        return "\n".join(text for name, text in self.texts.items() if name.startswith((f"{folder}/", f"{folder}.rs")))

    def operations_of(self, text: str) -> frozenset[str]:
        return frozenset(self.operations & set(METHOD.findall(text)))

    def services(self) -> dict[str, frozenset[str]]:
        """Module of the services' crate -> its operations; those without any are left out."""
        own = [
            name.removeprefix(f"{SERVICES_FOLDER}/") for name in self.texts if name.startswith(f"{SERVICES_FOLDER}/")
        ]
        names = {Path(name).parts[0].removesuffix(".rs") for name in own}
        found = {name: self.operations_of(self.below(f"{SERVICES_FOLDER}/{name}")) for name in names}
        return {name: operations for name, operations in found.items() if operations}

    def archive(self) -> dict[str, Calls]:
        """Method of `Archive` -> what it does itself."""
        text = self.below(f"{SERVICES_FOLDER}/archive")
        starts = [(match.start(), match[1]) for match in FUNCTION.finditer(text)]
        ends = [start for start, _ in starts[1:]] + [len(text)]
        parts = {name: text[start:end] for (start, name), end in zip(starts, ends, strict=True)}
        return {
            name: Calls(self.operations_of(part), frozenset(OWN_METHOD.findall(part))) for name, part in parts.items()
        }

    def of_program(self, program: str) -> frozenset[str]:
        """The operations that a program can ask for."""
        text = "\n".join(self.below(folder) for folder in PROGRAMS[program])
        found = set(self.operations_of(text))
        for service, operations in self.services().items():
            uses = re.search(rf"\bleaderboard_aws::(?:\{{[^}}]*\b)?{service}\b", text)
            if uses and service != "archive":
                found |= operations
        return frozenset(found | closure(self.archive(), set(ARCHIVE_METHOD.findall(text))))


def snake(name: str) -> str:
    return re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()


def closure(functions: Mapping[str, Calls], methods: set[str]) -> set[str]:
    """The operations of methods, and of those that they use."""
    found: set[str] = set()
    seen: set[str] = set()
    while methods - seen:
        name = (methods - seen).pop()
        seen.add(name)
        calls = functions.get(name, Calls())
        found |= calls.operations
        methods = methods | calls.methods
    return found


def actions(policy: Path) -> list[tuple[str, list[str]]]:
    """Each action that a policy allows, with its resources."""
    found: list[tuple[str, list[str]]] = []
    for statement in json.loads(policy.read_text())["Statement"]:
        resources = as_list(statement.get("Resource", []))
        found += [(action, resources) for action in as_list(statement["Action"])]
    return found


def as_list(value: str | list[str]) -> list[str]:
    return [value] if isinstance(value, str) else value


def faults(source: Source, folder: Path) -> Iterator[str]:
    """What is called and not allowed, or allowed and not called, by policy; and calls that the table does not have."""
    everything = {program: source.of_program(program) for program in PROGRAMS}
    all_operations = source.operations_of("\n".join(source.texts.values()))
    yield from (f"{name}: no action in awscalls.py" for name in sorted(all_operations - ACTIONS.keys()))
    nobodys = all_operations - frozenset().union(*everything.values())
    signed = {name for name, text in source.texts.items() if "aws_sigv4" in text}
    yield from (f"{name} signs requests, which the list of operations does not show" for name in sorted(signed))
    yield from (f"{name}: no program that awscalls.py knows calls it" for name in sorted(nobodys))
    for program, operations in everything.items():
        policies = [program, *(policy for policy, of in ADDED.items() if of == program)]
        allowed = {name: {action for action, _ in actions(folder / f"{name}.json")} for name in policies}
        called = {action for name in operations for action in ACTIONS.get(name, ())}
        indirect = {action for policy, action in INDIRECT if policy in policies}
        granted = set().union(*allowed.values())
        yield from (f"{program} calls {action}, and no policy allows it" for action in sorted(called - granted))
        yield from (
            f"{program} is allowed {action} and never calls it" for action in sorted(granted - called - indirect)
        )
        yield from (
            f"{program}: {action} has a reason and no policy allows it" for action in sorted(indirect - granted)
        )
        yield from (f"{program}: {action} is allowed twice" for action in sorted(twice(list(allowed.values()))))


def twice(sets: list[set[str]]) -> set[str]:
    return {action for one in sets for action in one if sum(action in other for other in sets) > 1}
