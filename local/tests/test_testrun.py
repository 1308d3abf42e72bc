"""What is run again, what the closing tables of a test run look like, and that nothing is lost on the way."""

import io
import os
import sys
import tempfile
import unittest
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

from labkit import testrun
from labkit.errors import LabError
from labkit.failures import Failure, Reader, Summary


class Matrix(unittest.TestCase):
    def test_it_is_sorted_and_in_columns(self) -> None:
        lines = "no node\tPending\tas expected\t0.2\nanother machine\tFailed ImagePull\tFinished\t-\n"
        self.assertEqual(
            testrun.matrix(lines).splitlines(),
            [
                "",
                "case             expected          seen         shown after s",
                "another machine  Failed ImagePull  Finished     -",
                "no node          Pending           as expected  0.2",
            ],
        )


class Space(unittest.TestCase):
    def test_a_full_disk_is_named_before_any_layer_begins(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder)
            settings: Any = SimpleNamespace(cache=place, state=place, repository=place)
            with (
                patch("labkit.tools.shutil.disk_usage", return_value=SimpleNamespace(free=1 << 30)),
                patch("labkit.testrun.run_layer") as run_layer,
                self.assertRaisesRegex(LabError, "has 1.0 GiB free and 5 GiB are needed"),
            ):
                testrun.run(settings, core=True, name_filter="", only=["unit"])
        run_layer.assert_not_called()


class Alone(unittest.TestCase):
    LISTED = """cluster::restarts::an_etcd_that_dies: test
cluster::restarts::a_kubelet_that_dies: test
cluster::audit::what_it_costs_for_an_hour: test

3 tests, 0 benchmarks
"""

    def test_ignored_tests_of_other_modules_stay_ignored(self) -> None:
        names = ["cluster::restarts::an_etcd_that_dies", "cluster::restarts::a_kubelet_that_dies"]
        self.assertEqual(testrun.names_alone(self.LISTED, ""), names)

    def test_the_filter_chooses_among_them(self) -> None:
        self.assertEqual(testrun.names_alone(self.LISTED, "an_etcd"), ["cluster::restarts::an_etcd_that_dies"])
        self.assertEqual(testrun.names_alone(self.LISTED, "what_it_costs"), [])


def outcome(*failed: str) -> testrun.Outcome:
    return testrun.Outcome(not failed, True, [Failure(name, [[f"{name} failed"]]) for name in failed])


class Again(unittest.TestCase):
    """What comes of tests of the cluster that failed while others ran."""

    def settle(self, first: testrun.Outcome, second: testrun.Outcome) -> tuple[bool, Summary, list[str]]:
        asked: list[str] = []

        def again(names: Sequence[str]) -> testrun.Outcome:
            asked.extend(names)
            return second

        summary = Summary()
        return testrun.settle(summary, first, again), summary, asked

    def test_nothing_runs_again_when_all_passed(self) -> None:
        passed, summary, asked = self.settle(outcome(), outcome())
        self.assertEqual((passed, summary, asked), (True, Summary(), []))

    def test_what_passes_alone_passes_and_is_named_with_its_first_message(self) -> None:
        passed, summary, asked = self.settle(outcome("a", "b"), outcome())
        self.assertTrue(passed)
        self.assertEqual(asked, ["a", "b"])
        self.assertEqual(summary.failed, [])
        self.assertEqual(summary.passed_alone, outcome("a", "b").failures)
        self.assertIn("failed next to others and passed alone: a", summary.lines())

    def test_one_that_fails_again_fails_the_layer(self) -> None:
        passed, summary, _ = self.settle(outcome("a", "b"), outcome("b"))
        self.assertFalse(passed)
        self.assertEqual([failure.name for failure in summary.failed], ["b"])
        self.assertEqual([failure.name for failure in summary.passed_alone], ["a"])

    def test_many_failures_are_no_accident(self) -> None:
        names = [f"test_{number}" for number in range(testrun.MOST_AGAIN + 1)]
        passed, summary, asked = self.settle(outcome(*names), outcome())
        self.assertFalse(passed)
        self.assertEqual(asked, [])
        self.assertEqual(len(summary.failed), len(names))

    def test_a_test_program_that_died_fails_the_layer(self) -> None:
        reader = Reader()
        reader.feed("running 2 tests\n")
        died = testrun.outcome_of(101, reader)
        for first, second in [(died, outcome()), (outcome("a"), died)]:
            passed, summary, _ = self.settle(first, second)
            self.assertFalse(passed)
            self.assertTrue(summary.failed)
            self.assertEqual(summary.passed_alone, [])


class Streaming(unittest.TestCase):
    def test_what_is_printed_goes_through_and_to_the_reader(self) -> None:
        plan = testrun.Plan(SimpleNamespace(repository=Path("/")), "")
        script = "import os, sys; print('out'); sys.stdout.flush(); os.write(2, b'\\xff err\\n'); sys.exit(3)"
        shown = io.TextIOWrapper(io.BytesIO())
        reader = Reader()
        with redirect_stdout(shown):
            code = testrun.stream(plan, [sys.executable, "-c", script], {}, reader)
        self.assertEqual(code, 3)
        self.assertEqual(shown.buffer.getvalue(), b"out\n\xff err\n")
        self.assertEqual(list(reader.tail), ["out", "\ufffd err"])

    def test_a_process_that_a_test_left_behind_holds_nothing_up(self) -> None:
        plan = testrun.Plan(SimpleNamespace(repository=Path("/")), "")
        script = "import subprocess; subprocess.Popen(['sleep', '30']); print('done')"
        shown = io.TextIOWrapper(io.BytesIO())
        with redirect_stdout(shown), patch.object(testrun, "AFTER_END", 0.1):
            self.assertEqual(testrun.stream(plan, [sys.executable, "-c", script], {}, Reader()), 0)


class SideBySide(unittest.TestCase):
    """Which layers run next to the cluster's, and what becomes of what they find."""

    def test_what_computes_runs_next_to_the_cluster_in_whole_runs_alone(self) -> None:
        rest = ["lab", "unit", "api", "page", "chart", "image"]
        for only, stages in (
            (testrun.NAMES, [[["tools"], ["build"]], [["cluster"], rest]]),
            (["cluster"], [[["cluster"]]]),
            (["build", "unit", "api"], [[["build"]], [["unit", "api"]]]),
        ):
            with self.subTest(only):
                chosen = [layer for layer in testrun.LAYERS if layer.name in only]
                found = [[[layer.name for layer in lane] for lane in stage] for stage in testrun.stages(chosen)]
                self.assertEqual(found, stages)

    def run_both(self, unit: Callable[[testrun.Plan], None]) -> tuple[list[testrun.Result], Summary]:
        """The results of `unit` and of a cluster's layer that passes."""
        layers = [testrun.Layer("cluster", "it", lambda _: None, "a"), testrun.Layer("unit", "it", unit, "b")]
        shown = io.TextIOWrapper(io.BytesIO())
        with tempfile.TemporaryDirectory() as folder, redirect_stdout(shown), redirect_stderr(io.StringIO()):
            plan = testrun.Plan(SimpleNamespace(logs=Path(folder)), "")
            return testrun.side_by_side(plan, [[layer] for layer in layers], []), plan.summary

    def test_what_fails_in_a_lane_is_in_the_tables(self) -> None:
        def fails(plan: testrun.Plan) -> None:
            plan.summary.failed += outcome("a").failures
            raise LabError("found failures")

        results, summary = self.run_both(fails)
        self.assertEqual({one.name: one.failure for one in results}, {"unit": "found failures", "cluster": ""})
        self.assertEqual(summary.failed, outcome("a").failures)

    def test_a_layer_whose_process_dies_has_failed(self) -> None:
        results, _ = self.run_both(lambda _: os._exit(0))
        self.assertEqual({one.name: bool(one.failure) for one in results}, {"unit": True, "cluster": False})
