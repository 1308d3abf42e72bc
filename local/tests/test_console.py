"""What a long command leaves behind: no process, and the end of its log where it failed."""

import os
import select
import subprocess
import sys
import tempfile
import unittest
from contextlib import redirect_stderr
from io import StringIO
from pathlib import Path
from unittest.mock import patch

from labkit import console
from labkit.errors import LabError

LOCAL = Path(__file__).resolve().parents[1]
# The lab with a long command, whose descendant holds the pipe of the second argument. It says there that it waits for it.
PROGRAM = """
import os, sys
from pathlib import Path
from labkit import cli, console
held, console.HEARTBEAT_SECONDS = int(sys.argv[2]), 0.1
waits = lambda _: os.write(held, b"waits") and ""
cli.run = lambda *_: console.run_long(
    ["sh", "-c", "sleep 600 & wait"], "it", Path(sys.argv[1]), keep=(held,), progress=waits, group=True
)
sys.exit(cli.main(Path(sys.argv[3]), ["status"]))
"""


class Interrupted(unittest.TestCase):
    def test_what_a_command_has_started_ends_with_it(self) -> None:
        """The grandchild holds the pipe's other end open until it ends."""
        with tempfile.TemporaryDirectory() as folder:
            reading, writing = os.pipe()
            log = Path(folder) / "log"

            def interrupt(_: str) -> str:
                raise KeyboardInterrupt

            with (
                patch.object(console, "HEARTBEAT_SECONDS", 0.2),
                self.assertRaises(KeyboardInterrupt),
            ):
                argv = ["sh", "-c", "sleep 600 & wait"]
                console.run_long(argv, "it", log, keep=(writing,), progress=interrupt, group=True)
            os.close(writing)
            self.assertTrue(select.select([reading], [], [], 10)[0], "what the command has started still runs")
            os.close(reading)

    def test_it_ends_too_when_the_lab_is_terminated(self) -> None:
        reading, writing = os.pipe()
        with tempfile.TemporaryDirectory() as folder:
            argv = [sys.executable, "-c", PROGRAM, f"{folder}/log", str(writing), str(LOCAL.parent)]
            lab = subprocess.Popen(argv, cwd=LOCAL, pass_fds=(writing,), stderr=subprocess.DEVNULL)
            os.close(writing)
            self.assertEqual(os.read(reading, 5), b"waits")
            lab.terminate()
            self.assertEqual(lab.wait(10), 143)
        left = b"waits"
        while select.select([reading], [], [], 10)[0] and (left := os.read(reading, 64)):
            self.assertEqual(left.replace(b"waits", b""), b"")
        self.assertEqual(left, b"", "what the command has started still runs")
        os.close(reading)


class Failed(unittest.TestCase):
    def fails(self, script: str) -> tuple[str, str]:
        """What is said of a shell script that fails, and the error."""
        said = StringIO()
        with tempfile.TemporaryDirectory() as folder, redirect_stderr(said), self.assertRaises(LabError) as error:
            console.run_long(["sh", "-c", script], "it", Path(folder) / "log")
        return said.getvalue(), str(error.exception)

    def test_the_end_of_the_log_is_shown(self) -> None:
        said, _ = self.fails("seq 100; echo; echo cause >&2; echo error; exit 3")
        lines = said.splitlines()
        self.assertRegex(lines[0], "^lab: the end of .*/log:$")
        self.assertEqual(len(lines), 1 + console.LAST_LINES)
        self.assertEqual(lines[-3:], ["  | 100", "  | cause", "  | error"])

    def test_nothing_is_shown_of_an_empty_log(self) -> None:
        self.assertEqual(self.fails("exit 1")[0], "")

    def test_the_reason_at_the_end_of_a_long_line_is_in_the_error(self) -> None:
        _, error = self.fails(f"echo 'Error: STEP {'x' * 300}: no space left'; exit 1")
        self.assertIn("failed with exit code 1 (Error: STEP x", error)
        self.assertIn("x: no space left)", error)
        self.assertNotIn("x" * 201, error)


if __name__ == "__main__":
    unittest.main()
