"""Which tests the chart's alerts lack."""

import unittest

from labkit import chartalerts

RULES = """groups:
  - name: a
    rules:
      - alert: One
        expr: up
      - alert: Two
        expr: up
"""


class Untested(unittest.TestCase):
    def test_each_alert_needs_a_test_in_which_it_fires_and_one_in_which_it_does_not(self) -> None:
        tests = "tests:\n  - name: One fires\n  - name: One is silent\n  - name: Two fires\n"
        self.assertEqual(chartalerts.untested(RULES, tests), ["Two is silent"])
        self.assertEqual(chartalerts.untested(RULES, tests + "  - name: Two is silent\n"), [])
