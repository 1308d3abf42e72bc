"""The book's table of contents: each page of docs/ is in it once, and each of its entries exists."""

import tempfile
import tomllib
import unittest
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from labkit import book, doccheck

REPOSITORY = Path(__file__).resolve().parents[2]


def summary_faults(docs: Path) -> Iterator[str]:
    """What is wrong between docs/SUMMARY.md and the pages next to it, in both directions."""
    entries = Counter(doccheck.LINK.findall((docs / "SUMMARY.md").read_text()))
    pages = {page.relative_to(docs).as_posix() for page in docs.rglob("*.md")} - {"SUMMARY.md"}
    yield from (f"{page} is not in SUMMARY.md" for page in sorted(pages - entries.keys()))
    lost = (entry for entry in sorted(entries.keys() - pages) if not (docs / entry).exists())
    yield from (f"SUMMARY.md names {entry}, which does not exist" for entry in lost)
    yield from (f"SUMMARY.md names {entry} {times} times" for entry, times in sorted(entries.items()) if times > 1)


class Summary(unittest.TestCase):
    def test_every_page_is_in_it_once_and_every_entry_exists(self) -> None:
        self.assertEqual(list(summary_faults(REPOSITORY / "docs")), [])

    def test_the_book_reads_what_is_staged(self) -> None:
        settings = tomllib.loads((REPOSITORY / "book.toml").read_text())
        self.assertEqual(settings["book"]["src"], book.STAGED.as_posix())
        self.assertEqual(settings["build"]["build-dir"], book.BUILT.as_posix())
        self.assertFalse(settings["build"]["create-missing"])

    def test_the_book_has_every_page_and_what_the_pages_link_to(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            chapters = book.stage(REPOSITORY, Path(folder))
            entries = doccheck.LINK.findall((Path(folder) / "SUMMARY.md").read_text())
            self.assertEqual((len(set(entries)), entries[0]), (chapters, "README.md"))
            self.assertLessEqual({"docs/quickstart.md", "charts/leaderboard-operator/README.md"}, set(entries))
            self.assertEqual([entry for entry in entries if not (Path(folder) / entry).exists()], [])
            self.assertTrue((Path(folder) / "examples" / "leaderboard-20.yaml").exists())
            self.assertNotIn("docs/SUMMARY.md", (Path(folder) / "README.md").read_text())

    def test_links_of_the_book_that_lead_nowhere_are_named(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            pages = Path(folder)
            (pages / "a.html").write_text(
                '<h1 id="one"></h1><a href="#one"></a><a href="b.html#two"></a><img src="c.png">'
            )
            (pages / "b.html").write_text('<a href="a.html#one"></a><a href="https://example.com/none"></a>')
            self.assertEqual(
                list(book.link_faults(pages)),
                ["a.html: b.html#two: there is no such place", "a.html: c.png leads nowhere"],
            )

    def test_what_is_wrong_with_it_is_named(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            docs = Path(folder)
            (docs / "part").mkdir()
            for page in ("a.md", "b.md", "part/c.md"):
                (docs / page).write_text("# A page\n")
            (docs / "SUMMARY.md").write_text("- [A](a.md)\n- [Again](a.md)\n- [B](b.md)\n- [Gone](gone.md)\n")
            self.assertEqual(
                list(summary_faults(docs)),
                [
                    "part/c.md is not in SUMMARY.md",
                    "SUMMARY.md names gone.md, which does not exist",
                    "SUMMARY.md names a.md 2 times",
                ],
            )
