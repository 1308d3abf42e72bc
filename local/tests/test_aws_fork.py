"""A program that is loaded once: each call has its own standard files, words, folder, variables and code."""

import os
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

from labkit import aws_fork

# In the place of AWS's program: counts its own calls, and ends as its first word says.
PROGRAM = """
import os, sys
from labkit import aws_fork
calls = []
def program():
    calls.append(1)
    variables = [os.environ.get(name) for name in ("A", "OWN")]
    print(len(calls), sys.argv, os.path.basename(os.getcwd()), variables, sys.stdin.read())
    print("err", file=sys.stderr)
    if sys.argv[1] == "raise":
        raise ValueError
    if sys.argv[1] == "exit":
        sys.exit("words")
    return int(sys.argv[1])
aws_fork.serve(sys.argv[1], program, {"OWN": "own"})
"""


class Calls(unittest.TestCase):
    def setUp(self) -> None:
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)
        env = {**os.environ, "PYTHONPATH": str(Path(aws_fork.__file__).parents[1]), "PYTHONDONTWRITEBYTECODE": "1"}
        argv = [sys.executable, "-c", PROGRAM, str(self.folder / "socket")]
        server = subprocess.Popen(argv, env=env, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        for cleanup in (server.stdout.close, server.wait, server.kill):
            self.addCleanup(cleanup)
        self.assertEqual(server.stdout.readline(), b"ready\n")
        self.client = self.folder / "aws"
        self.client.write_text(aws_fork.client(self.folder / "socket"))
        self.client.chmod(0o755)

    def call(self, *words: str, given: str = "", **env: str) -> subprocess.CompletedProcess[str]:
        argv = [str(self.client), *words]
        return subprocess.run(argv, cwd=self.folder, env=env, input=given, capture_output=True, text=True, check=False)

    def test_each_is_a_process_of_its_own(self) -> None:
        for code, given, variable in (("0", "a", "x"), ("3", "b" * 100_000, "y")):
            done = self.call(code, "two words", given=given, A=variable)
            shown = f"1 ['aws', '{code}', 'two words'] {self.folder.name} ['{variable}', 'own'] {given}\n"
            self.assertEqual((done.returncode, done.stdout, done.stderr), (int(code), shown, "err\n"))

    def test_what_a_program_raises_is_a_failure(self) -> None:
        self.assertEqual([self.call(word).returncode for word in ("raise", "exit")], [1, 1])
