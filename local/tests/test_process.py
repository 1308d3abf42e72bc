"""Who is our process and who is not; start and stop of a real one."""

import os
import sys
import tempfile
import unittest
from dataclasses import replace
from pathlib import Path

from labkit import process
from labkit.process import Identity

# The name holds a blank and a bracket, as a name may.
STAT = "4242 (a) b) S 1 4242 4242 0 -1 4194560 1 0 0 0 0 0 0 0 20 0 1 0 987654 1000 10 18446744073709551615"
CMDLINE = b"/opt/etcd\0--name=x\0"
IDENTITY = Identity(pid=4242, start=987654, boot="boot-a", program="/opt/etcd", digest="d")


class Recognition(unittest.TestCase):
    def test_the_very_process_is_recognized(self) -> None:
        self.assertTrue(process.same(IDENTITY, STAT, CMDLINE, "boot-a"))

    def test_a_script_is_recognized_behind_its_interpreter(self) -> None:
        self.assertTrue(process.same(IDENTITY, STAT, b"/usr/bin/python3\0/opt/etcd\0", "boot-a"))

    def test_everything_else_is_not_ours(self) -> None:
        cases = {
            "the pid was given to a later process": (STAT.replace("987654", "987655"), CMDLINE, "boot-a"),
            "the machine was started again": (STAT, CMDLINE, "boot-b"),
            "another program": (STAT, b"/usr/bin/vim\0--name=x\0", "boot-a"),
            "our program's name as a late argument": (STAT, b"/bin/grep\0-r\0/opt/etcd\0", "boot-a"),
            "ended, not yet collected": (STAT.replace(") S ", ") Z "), CMDLINE, "boot-a"),
        }
        for name, (stat, cmdline, boot) in cases.items():
            with self.subTest(name):
                self.assertFalse(process.same(IDENTITY, stat, cmdline, boot))


class Pidfiles(unittest.TestCase):
    def test_a_torn_or_foreign_pidfile_is_none(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "x.pid"
            self.assertIsNone(process.read_pidfile(file))
            for text in ("", "1234\n", '{"pid": 1', '{"pid": 1}', '["pid"]', '{"pid": 1, "other": 2}'):
                file.write_text(text)
                self.assertIsNone(process.read_pidfile(file), text)


class Lifecycle(unittest.TestCase):
    def setUp(self) -> None:
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)
        self.pidfile = self.folder / "run" / "part.pid"

    def start(self, code: str) -> Identity:
        argv = [sys.executable, "-c", code]
        env = {"PATH": os.environ["PATH"]}
        log = self.folder / "part.log"
        child = process.start("part", argv, env=env, pidfile=self.pidfile, log=log, digest="first")
        self.addCleanup(child.wait)
        identity = process.read_pidfile(self.pidfile)
        assert identity is not None
        self.addCleanup(process.stop, identity, 0)
        self.assertEqual(identity.pid, child.pid)
        return identity

    def test_a_started_process_is_known_by_its_pidfile_until_it_is_stopped(self) -> None:
        identity = self.start("import time; time.sleep(600)")
        self.assertTrue(process.running(identity))
        self.assertEqual(identity.digest, "first")
        self.assertTrue(process.stop(identity, 20))
        self.assertFalse(process.running(identity))
        self.assertFalse(process.stop(identity, 20))

    def test_one_that_ignores_the_request_is_killed(self) -> None:
        ready = self.folder / "ready"
        code = f"import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); open({str(ready)!r}, 'w'); time.sleep(600)"
        identity = self.start(code)
        self.assertTrue(process.wait_until(ready.exists, 20))
        self.assertTrue(process.stop(identity, 0.1))
        self.assertFalse(process.running(identity))

    def test_one_that_is_killed_has_no_moment_to_prepare(self) -> None:
        ready, asked = self.folder / "ready", self.folder / "asked"
        code = f"""import signal, sys, time
signal.signal(signal.SIGTERM, lambda *_: (open({str(asked)!r}, 'w'), sys.exit()))
open({str(ready)!r}, 'w')
time.sleep(600)"""
        identity = self.start(code)
        self.assertTrue(process.wait_until(ready.exists, 20))
        self.assertTrue(process.kill(identity))
        self.assertFalse(process.running(identity))
        self.assertFalse(asked.exists())
        self.assertFalse(process.kill(identity))
        self.assertFalse(process.kill(None))

    def test_a_process_with_another_start_time_is_left_alone(self) -> None:
        identity = self.start("import time; time.sleep(600)")
        self.assertFalse(process.stop(replace(identity, start=identity.start + 1), 0))
        self.assertTrue(process.running(identity))

    def test_a_program_that_is_not_there_says_so_in_the_log(self) -> None:
        log = self.folder / "part.log"
        child = process.start("part", ["/nonexistent/program"], env={}, pidfile=self.pidfile, log=log, digest="")
        self.assertNotEqual(child.wait(), 0)
        self.assertFalse(process.running(process.read_pidfile(self.pidfile)))
        self.assertIn("/nonexistent/program", process.tail(log))

    def test_stopping_nothing_is_fine(self) -> None:
        self.assertFalse(process.stop(None, 0))


if __name__ == "__main__":
    unittest.main()
