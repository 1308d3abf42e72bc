"""How a browser is spoken to: with a program in its place that sends back what it gets."""

import os
import tempfile
import unittest
from contextlib import ExitStack
from pathlib import Path
from unittest.mock import patch

from labkit import browser


class Pipes(unittest.TestCase):
    def test_they_reach_it_from_a_process_with_many_files_open(self) -> None:
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            for _ in range(10):
                stack.enter_context(open(os.devnull))
            echo = folder / "echo"
            echo.write_text("#!/bin/sh\nexec cat <&3 >&4\n")
            echo.chmod(0o755)
            stack.enter_context(patch.object(browser, "program", return_value=str(echo)))
            stack.enter_context(patch.object(browser, "attached", side_effect=lambda tab: tab))
            tab = stack.enter_context(browser.tab())
            os.write(tab.to, b"a question\n")
            self.assertEqual(os.read(tab.back, 100), b"a question\n")


if __name__ == "__main__":
    unittest.main()
