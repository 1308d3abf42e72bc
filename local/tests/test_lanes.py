"""Jobs that run at the same time: that they do, that the output of each stays whole, and that none is lost."""

import io
import os
import subprocess
import tempfile
import unittest
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from unittest.mock import patch

from labkit import console, lanes
from labkit.lanes import Ended, Job


def run(*all_lanes: Sequence[Job]) -> tuple[list[Ended], str, str]:
    """What ended, in this order; what was shown on stdout; and what was said."""
    shown, said = io.TextIOWrapper(io.BytesIO()), io.StringIO()
    with tempfile.TemporaryDirectory() as folder, redirect_stdout(shown), redirect_stderr(said):
        ended = list(lanes.run(all_lanes, Path(folder)))
    return ended, shown.buffer.getvalue().decode(), said.getvalue()


def gate() -> tuple[Callable[[], None], Callable[[], None]]:
    """Two functions: the first waits, in whatever process, until the second is called in another."""
    reader, writer = os.pipe()
    return lambda: os.read(reader, 1) and None, lambda: os.write(writer, b".") and None


class Lanes(unittest.TestCase):
    def test_lanes_run_at_once_and_the_output_of_each_job_is_whole(self) -> None:
        wait_for_b, open_b = gate()
        wait_for_a, open_a = gate()

        def a() -> str:
            os.write(1, b"a begins\n")
            open_b()
            wait_for_a()
            os.write(1, b"a ends\n")
            return "of a"

        def b() -> str:
            wait_for_b()
            subprocess.run(["echo", "b by a program"], check=True)
            open_a()
            return "of b"

        ended, shown, _ = run([Job("a", a)], [Job("b", b)])
        self.assertEqual({one.job.name: one.value for one in ended}, {"a": "of a", "b": "of b"})
        self.assertIn("a begins\na ends\n", shown)
        self.assertIn("b by a program\n", shown)

    def test_the_jobs_of_one_lane_run_in_turn(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            mark = Path(folder) / "first"
            ended, _, _ = run([Job("a", mark.touch), Job("b", mark.exists)])
        self.assertEqual([(one.job.name, one.value) for one in ended], [("a", None), ("b", True)])

    def test_a_process_that_dies_has_no_result_and_its_lane_goes_on(self) -> None:
        def dies() -> None:
            os.write(1, b"last words\n")
            os._exit(7)

        ended, shown, _ = run([Job("a", dies), Job("b", lambda: 1)])
        self.assertEqual([(one.job.name, one.value) for one in ended], [("a", None), ("b", 1)])
        self.assertIn("last words", shown)

    def test_progress_of_each_is_shown_from_time_to_time(self) -> None:
        wait, go = gate()

        def slow() -> None:
            os.write(1, b"test of_something ... ok\n")
            wait()

        def heard(text: str) -> None:
            if "test of_something ... ok" in text:
                go()

        with patch.object(lanes, "HEARTBEAT_SECONDS", 0.05), patch.object(lanes, "say", side_effect=heard) as said:
            run([Job("a", slow)])
        self.assertRegex(said.call_args.args[0], r"^still at work: a \S+ s \(test of_something \.\.\. ok\)$")

    def test_what_is_not_captured_is_printed_as_it_comes(self) -> None:
        reading, writing = os.pipe()

        def a() -> bool:
            os.write(writing, b"of a")
            return console.draws_bars

        with tempfile.TemporaryDirectory() as folder:
            ended = list(lanes.run([[Job("a", a)]], Path(folder), captured=False))
            self.assertEqual(list(Path(folder).iterdir()), [])
        self.assertEqual((os.read(reading, 9), ended[0].value), (b"of a", False))
        self.assertTrue(console.draws_bars)
        os.close(reading)
        os.close(writing)

    def test_all_but_the_first_lane_give_way(self) -> None:
        before = os.nice(0)
        ended, _, _ = run([Job("a", lambda: os.nice(0))], [Job("b", lambda: os.nice(0))])
        nice = {one.job.name: one.value for one in ended}
        self.assertEqual(nice, {"a": before, "b": min(before + lanes.NICE, 19)})


if __name__ == "__main__":
    unittest.main()
