"""A part of the cluster is killed and comes back, and only one that was recorded as ours."""

import sys
import tempfile
import unittest
import warnings
from pathlib import Path
from unittest import mock

from labkit import cluster, crash, process, settings
from labkit.components import Component
from labkit.errors import LabError

SLEEPS = [sys.executable, "-c", "import time; time.sleep(600)"]


class Crash(unittest.TestCase):
    def setUp(self) -> None:
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        # The lab ends before its parts, and leaves them to run.
        self.enterContext(warnings.catch_warnings())
        warnings.simplefilter("ignore", ResourceWarning)
        self.lab = settings.load(Path("/srv/repo"), {"HOME": folder.name, "LEADERBOARD_LAB_STATE": folder.name})
        self.lab.pki.mkdir()
        (self.lab.pki / "ca.crt").write_text("of nobody")
        self.parts = [Component(name, SLEEPS, lambda: True) for name in ("kube-apiserver", "kubelet")]
        # What belongs to a machine with a cluster; the processes are real.
        for place in ("cluster.check_machine", "cluster.await_cluster", "tools.ensure"):
            self.patch(place, None)
        self.patch("pythonenv.ensure", Path("/venv"))
        self.patch("cluster.parts_of", self.parts)

    def patch(self, place: str, value: object) -> None:
        patch = mock.patch(f"labkit.{place}", return_value=value)
        patch.start()
        self.addCleanup(patch.stop)

    def identity(self, name: str) -> process.Identity:
        identity = process.read_pidfile(self.lab.run / f"{name}.pid")
        assert identity is not None
        return identity

    def start_all(self) -> None:
        for part in self.parts:
            cluster.ensure_started(self.lab, part)
            self.addCleanup(self.end, part.name)

    def end(self, name: str) -> None:
        process.kill(self.identity(name))

    def test_the_part_alone_is_killed_and_runs_again_as_before(self) -> None:
        self.start_all()
        killed, other = self.identity("kubelet"), self.identity("kube-apiserver")
        with mock.patch("labkit.crash.say") as said:
            crash.crash(self.lab, "kubelet", 0)
        self.assertFalse(process.running(killed))
        again = self.identity("kubelet")
        self.assertTrue(process.running(again))
        self.assertEqual((again.program, again.digest), (killed.program, killed.digest))
        self.assertNotEqual(again.pid, killed.pid)
        self.assertTrue(process.running(other))
        self.assertEqual(self.identity("kube-apiserver"), other)
        (line,) = said.call_args.args
        self.assertIn(f"kubelet (pid {killed.pid}) was killed, started again after 0 s", line)

    def test_what_can_t_be_crashed_names_what_can(self) -> None:
        for name in ("containerd", "aws", "", "../etcd"):
            with self.assertRaisesRegex(LabError, "name one of kube-apiserver, etcd, kubelet$"):
                crash.crash(self.lab, name, 0)
        with self.assertRaisesRegex(LabError, "--away -1 .* 0 or more"):
            crash.crash(self.lab, "etcd", -1)

    def test_without_a_cluster_the_next_step_is_to_start_one(self) -> None:
        with self.assertRaisesRegex(LabError, "etcd does not run: start the cluster with .*lab up"):
            crash.crash(self.lab, "etcd", 0)

    def test_a_pid_that_was_given_to_another_process_is_left_alone(self) -> None:
        self.start_all()
        stranger = self.identity("kubelet")
        file = self.lab.run / "kubelet.pid"
        text = file.read_text()
        file.write_text(text.replace(str(stranger.start), str(stranger.start - 1)))
        with self.assertRaisesRegex(LabError, "kubelet does not run"):
            crash.crash(self.lab, "kubelet", 0)
        self.assertTrue(process.running(stranger))
        file.write_text(text)


if __name__ == "__main__":
    unittest.main()
