"""What the closing tables of a test run look like."""

import unittest

from labkit import testrun


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
