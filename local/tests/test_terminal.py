"""What a command shows on a terminal, and what is drawn of it."""

import os
import sys
import unittest
from xml.etree import ElementTree

from labkit import terminal

SVG = "{http://www.w3.org/2000/svg}"
COLOURED = "a \x1b[32mFinished\x1b[0m <b>\n\x1b[2mrest\x1b[0m"


class Terminal(unittest.TestCase):
    def test_a_command_writes_to_a_terminal_of_these_columns(self) -> None:
        words = "import os, sys; print(sys.stdout.isatty(), os.get_terminal_size().columns); sys.exit('and ends')"
        self.assertEqual(terminal.shown([sys.executable, "-c", words], os.environ, 87), "True 87\nand ends")

    def test_colours_are_drawn_and_markup_in_the_text_is_not(self) -> None:
        green = terminal.COLOURS[32]
        self.assertEqual(
            terminal.marked_up(COLOURED),
            f'a&#160;<tspan fill="{green}">Finished</tspan>&#160;&lt;b&gt;\n<tspan opacity="0.65">rest</tspan>',
        )
        self.assertEqual(terminal.plain(COLOURED), "a Finished <b>\nrest")

    def test_a_picture_has_each_line_at_its_place_and_as_wide_as_its_letters(self) -> None:
        drawing = ElementTree.fromstring(terminal.picture([("kubectl get <x>", COLOURED), ("true", "")]))
        texts = [element for element in drawing.iter(f"{SVG}text")]
        self.assertEqual(
            ["".join(text.itertext()).replace("\xa0", " ") for text in texts],
            ["$ kubectl get <x>", "a Finished <b>", "rest", "$ true"],
        )
        self.assertEqual([text.get("textLength") for text in texts], ["142.8", "117.6", "33.6", "50.4"])
        rows = [int(text.get("y", "0")) for text in texts]
        self.assertEqual([high - low for low, high in zip(rows, rows[1:], strict=False)], [19, 19, 38])
        self.assertEqual(drawing.get("aria-label"), "kubectl get <x>, true")


if __name__ == "__main__":
    unittest.main()
