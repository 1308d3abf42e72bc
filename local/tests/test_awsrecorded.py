"""Calls that the AWS stand-in has recorded, and what of them the policies allow; by made-up requests and policies."""

import asyncio
import json
import tempfile
import unittest
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from labkit import aws_recorder, awscalls, awsrecorded
from labkit.awsrecorded import PROGRAMS, RARE, Call

POLICIES = Path(__file__).resolve().parents[2] / "examples" / "aws" / "iam"
SIGNED = "AWS4-HMAC-SHA256 Credential=test/20261123/us-east-1/s3/aws4_request, SignedHeaders=host"


def agent(program: str) -> dict[str, str]:
    return {"x-amz-user-agent": f"aws-sdk-rust/1.3.14 ua/2.1 api/s3/1.112.0 app/leaderboard-operator-{program}"}


def s3(method: str, path: str, query: str = "", **headers: str) -> Call | None:
    more = {name.replace("_", "-"): value for name, value in headers.items()}
    return awsrecorded.call_of(method, path, query, {**agent("logcopy"), "authorization": SIGNED, **more}, b"")


def json_call(program: str, target: str, members: Mapping[str, object]) -> Call | None:
    headers = {**agent(program), "x-amz-target": target}
    return awsrecorded.call_of("POST", "/", "", headers, json.dumps(members).encode())


@contextmanager
def policies(**actions: dict[str, list[str]]) -> Iterator[Path]:
    """Policies by name, each with the resources of its actions; and the exceptions, which must be allowed."""
    named = {name: dict(actions.get(name.replace("-", "_"), {})) for name in awsrecorded.policies_of(PROGRAMS.values())}
    for policy, action in RARE:
        named[policy].setdefault(action, ["*"])
    with tempfile.TemporaryDirectory() as folder:
        for name, rights in named.items():
            statements = [{"Action": action, "Resource": resources} for action, resources in rights.items()]
            (Path(folder) / f"{name}.json").write_text(json.dumps({"Statement": statements}))
        yield Path(folder)


QUEUE = "arn:aws:sqs:<REGION>:<ACCOUNT_ID>:leaderboard-submissions"
OWNER = "arn:aws:s3:::<PREFIX>-leaderboard-20/*/logcopy/owner"
OBJECTS = "arn:aws:s3:::<PREFIX>-leaderboard-20/*"
SOME = {
    "controller": {"s3:PutObject": [OWNER]},
    "bridge": {"sqs:ReceiveMessage": [QUEUE]},
    "submission_worker": {"s3:GetObject": [OBJECTS]},
}
MADE = [
    Call("controller", "put_object", "object/one/77/logcopy/owner"),
    Call("bridge", "receive_message", "queue"),
    Call("workspace", "get_object", "object/one/77/logcopy/owner"),
    Call("logcopy", "head_object", "object/one/77/logcopy/report.json"),
]


class Requests(unittest.TestCase):
    def test_a_request_of_s3_is_the_call_that_makes_it(self) -> None:
        for method, path, query, operation, resource in (
            ("GET", "/b/one/77/a%20b.json", "x-id=GetObject", "get_object", "object/one/77/a b.json"),
            ("GET", "/b", "list-type=2&prefix=one%2F", "list_objects_v2", "bucket"),
            ("GET", "/b/", "list-type=2", "list_objects_v2", "bucket"),
            ("HEAD", "/b/k", "", "head_object", "object/k"),
            ("PUT", "/b/k", "x-id=PutObject", "put_object", "object/k"),
            ("PUT", "/b/k", "partNumber=2&uploadId=u", "upload_part", "object/k"),
            ("POST", "/b/k", "uploads", "create_multipart_upload", "object/k"),
            ("POST", "/b/k", "uploadId=u", "complete_multipart_upload", "object/k"),
            ("DELETE", "/b/k", "uploadId=u", "abort_multipart_upload", "object/k"),
            ("DELETE", "/b/k", "", "delete_object", "object/k"),
            ("POST", "/b", "delete", "POST", "bucket"),
        ):
            self.assertEqual(s3(method, path, query), Call("logcopy", operation, resource), (method, path, query))
        copy = s3("PUT", "/b/k", "partNumber=2&uploadId=u", x_amz_copy_source="b/k")
        self.assertEqual(copy, Call("logcopy", "upload_part_copy", "object/k"))

    def test_a_request_in_json_says_its_call_and_what_it_is_about(self) -> None:
        for target, members, operation, resource in (
            ("AmazonSQS.ReceiveMessage", {"QueueUrl": "http://q/1/submissions"}, "receive_message", "queue"),
            ("AmazonSQS.SendMessage", {"QueueUrl": "http://q/1/submissions-dead"}, "send_message", "dead letters"),
            ("DynamoDB_20120810.UpdateItem", {"TableName": "t"}, "update_item", "table"),
            ("secretsmanager.GetSecretValue", {"SecretId": "evalai"}, "get_secret_value", "secret"),
            (
                "Logs_20140328.PutLogEvents",
                {"logGroupName": "g", "logStreamName": "77/a"},
                "put_log_events",
                "stream/77/a",
            ),
            ("Logs_20140328.DescribeLogGroups", {"logGroupNamePrefix": "g"}, "describe_log_groups", "group"),
        ):
            self.assertEqual(json_call("controller", target, members), Call("controller", operation, resource))

    def test_what_others_ask_is_no_call_of_a_program(self) -> None:
        target = {"x-amz-target": "AmazonSQS.ReceiveMessage"}
        for headers in ({"user-agent": "Boto3/1.43"}, agent("tests"), {}):
            self.assertIsNone(awsrecorded.call_of("POST", "/", "", {**headers, **target}, b"{}"), headers)
        # A question to STS.
        self.assertIsNone(awsrecorded.call_of("POST", "/", "", agent("logcopy"), b"Action=AssumeRoleWithWebIdentity"))

    def test_the_stand_in_writes_down_what_it_answers(self) -> None:
        lines: list[str] = []
        answered: list[bytes] = []

        async def app(scope: Any, receive: Callable[[], Awaitable[Any]], send: object) -> None:
            while scope["type"] == "http":
                message = await receive()
                answered.append(message["body"])
                if not message["more_body"]:
                    return

        parts = [b'{"QueueUrl": "http://q/1', b'/submissions"}']

        async def receive() -> Any:
            return {"type": "http.request", "body": parts.pop(0), "more_body": bool(parts)}

        headers = {**agent("bridge"), "X-Amz-Target": "AmazonSQS.ReceiveMessage"}
        pairs = [(name.encode(), value.encode()) for name, value in headers.items()]
        scope = {"type": "http", "method": "POST", "path": "/", "query_string": b"", "headers": pairs}
        recorded = aws_recorder.recording(app, lines.append)
        asyncio.run(recorded(scope, receive, None))
        asyncio.run(recorded({"type": "lifespan"}, receive, None))
        self.assertEqual(b"".join(answered), b'{"QueueUrl": "http://q/1/submissions"}')
        with tempfile.TemporaryDirectory() as folder:
            log = Path(folder) / "calls.jsonl"
            log.write_text("\n".join([*lines, "half a li"]))
            old = Call("bridge", "send_message", "queue")
            (Path(folder) / "calls.jsonl.1").write_text(awsrecorded.line_of(old, "2026-01-01T00:00:00.000000Z"))
            self.assertEqual(list(awsrecorded.read(log, "2026-06-01")), [Call("bridge", "receive_message", "queue")])
            self.assertIn(old, list(awsrecorded.read(log, "")))


class Differences(unittest.TestCase):
    def test_what_is_called_and_allowed_is_no_difference(self) -> None:
        with policies(**SOME) as folder:
            self.assertEqual(awsrecorded.differences(folder, MADE), [])

    def test_a_call_that_its_programs_policy_does_not_allow_is_named(self) -> None:
        with policies(**SOME) as folder:
            for call, part in (
                (
                    Call("controller", "put_object", "object/one/77/evalai/stdout.txt"),
                    "s3:PutObject is not allowed there",
                ),
                (Call("bridge", "receive_message", "dead letters"), "sqs:ReceiveMessage is not allowed there"),
                (Call("bridge", "get_object", "object/k"), "s3:GetObject is not allowed there"),
                (Call("logcopy", "list_objects_v2", "bucket"), "s3:ListBucket is not allowed there"),
                (Call("logcopy", "DELETE", "object/k"), "no action in awscalls.py"),
                (Call("plugin", "get_object", "object/k"), "does not know"),
            ):
                (fault,) = awsrecorded.differences(folder, [*MADE, call])
                self.assertIn(part, fault)
                self.assertIn(call.program, fault)

    def test_an_action_that_nothing_needs_is_named_unless_there_is_a_reason(self) -> None:
        more = {**SOME, "bridge": {**SOME["bridge"], "sqs:DeleteMessage": [QUEUE]}}
        with policies(**more) as folder:
            (fault,) = awsrecorded.differences(folder, MADE)
            self.assertIn("bridge is allowed sqs:DeleteMessage", fault)
            self.assertEqual(
                awsrecorded.differences(folder, [*MADE, Call("bridge", "delete_message_batch", "queue")]), []
            )
        with policies(**SOME) as folder:
            (folder / "log-groups.json").write_text('{"Statement": []}')
            faults = awsrecorded.differences(folder, MADE)
        self.assertEqual(len(faults), sum(policy == "log-groups" for policy, _ in RARE))
        self.assertTrue(all(RARE.values()))

    def test_a_log_without_one_of_the_programs_is_no_success(self) -> None:
        with policies(**SOME) as folder:
            self.assertEqual(awsrecorded.differences(folder, MADE[:3]), ["no call of logcopy was recorded"])

    def test_every_resource_of_the_policies_has_a_kind(self) -> None:
        kinds = {
            awsrecorded.kind_of(arn).partition("/")[0]
            for name in awsrecorded.policies_of(PROGRAMS.values())
            for _, arns in awscalls.actions(POLICIES / f"{name}.json")
            for arn in arns
        }
        self.assertEqual(kinds, {"object", "bucket", "queue", "dead letters", "table", "secret", "stream", "group"})


if __name__ == "__main__":
    unittest.main()
