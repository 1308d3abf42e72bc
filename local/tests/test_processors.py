"""How long the processors have worked: what is read of /proc, and what counts between two looks."""

import subprocess
import sys
import unittest

from labkit import processors


class Worked(unittest.TestCase):
    def test_what_is_idle_or_of_another_machine_does_not_count(self) -> None:
        stat = "cpu  1 2 4 80 160 8 16 320 640 1280\ncpu0 1 1 1 1 1 1 1 1 1 1\n"
        self.assertEqual(processors.of_machine(stat), (1 + 2 + 4 + 8 + 16) / processors.TICKS)

    def test_a_process_counts_with_what_it_has_waited_for(self) -> None:
        stat = "7 (a b) c) S 1 7 7 0 -1 4194304 1 2 3 4 100 20 3 4 20 0 1 0 9 1 1"
        self.assertEqual(processors.of_process(stat), (100 + 20 + 3 + 4) / processors.TICKS)

    def test_a_child_that_has_ended_counts(self) -> None:
        before = processors.of_this_process()
        spins = "import time\nwhile time.process_time() < 0.2: pass"
        subprocess.run([sys.executable, "-c", spins], check=True)
        self.assertGreater(processors.of_this_process() - before, 0.19)

    def test_a_part_that_was_started_again_counts_from_its_start(self) -> None:
        before, after = {"etcd": 50.0, "Pods": 10.0}, {"etcd": 3.0, "Pods": 15.4, "evalai": 1.0}
        self.assertEqual(processors.since(before, after), "Pods 5, etcd 3, evalai 1")
