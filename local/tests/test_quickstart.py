"""The quickstart's manifest, its images as the lab makes them and as a release publishes them, and its page agree."""

import re
import unittest
from importlib.metadata import PathDistribution
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest import mock

from labkit import pythonimage, quickstart, release
from labkit.errors import LabError

REPOSITORY = Path(__file__).resolve().parents[2]
LOCAL = REPOSITORY / "local"
STAGE = re.compile(r"^FROM \$\{\w+\} AS (\w+)\n((?:(?!FROM ).*\n?)*)", re.MULTILINE)


class Images(unittest.TestCase):
    def setUp(self) -> None:
        self.made = {spec.name: spec for spec in quickstart.specs(REPOSITORY)}
        self.published = {quickstart.PUBLISHED + name for name in self.made}

    def test_the_manifest_and_its_page_name_what_is_published_at_this_version(self) -> None:
        page = (REPOSITORY / "docs" / "quickstart.md").read_text()
        told = set(re.findall(rf"{quickstart.PUBLISHED}(?!charts)\S+:[\d.]+\d", page))
        self.assertLessEqual(told, self.published)
        agent = {name for name in self.published if "/agent:" in name}
        self.assertEqual(set(quickstart.named(REPOSITORY)) | agent, self.published)
        self.assertLessEqual(agent, told)
        self.assertIn(f"--version {release.version(REPOSITORY)}", page)

    def test_the_first_submission_is_for_a_track_of_the_game(self) -> None:
        wanted = (REPOSITORY / quickstart.GAME).read_text()
        named = dict(re.findall(r"^  (\w+): (\S+)$", wanted, re.MULTILINE))
        board, track = named["leaderboardName"], named["track"]
        parts = (REPOSITORY / quickstart.MANIFEST).read_text().split("\n---\n")
        [game] = [part for part in parts if f"\nkind: Leaderboard\nmetadata:\n  name: {board}\n" in part]
        self.assertIn(f"- {{name: {track}, ", game)
        # As the page promises it: what local/games/README.md works out is of this seed and so many games.
        for name, value in (("GAMES", '"8"'), ("SEED", "window")):
            self.assertIn(f"{{name: {name}, value: {value}}}", game)

    def test_the_dockerfile_runs_each_of_them_as_the_lab_does(self) -> None:
        stages = dict(STAGE.findall((LOCAL / "quickstart" / "Dockerfile").read_text()))
        self.assertEqual(stages.keys() - {"build"}, {name.partition(":")[0].partition("/")[2] for name in self.made})
        for name, spec in self.made.items():
            stage = stages[name.partition(":")[0].partition("/")[2]]
            env = re.findall(r"(\w+)=(\S+)", " ".join(re.findall(r"^ENV (.+)$", stage, re.MULTILINE)))
            found = {
                "env": dict(env),
                "user": next(iter(re.findall(r"^USER (.+)$", stage, re.MULTILINE)), ""),
                "entrypoint": re.findall(
                    r'"([^"]+)"', next(iter(re.findall(r"^ENTRYPOINT (.+)$", stage, re.MULTILINE)), "")
                ),
                "workdir": next(iter(re.findall(r"^WORKDIR (.+)$", stage, re.MULTILINE)), "/"),
            }
            wanted = {
                "env": dict(spec.env),
                "user": spec.user,
                "entrypoint": list(spec.entrypoint),
                "workdir": spec.workdir,
            }
            self.assertEqual(found, wanted, name)
            for file in spec.files:
                if file.kind in ("bin", "repo"):
                    self.assertIn(file.value.rpartition("/")[2], stage, name)

    def test_the_workflow_publishes_each_of_them(self) -> None:
        workflow = (REPOSITORY / ".github" / "workflows" / "release.yaml").read_text()
        listed = re.search(r"^ +image: \[(.+)\]$", workflow, re.MULTILINE)
        self.assertIsNotNone(listed)
        names = {name.partition(":")[0] for name in self.made}
        self.assertEqual(set(listed[1].split(", ") if listed else ()), names)


class Packages(unittest.TestCase):
    def site(self, folder: str, **requires: list[str]) -> Path:
        for name, others in requires.items():
            info = Path(folder) / f"{name}-1.dist-info"
            info.mkdir(parents=True)
            lines = [f"Metadata-Version: 2.1\nName: {name}\nVersion: 1", *(f"Requires-Dist: {one}" for one in others)]
            (info / "METADATA").write_text("\n".join(lines) + "\n")
            self.assertEqual(PathDistribution(info).metadata["Name"], name)
        return Path(folder)

    def test_a_package_comes_with_all_that_it_requires_but_for_extras(self) -> None:
        with TemporaryDirectory() as folder:
            site = self.site(folder, a=["B_b>=1", "d; extra == 'full'"], B_b=["c.c (<2)"], **{"c_c": ["a"]}, e=[])
            found = [one.metadata["Name"] for one in pythonimage.closure(site, ["a"])]
            self.assertEqual(found, ["a", "B_b", "c_c"])
            with self.assertRaisesRegex(LabError, "the Python package d is not in"):
                pythonimage.closure(site, ["e", "d"])

    def test_what_lies_outside_of_the_packages_is_left_out(self) -> None:
        """As pip records the programs of a package. podman refuses a layer with `..` in its paths."""
        with TemporaryDirectory() as folder:
            site = self.site(f"{folder}/lib/site", a=[])
            for name in ("lib/site/a.py", "bin/a"):
                file = Path(folder) / name
                file.parent.mkdir(parents=True, exist_ok=True)
                file.touch()
            (site / "a-1.dist-info" / "RECORD").write_text("a.py,,\n../../bin/a,,\n")
            with mock.patch.object(pythonimage, "tree", return_value=[]):
                paths = [entry.path for entry in pythonimage.entries(site, ["a"], "/packages")]
            self.assertIn("/packages/a.py", paths)
            self.assertFalse([path for path in paths if "bin/a" in path or ".." in path], paths)


if __name__ == "__main__":
    unittest.main()
