"""What a long command leaves behind."""

import os
import select
import tempfile
import unittest
from pathlib import Path
from unittest.mock import patch

from labkit import console


class Interrupted(unittest.TestCase):
    def test_what_a_command_has_started_ends_with_it(self) -> None:
        """The grandchild holds the pipe's other end open until it ends."""
        with tempfile.TemporaryDirectory() as folder:
            reading, writing = os.pipe()
            log = Path(folder) / "log"

            def interrupt(_: str) -> str:
                raise KeyboardInterrupt

            with (
                patch.object(console, "HEARTBEAT_SECONDS", 0.2),
                self.assertRaises(KeyboardInterrupt),
            ):
                argv = ["sh", "-c", "sleep 600 & wait"]
                console.run_long(argv, "it", log, keep=(writing,), progress=interrupt, group=True)
            os.close(writing)
            self.assertTrue(select.select([reading], [], [], 10)[0], "what the command has started still runs")
            os.close(reading)


if __name__ == "__main__":
    unittest.main()
