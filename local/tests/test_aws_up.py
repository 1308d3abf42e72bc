"""examples/aws/up.sh: run by AWS's own program against the stand-in for AWS. Twice is once, and a dry run changes nothing.

The program is loaded once for more than a hundred calls.
"""

import json
import os
import re
import shutil
import signal
import subprocess
import tempfile
import unittest
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from labkit import aws_fork, pythonenv, settings

from .test_aws import AWS, stand_in

REPOSITORY = AWS.parents[1]
PATIENCE = 300
NAMES = {
    "<ACCOUNT_ID>": "000000000000",
    "<REGION>": "us-east-1",
    "<PARTICIPANTS_REGION>": "us-east-1",
    "<PREFIX>": "my-challenge",
    "<CHALLENGE>": "carla",
}
ALL = {
    "policy leaderboard-controller",
    "policy leaderboard-bridge",
    "policy leaderboard-submission-worker",
    "stack leaderboard-queue (queue)",
    "stack leaderboard-20 (leaderboard)",
    "stack leaderboard-registry (registry)",
    "entry evalai",
    "user evalai",
    "rights of the user evalai",
}


class Style(unittest.TestCase):
    def test_shellcheck_finds_nothing(self) -> None:
        program = pythonenv.ensure(settings.load(REPOSITORY), pythonenv.EXAMPLES) / "shellcheck"
        scripts = sorted(str(file) for file in (REPOSITORY / "examples").rglob("*.sh"))
        self.assertIn(str(AWS / "up.sh"), scripts)
        done = subprocess.run(
            [str(program), "--severity=warning", *scripts], capture_output=True, text=True, timeout=60, check=False
        )
        self.assertEqual(done.stdout + done.stderr, "")


class Up(unittest.TestCase):
    loaded: Path

    @classmethod
    def setUpClass(cls) -> None:
        folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(folder.cleanup)
        cls.loaded = Path(folder.name) / "aws"
        python = pythonenv.ensure(settings.load(REPOSITORY), pythonenv.EXAMPLES) / "python"
        env = {**os.environ, "PYTHONPATH": str(REPOSITORY / "local"), "PYTHONDONTWRITEBYTECODE": "1"}
        argv = [str(python), "-m", "labkit.aws_fork", str(cls.loaded)]
        server = subprocess.Popen(argv, env=env, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE)
        assert server.stdout
        for cleanup in (server.stdout.close, server.wait, server.kill):
            cls.addClassCleanup(cleanup)
        if server.stdout.readline() != b"ready\n":
            raise AssertionError("AWS's program could not be loaded, see above")

    def setUp(self) -> None:
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.home = Path(folder.name)
        shutil.copytree(AWS, self.home / "my-aws")
        for file in (self.home / "my-aws" / "iam").glob("*.json"):
            text = file.read_text()
            for name, value in NAMES.items():
                text = text.replace(name, value)
            file.write_text(text)
        (self.home / "token.json").write_text('{"auth_token": "first-token"}')
        (self.home / "bin").mkdir()
        client = self.home / "bin" / "client"
        client.write_text(aws_fork.client(self.loaded))
        # By the variable alone the program would ask SQS at AWS.
        wrapper = self.home / "bin" / "aws"
        wrapper.write_text(f'#!/bin/sh\nexec {client} --endpoint-url "$AWS_ENDPOINT_URL" "$@"\n')
        for program in (client, wrapper):
            program.chmod(0o755)

    @contextmanager
    def account(self) -> Iterator[dict[str, str]]:
        with stand_in() as environment:
            more = {
                "QUEUE_NAME": "challenge-1",
                "BUCKET_PREFIX": "my-challenge",
                "TOKEN_FILE": str(self.home / "token.json"),
            }
            yield {**environment, **more, "PATH": f"{self.home / 'bin'}:{os.environ['PATH']}"}

    def up(self, environment: Mapping[str, str], *words: str, code: int = 0) -> str:
        """Runs it in a session of its own, into a file: no program that it leaves behind can hold this test up."""
        argv = [str(self.home / "my-aws" / "up.sh"), *words]
        env = {key: value for key, value in os.environ.items() if not key.startswith("AWS_")} | dict(environment)
        with (self.home / "output").open("w+") as output:
            process = subprocess.Popen(
                argv,
                env=env,
                cwd=self.home,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                start_new_session=True,
            )
            try:
                ended = process.wait(PATIENCE)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
                ended = -1
            output.seek(0)
            said = output.read()
        self.assertEqual(ended, code, said)
        self.assertNotIn("first-token", said)
        self.assertNotIn("second-token", said)
        return said

    def did(self, said: str) -> dict[str, set[str]]:
        """What was made, updated and kept."""
        found: dict[str, set[str]] = {}
        for word, thing in re.findall(r"^(make|update|keep|skip) +(.+)$", said, re.MULTILINE):
            found.setdefault(word, set()).add(thing)
        return found

    def aws(self, environment: Mapping[str, str], *words: str) -> str:
        argv = [str(self.home / "bin" / "aws"), *words, "--output", "json"]
        env = {**os.environ, **environment}
        done = subprocess.run(argv, env=env, capture_output=True, text=True, timeout=60, check=True)
        return done.stdout

    def test_twice_is_once_and_a_change_is_taken_over(self) -> None:
        with self.account() as environment:
            said = self.up(environment, "--dry-run")
            self.assertEqual(self.did(said), {"make": ALL})
            self.assertIn("9 to change; nothing was changed.", said)
            self.assertEqual(self.did(self.up(environment)), {"make": ALL}, "the dry run has made nothing")
            again = self.up(environment)
            self.assertEqual(self.did(again), {"keep": ALL})
            self.assertIn("0 changed.", again)

            (self.home / "token.json").write_text('{"auth_token": "second-token"}')
            policy = self.home / "my-aws" / "iam" / "bridge.json"
            policy.write_text(policy.read_text().replace("challenge-1", "x").replace('"Version"', ' "Version"'))
            text = json.loads(policy.read_text())
            text["Statement"][0]["Sid"] = "Renamed"
            policy.write_text(json.dumps(text))
            template = self.home / "my-aws" / "cloudformation" / "registry.yaml"
            template.write_text(template.read_text().replace('"countNumber": 30', '"countNumber": 40'))
            changed = {"policy leaderboard-bridge", "entry evalai", "stack leaderboard-registry (registry)"}
            said = self.did(self.up(environment))
            self.assertEqual(said, {"update": changed, "keep": ALL - changed})
            secret = json.loads(self.aws(environment, "secretsmanager", "get-secret-value", "--secret-id", "evalai"))
            self.assertEqual(json.loads(secret["SecretString"]), {"auth_token": "second-token"})

    def test_what_the_pipeline_before_has_is_left_alone(self) -> None:
        with self.account() as environment:
            self.aws(environment, "sqs", "create-queue", "--queue-name", "challenge-1")
            self.aws(
                environment,
                "secretsmanager",
                "create-secret",
                "--name",
                "evalai",
                "--secret-string",
                '{"auth_token": "theirs"}',
            )
            given = {key: value for key, value in environment.items() if key != "TOKEN_FILE"}
            parts = ("queue", "token")
            first = self.did(self.up(given, *parts))
            queue = "queue challenge-1, which no stack of this folder has made"
            dead = "queue leaderboard-submissions-dead"
            self.assertEqual(first, {"keep": {queue, "entry evalai"}, "make": {dead}})
            self.assertEqual(self.did(self.up(given, *parts)), {"keep": {queue, dead, "entry evalai"}})
            found = json.loads(self.aws(given, "sqs", "list-queues"))["QueueUrls"]
            self.assertEqual(
                sorted(url.rpartition("/")[2] for url in found), ["challenge-1", "leaderboard-submissions-dead"]
            )

    def test_mistakes_are_found_before_anything_is_made(self) -> None:
        with self.account() as environment:
            self.assertIn("usage: ./up.sh", self.up(environment, "policy", code=2))
            (self.home / "token.json").write_text("first-token")
            self.assertIn("is not of the form", self.up(environment, "token", code=1))
            policy = self.home / "my-aws" / "iam" / "bridge.json"
            policy.write_text(policy.read_text().replace("000000000000", "<ACCOUNT_ID>"))
            self.assertIn("put your names in first", self.up(environment, code=1))
            self.assertEqual(
                json.loads(self.aws(environment, "iam", "list-policies", "--scope", "Local"))["Policies"], []
            )

    def test_without_a_token_the_rest_is_made(self) -> None:
        with self.account() as environment:
            given = {key: value for key, value in environment.items() if key != "TOKEN_FILE"}
            said = self.up(given, "token", "evalai")
            self.assertIn("TOKEN_FILE=token.json ./up.sh token", said)
            self.assertEqual(self.did(said)["make"], {"user evalai", "rights of the user evalai"})


if __name__ == "__main__":
    unittest.main()
