"""The version in its three places, and the manifest of krew."""

import tempfile
import unittest
from pathlib import Path

from labkit import release
from labkit.errors import LabError

REPOSITORY = Path(__file__).resolve().parents[2]
SUMS = {release.archive("1.2.3", name): "0" * 64 for name in release.PLATFORMS}


def repository(folder: str, chart: str, member: str = "version.workspace = true") -> Path:
    """One with a version 1.2.3 and one member."""
    root = Path(folder)
    (root / "a").mkdir()
    (root / "charts" / "leaderboard-operator").mkdir(parents=True)
    package = '[package]\nname = "x"\nversion.workspace = true\n'
    (root / "Cargo.toml").write_text(f'[workspace]\nmembers = ["a"]\n[workspace.package]\nversion = "1.2.3"\n{package}')
    (root / "a" / "Cargo.toml").write_text(f'[package]\nname = "a"\n{member}\n')
    (root / "charts" / "leaderboard-operator" / "Chart.yaml").write_text(chart)
    return root


class Version(unittest.TestCase):
    def test_this_repository_has_one(self) -> None:
        self.assertRegex(release.version(REPOSITORY), r"^\d+\.\d+\.\d+")

    def test_each_place_that_differs_is_named(self) -> None:
        same = 'version: 1.2.3\nappVersion: "1.2.3"\n'
        for chart, member, word in (
            ("version: 1.2.4\nappVersion: 1.2.3\n", "version.workspace = true", "Chart.yaml: version is 1.2.4"),
            ("version: 1.2.3\n", "version.workspace = true", "appVersion is missing"),
            (same, 'version = "1.2.3"', "a has a version of its own"),
        ):
            with self.subTest(word), tempfile.TemporaryDirectory() as folder, self.assertRaisesRegex(LabError, word):
                release.version(repository(folder, chart, member))
        with tempfile.TemporaryDirectory() as folder:
            self.assertEqual(release.version(repository(folder, same)), "1.2.3")


class Krew(unittest.TestCase):
    def test_each_machine_has_its_archive_with_its_sum(self) -> None:
        platforms = release.krew("1.2.3", "https://x.example/v1.2.3/", SUMS)["spec"]["platforms"]
        self.assertEqual(len(platforms), 5)
        windows = platforms[-1]
        self.assertEqual(windows["selector"]["matchLabels"], {"os": "windows", "arch": "amd64"})
        self.assertEqual(windows["uri"], "https://x.example/v1.2.3/kubectl-leaderboard-1.2.3-windows-amd64.tar.gz")
        self.assertEqual((windows["bin"], windows["sha256"]), ("kubectl-leaderboard.exe", "0" * 64))

    def test_a_missing_archive_is_named(self) -> None:
        sums = {name: digest for name, digest in SUMS.items() if "darwin-arm64" not in name}
        with self.assertRaisesRegex(LabError, "darwin-arm64"):
            release.krew("1.2.3", "https://x.example", sums)
