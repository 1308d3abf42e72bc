"""The page of exit codes and status files: what it shows of the sources, and that it is theirs."""

import unittest
from pathlib import Path

from labkit import programdocs
from labkit.errors import LabError

REPOSITORY = Path(__file__).resolve().parents[2]
PROTOCOL = """\
pub enum Mark {
    /// Up.
    Start(u32),
    /// Down,
    /// for now.
    Crash(u32),
    /// Over.
    Done,
}

pub enum StatusFile {
    /// `<member>/…`.
    Of(Member, Mark),
    /// `logcopy/a`, written by `logcopy`: stop.
    Cancel,
    /// `logcopy/b`, written by `logcopy`: stored.
    Stored,
}
"""


class Tables(unittest.TestCase):
    def test_each_status_file_has_its_row(self) -> None:
        self.assertEqual(
            programdocs.status_files(PROTOCOL).splitlines()[2:],
            [
                "| `<member>/<member>.start<c>` | Up. |",
                "| `<member>/<member>.crash<c>` | Down, for now. |",
                "| `<member>/<member>.done` | Over. |",
                "| `logcopy/a` | Written by `logcopy`: stop. |",
                "| `logcopy/b` | Written by `logcopy`: stored. |",
            ],
        )
        with self.assertRaisesRegex(LabError, "other files and marks"):
            programdocs.status_files(PROTOCOL.replace("    /// Up.\n", ""))

    def test_codes_are_in_order_and_each_has_a_comment_and_a_number_of_its_own(self) -> None:
        source = "/// Late.\nconst CODE_B: u8 = 71;\n/// Early.\npub(crate) const CODE_A: i32 = 0;\n"
        self.assertEqual(programdocs.runner(source).splitlines()[2:], ["| `0` | Early. |", "| `71` | Late. |"])
        for more in ("const CODE_C: u8 = 2;\n", "/// Again.\nconst CODE_C: u8 = 71;\n"):
            with self.assertRaisesRegex(LabError, "needs a comment"):
                programdocs.runner(source + more)

    def test_a_help_that_speaks_of_exit_codes_has_a_row(self) -> None:
        text = (
            "=== kubectl leaderboard why --help\nWhy\n\n\n"
            "=== kubectl leaderboard check --help\nCheck\n\nExit code 0: fine; 1: not,\nor an error.\n\n\n"
        )
        self.assertEqual(
            programdocs.rows(programdocs.helps(text)).splitlines()[2:],
            ["| `kubectl leaderboard check` | 0: fine; 1: not, or an error. |"],
        )
        with self.assertRaises(LabError):
            programdocs.rows([])


class Page(unittest.TestCase):
    def test_it_is_that_of_the_sources(self) -> None:
        programdocs.same(REPOSITORY)

    def test_every_program_that_names_its_codes_is_on_it(self) -> None:
        text = (REPOSITORY / programdocs.PAGE).read_text()
        source = (REPOSITORY / programdocs.OPERATOR / "mod.rs").read_text()
        self.assertEqual(text.count("| `leaderboard-operator "), source.count("after_help ="))
        helps = (REPOSITORY / programdocs.PLUGIN).read_text()
        self.assertEqual(text.count("| `kubectl leaderboard "), helps.count("\nExit code "))


if __name__ == "__main__":
    unittest.main()
