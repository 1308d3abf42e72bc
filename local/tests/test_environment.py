"""What `lab env` prints: that a shell which takes it finds the tools, and kubectl the plugin."""

import contextlib
import io
import os
import subprocess
import tempfile
import unittest
from pathlib import Path
from unittest import mock

from labkit import cli, settings


class Environment(unittest.TestCase):
    """The lines as a shell takes them."""

    def test_a_shell_finds_the_plugin_that_cargo_has_built_after_its_own_programs(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            target = Path(folder) / "target"
            (target / "local").mkdir(parents=True)
            plugin = target / "local" / "kubectl-leaderboard"
            plugin.write_text("#!/bin/sh\necho found\n", encoding="utf-8")
            plugin.chmod(0o755)
            repository = Path(__file__).resolve().parents[2]
            with mock.patch.dict(os.environ, {"CARGO_TARGET_DIR": str(target), "LEADERBOARD_TOOLS": folder}):
                printed = io.StringIO()
                with contextlib.redirect_stdout(printed):
                    cli.print_environment(settings.load(repository))
            shell = f"{printed.getvalue()}\nkubectl-leaderboard; command -v sh"
            done = subprocess.run(["sh", "-c", shell], check=True, capture_output=True, text=True, timeout=60)
            found, shell_of_machine = done.stdout.splitlines()
            self.assertEqual(found, "found")
            self.assertFalse(shell_of_machine.startswith(folder))


if __name__ == "__main__":
    unittest.main()
