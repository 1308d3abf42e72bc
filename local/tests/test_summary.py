"""The book's table of contents: each page of docs/ is in it once, and each of its entries exists."""

import tempfile
import tomllib
import unittest
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from labkit import doccheck

REPOSITORY = Path(__file__).resolve().parents[2]


def summary_faults(docs: Path) -> Iterator[str]:
    """What is wrong between docs/SUMMARY.md and the pages next to it, in both directions."""
    entries = Counter(doccheck.LINK.findall((docs / "SUMMARY.md").read_text()))
    pages = {page.relative_to(docs).as_posix() for page in docs.rglob("*.md")} - {"SUMMARY.md"}
    yield from (f"{page} is not in SUMMARY.md" for page in sorted(pages - entries.keys()))
    yield from (f"SUMMARY.md names {entry}, which does not exist" for entry in sorted(entries.keys() - pages))
    yield from (f"SUMMARY.md names {entry} {times} times" for entry, times in sorted(entries.items()) if times > 1)


class Summary(unittest.TestCase):
    def test_every_page_is_in_it_once_and_every_entry_exists(self) -> None:
        self.assertEqual(list(summary_faults(REPOSITORY / "docs")), [])

    def test_the_book_reads_this_folder(self) -> None:
        book = tomllib.loads((REPOSITORY / "book.toml").read_text())
        self.assertEqual(book["book"]["src"], "docs")
        self.assertFalse(book["build"]["create-missing"])

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
