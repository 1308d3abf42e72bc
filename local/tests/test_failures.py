"""What is read from the output of test programs, and what is left of it at the end of a run."""

import unittest

from labkit.failures import MOST_LINES, Failure, Reader, Summary, failed_cases

TWO_FAILURES = """
running 3 tests
test cluster::abrupt::kills ... FAILED
matrix: cancel in line | Pending Paused; Cancelled | as expected | 0.4
test cluster::runs::a_run ... ok
test cluster::stops::a_cancel ... FAILED

failures:

---- cluster::abrupt::kills stdout ----

thread 'cluster::abrupt::kills' (4711) panicked at tests/cluster/abrupt.rs:91:5:
assertion `left == right` failed: two rows
  left: 2
 right: 1
note: run with `RUST_BACKTRACE=1` environment variable to display a backtrace

===== kills-1a2b3
--- submission submission-1 (deleted: false) {}
failures:
    of a Pod

---- cluster::stops::a_cancel stdout ----
a line before

thread 'cluster::stops::a_cancel' (12) panicked at tests/support/cluster.rs:300:9:
tries: not after 240 s: it has ended

thread 'cluster::stops::a_cancel' (12) panicked at tests/cluster/matrix.rs:190:5:
1 of 7 cases failed, see above


failures:
    cluster::abrupt::kills
    cluster::stops::a_cancel

test result: FAILED. 1 passed; 2 failed; 0 ignored; 0 measured; 0 filtered out; finished in 300.00s

error: test failed, to rerun pass `-p leaderboard-operator --test cluster`
"""


def read(text: str) -> Reader:
    reader = Reader()
    for line in text.splitlines(keepends=True):
        reader.feed(line)
    return reader


class Reading(unittest.TestCase):
    def test_each_failed_test_has_the_messages_of_its_panics(self) -> None:
        reader = read(TWO_FAILURES)
        self.assertTrue(reader.is_whole())
        kills, cancel = reader.failures()
        self.assertEqual(kills.name, "cluster::abrupt::kills")
        self.assertEqual(
            kills.messages,
            [
                [
                    "tests/cluster/abrupt.rs:91:5",
                    "assertion `left == right` failed: two rows",
                    "  left: 2",
                    " right: 1",
                ]
            ],
        )
        places = [message[0] for message in cancel.messages]
        self.assertEqual(places, ["tests/support/cluster.rs:300:9", "tests/cluster/matrix.rs:190:5"])
        self.assertEqual(cancel.messages[0][1:], ["tries: not after 240 s: it has ended"])

    def test_a_test_without_a_panic_shows_its_first_lines(self) -> None:
        text = "running 1 test\nfailures:\n\n---- a stdout ----\nError: no such file\n\nfailures:\n    a\n\n"
        reader = read(text + "test result: FAILED. 0 passed\n")
        self.assertEqual(reader.failures(), [Failure("a", [["Error: no such file"]])])

    def test_a_program_that_is_killed_has_not_come_to_its_end(self) -> None:
        reader = read("running 2 tests\ntest a ... FAILED\nprocess didn't exit successfully (signal: 9, SIGKILL)\n")
        self.assertFalse(reader.is_whole())
        self.assertIn("process didn't exit successfully (signal: 9, SIGKILL)", reader.tail)

    def test_a_program_that_is_killed_after_another_has_failed_has_not_either(self) -> None:
        self.assertFalse(read(TWO_FAILURES + "running 2 tests\nkilled\n").is_whole())


class Summing(unittest.TestCase):
    def test_nothing_is_said_when_nothing_failed(self) -> None:
        self.assertEqual(Summary().lines(), [])

    def test_it_names_the_tests_then_the_cases_then_the_messages(self) -> None:
        summary = Summary(
            failed=[Failure("a", [["x.rs:1:2", "boom"]])],
            passed_alone=[Failure("b", [["y.rs:3:4", "late"]])],
            cases=failed_cases(
                "one\tCancelled\tFinished\t-\ntwo\tFinished\tas expected\t1.0\nthree\tsoon\tmeasured\t2.0\n"
                "four\theld\tas expected: denied EPERM\t-\n"
            ),
        )
        self.assertEqual(
            summary.lines(),
            [
                "",
                "--- what failed",
                "FAILED: a",
                "failed next to others and passed alone: b",
                "case 'one': expected 'Cancelled', seen 'Finished'",
                "a:",
                "  x.rs:1:2",
                "  boom",
                "b:",
                "  y.rs:3:4",
                "  late",
            ],
        )

    def test_it_stays_short_however_much_has_failed(self) -> None:
        message = [f"line {number} " + "x" * 1000 for number in range(40)]
        many = Summary(failed=[Failure(f"test_{number}", [message]) for number in range(30)], cases=["case"] * 30)
        few = Summary(failed=[Failure("one", [message, message]), Failure("two", [message])])
        for summary in (many, few):
            lines = summary.lines()
            self.assertLessEqual(len(lines), MOST_LINES)
            self.assertTrue(all(len(line) <= 240 for line in lines))
        self.assertIn("two:", few.lines())
