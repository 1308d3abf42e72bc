"""What a command shows on a terminal, and what is drawn of it."""

import os
import sys
import unittest

from labkit import terminal

COLOURED = "a \x1b[32mFinished\x1b[0m <b>\n\x1b[2mrest\x1b[0m"


class Terminal(unittest.TestCase):
    def test_a_command_writes_to_a_terminal_of_these_columns(self) -> None:
        words = "import os, sys; print(sys.stdout.isatty(), os.get_terminal_size().columns); sys.exit('and ends')"
        self.assertEqual(terminal.shown([sys.executable, "-c", words], os.environ, 87), "True 87\nand ends")

    def test_colours_are_drawn_and_strangers_markup_is_not(self) -> None:
        green = terminal.COLOURS[32]
        self.assertEqual(
            terminal.marked_up(COLOURED),
            f'a <span style="color: {green}">Finished</span> &lt;b&gt;\n<span style="opacity: 0.65">rest</span>',
        )
        self.assertEqual(terminal.plain(COLOURED), "a Finished <b>\nrest")


if __name__ == "__main__":
    unittest.main()
