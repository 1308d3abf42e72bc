"""Which sentences, cells and lists of a document are found, and that no fault hides behind Markdown."""

import unittest

from labkit import prose


def found(text: str) -> list[tuple[int, str]]:
    return [(fault.line, fault.text) for fault in prose.faults("a.md", text)]


def words(count: int, last: str = "") -> str:
    return " ".join(["Word", *["word"] * (count - 1)]) + (last or ".")


class Sentences(unittest.TestCase):
    def test_the_thirty_first_word_is_too_many(self) -> None:
        self.assertEqual(found(words(30)), [])
        self.assertEqual(
            found(words(31)), [(1, "a sentence of 31 words, 30 at most: Word word word word word word word word …")]
        )

    def test_a_sentence_goes_on_over_lines_and_ends_at_its_full_stop(self) -> None:
        self.assertEqual(len(found(words(20, "")[:-1] + "\n" + words(20))), 1)
        self.assertEqual(found(words(20) + "\n" + words(20)), [])
        self.assertEqual(found(words(20) + " (" + words(15, ".)")), [])

    def test_code_and_a_link_are_read_as_a_reader_sees_them(self) -> None:
        code = "`kubectl get submissions --all-namespaces --output wide --watch`"
        self.assertEqual(found(" ".join(["Word", *[code] * 29]) + "."), [])
        self.assertEqual(found(f"Word {'[a page](https://example.com/a/b?c=d) ' * 14}ends."), [])
        self.assertEqual(len(found(f"Word {'[a page](b.md) ' * 15}ends.")), 1)

    def test_abbreviations_and_file_names_end_no_sentence(self) -> None:
        self.assertEqual(len(found(f"{words(16, ' e.g. the word')} {words(16)}")), 1)
        self.assertEqual(len(found(f"{words(16, ' in a.md')} {words(16)}")), 1)

    def test_what_is_no_prose_is_left_alone(self) -> None:
        long = words(40)
        for text in (
            f"```sh\n{long}\n```\n",
            f"<!-- {long} -->\n",
            f"# {long}\n",
            f"Text.\n\n    {long}\n",
            f'<img alt="{long}">\n',
        ):
            with self.subTest(text[:12]):
                self.assertEqual(found(text), [])


class Habits(unittest.TestCase):
    def test_each_habit_is_named_with_its_cure(self) -> None:
        for text, habit in (
            ("The agent is told.", "is told"),
            ("It is\nsaid here.", "is said"),
            ("EvalAI was asked.", "was asked"),
            ("The end is noticed.", "is noticed"),
            ("Nobody reads it.", "Nobody"),
            ("Nothing runs but the check.", "Nothing runs but"),
            ("Whoever reads it wins.", "Whoever"),
            ("It runs strangers' code.", "strangers'"),
        ):
            with self.subTest(habit):
                self.assertEqual([text.split('"')[1] for _, text in found(text)], [" ".join(habit.split())])

    def test_nothing_and_but_of_two_clauses_are_no_habit(self) -> None:
        self.assertEqual(found("Nothing runs. But the check does."), [])

    def test_a_sentence_names_its_subject_first(self) -> None:
        for text in ("What runs is here.", "Of these two run.", "Those end.", "The same holds.", "Who reads it wins."):
            with self.subTest(text):
                self.assertEqual(len(found(text)), 1)
        for text in (
            "What runs?",
            "**What runs.** The check.",
            "# What runs",
            "| What runs | Those |",
            "Offscreen it is.",
        ):
            with self.subTest(text):
                self.assertEqual(found(text), [])


class Tables(unittest.TestCase):
    def test_a_cell_has_two_hundred_characters_at_most_as_it_is_seen(self) -> None:
        cell = ("Word. " * 40)[:199] + "."
        self.assertEqual(found(f"| a | b |\n|---|---|\n| a | {cell} |\n"), [])
        self.assertEqual([line for line, _ in found(f"| a | b |\n|---|---|\n| a | {cell}x |\n")], [3])
        self.assertEqual(found(f"| a | {cell[:-9]}[x](https://example.com/{'y' * 90}) |\n"), [])

    def test_a_cell_that_is_code_alone_may_be_longer(self) -> None:
        self.assertEqual(found(f"| a | `{'x | y ' * 50}` |\n"), [])

    def test_code_with_a_bar_does_not_end_its_cell(self) -> None:
        self.assertEqual(found(f"| {'Word. ' * 20}`a | b` {'Word. ' * 10}|\n"), [])
        self.assertEqual(len(found(f"| {'Word. ' * 20}`a | b` {'Word. ' * 20}|\n")), 1)


class Lists(unittest.TestCase):
    def test_the_sixteenth_item_without_a_heading_is_too_many(self) -> None:
        items = "- An item.\n" * 15
        self.assertEqual(found(items), [])
        self.assertEqual([line for line, _ in found(items + "- One more.\n" * 3)], [16])

    def test_a_heading_or_a_paragraph_begins_a_new_list(self) -> None:
        items = "1. An item.\n" * 15
        self.assertEqual(found(f"{items}\n## Next\n\n{items}\nText.\n\n{items}"), [])

    def test_paragraphs_and_items_within_an_item_belong_to_its_list(self) -> None:
        item = "- An item.\n\n  More of it.\n  - Below it.\n"
        self.assertEqual(len(found(item * 8)), 1)


if __name__ == "__main__":
    unittest.main()
