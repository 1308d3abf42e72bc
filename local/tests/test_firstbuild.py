"""What is built at the same time, what is built at all, and what becomes of a build that fails."""

import json
import os
import signal
import subprocess
import tempfile
import unittest
from contextlib import redirect_stderr
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

from labkit import build, demo, firstbuild, image
from labkit.errors import LabError

REPOSITORY = Path(__file__).resolve().parents[2]


class SideBySide(unittest.TestCase):
    def build(self, *works: object) -> None:
        with tempfile.TemporaryDirectory() as folder, redirect_stderr(StringIO()):
            named = {f"work {number}": work for number, work in enumerate(works)}
            firstbuild.side_by_side(SimpleNamespace(logs=Path(folder)), named)

    def test_the_first_failure_ends_the_others_and_is_the_error(self) -> None:
        reading, writing = os.pipe()

        def fails() -> None:
            os.read(reading, 1)
            raise LabError("cargo is missing")

        def hangs() -> None:
            os.write(writing, b".")
            signal.pause()

        with self.assertRaisesRegex(LabError, "^cargo is missing$"):
            self.build(hangs, fails)
        os.close(reading)
        os.close(writing)

    def test_a_process_that_dies_is_an_error(self) -> None:
        with self.assertRaisesRegex(LabError, "builds the work 0 ended without a result"):
            self.build(lambda: os._exit(9))

    def test_all_that_succeed_are_awaited(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            self.build((Path(folder) / "a").touch, (Path(folder) / "b").touch)
            self.assertEqual({path.name for path in Path(folder).iterdir()}, {"a", "b"})


class Choice(unittest.TestCase):
    def ran(self, absent: list[str], cargo: int, python: bool, memory: int) -> str:
        """How the builds ran."""
        with (
            patch.object(firstbuild, "absent", return_value=absent),
            patch.object(build, "cold_seconds", return_value=cargo),
            patch.object(firstbuild.pythonenv, "is_whole", return_value=python),
            patch.object(firstbuild, "memory_bytes", return_value=memory << 30),
            patch.object(firstbuild, "side_by_side", side_effect=lambda *_: found.append("at once")),
            patch.object(firstbuild.tools, "ensure", side_effect=lambda *_: found.append("tools")),
            patch.object(build, "programs", side_effect=lambda _: found.append("programs")),
            patch.object(build, "static_programs"),
            patch.object(firstbuild.pythonenv, "ensure", side_effect=lambda _: found.append("packages")),
        ):
            found: list[str] = []
            firstbuild.ensure(SimpleNamespace(), ["etcd"])
        return " ".join(found)

    def test_two_that_are_cold_run_at_once_where_the_memory_is_enough(self) -> None:
        for absent, cargo, python, memory, how in (
            (["etcd"], 400, False, 16, "at once"),
            (["etcd"], 0, False, 16, "at once"),
            (["etcd"], 400, True, 4, "tools programs packages"),
            ([], 400, True, 16, "tools programs packages"),
            ([], 0, True, 16, "tools programs packages"),
        ):
            with self.subTest((absent, cargo, python, memory)):
                self.assertEqual(self.ran(absent, cargo, python, memory), how)


class Units(unittest.TestCase):
    """What cargo compiles: its own plan."""

    def units(self, *arguments: str) -> set[str]:
        env = {**os.environ, "RUSTC_BOOTSTRAP": "1", "RUSTFLAGS": ""}
        argv = ["cargo", *arguments, "--locked", "--unit-graph", "-Zunstable-options"]
        done = subprocess.run(argv, cwd=REPOSITORY, env=env, capture_output=True, text=True, check=False)
        self.assertEqual(done.returncode, 0, done.stderr)
        units = json.loads(done.stdout)["units"]
        keys = ("pkg_id", "features", "mode", "platform", "profile")
        return {json.dumps([unit["target"]["name"], *(unit[key] for key in keys)]) for unit in units}

    def test_the_tests_compile_nothing_of_the_demo_again(self) -> None:
        programs = self.units(*build.program_arguments())
        tests = self.units("test", "--no-run", "--workspace", "--profile", build.PROFILE)
        self.assertGreater(len(programs), 300)
        self.assertEqual(sorted(programs - tests), [], "local/features/Cargo.toml lacks what the tests ask for")
        self.assertGreater(len(tests - programs), 50)


class Images(unittest.TestCase):
    def test_the_demo_s_images_are_described(self) -> None:
        files = [
            REPOSITORY / "local" / name
            for name in ("operator-image.toml", "challenge/images.toml", "games/images.toml")
        ]
        names = {spec.name for file in files for spec in image.specs(file)}
        self.assertLessEqual(set(demo.IMAGES), names)
        board = (REPOSITORY / "examples" / "demo" / "leaderboard.yaml").read_text()
        for name in (demo.CONTENTS, demo.SIMULATOR):
            self.assertIn(f"/{name}\n", board)


if __name__ == "__main__":
    unittest.main()
