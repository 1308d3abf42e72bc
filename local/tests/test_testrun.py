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
