"""Which words are found, and where."""

import unittest

from labkit import words


def found(path: str, text: str) -> list[tuple[int, str]]:
    return [(finding.line, finding.word) for finding in words.find(path, text)]


class Words(unittest.TestCase):
    def test_a_finding_names_file_line_and_the_usual_word(self) -> None:
        finding = next(words.find("docs/a.md", "one\nAs wished.\n"))
        self.assertEqual(str(finding), 'docs/a.md:2: "wished": write requested')

    def test_whole_words_are_found_in_any_case_and_across_lines(self) -> None:
        text = "Wish\nmend it\nfor\never\nIts Pod\nof its Pod, wishful amendments, for everyone\n"
        self.assertEqual(found("a.md", text), [(1, "Wish"), (2, "mend"), (3, "for ever"), (5, "Its Pod")])

    def test_rust_is_searched_in_comments_strings_and_names_of_functions(self) -> None:
        text = "\n".join(
            [
                "/// A wish.",
                "fn it_is_mended(fate: &'a str) -> char { '\"' }",
                'let a = "the \\" fate"; // mend',
                'let b = r#"whoever "#;',
                "/* buried",
                "   for ever */",
            ]
        )
        lines = [(1, "wish"), (2, "mended"), (3, "fate"), (3, "mend"), (4, "whoever"), (5, "buried"), (6, "for ever")]
        self.assertEqual(found("a.rs", text), lines)

    def test_python_is_searched_in_comments_strings_and_names_of_functions(self) -> None:
        text = '"""A wish."""\nwish = 1  # mend\nfate = f"fate {0}"\ndef test_it_is_for_ever(wish): ...\n'
        self.assertEqual([word for _, word in found("a.py", text)], ["wish", "mend", "fate", "for ever"])

    def test_what_is_allowed_is_not_reported_and_what_is_not_needed_is(self) -> None:
        listing = "# Quotes.\na.md: I wish\na.md: gone\n"
        findings, unused = words.check({"a.md": "I wish\nYou wish\n", "b.md": "I wish\n"}, listing)
        self.assertEqual([(finding.path, finding.line) for finding in findings], [("a.md", 2), ("b.md", 1)])
        self.assertEqual(unused, ["a.md: gone"])


if __name__ == "__main__":
    unittest.main()
