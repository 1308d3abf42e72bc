"""What Artifact Hub reads: the chart's own files are right, and each mistake is named."""

import unittest
from pathlib import Path

from labkit import artifacthub, release

REPOSITORY = Path(__file__).resolve().parents[2]


class Shape(unittest.TestCase):
    def setUp(self) -> None:
        self.chart = (REPOSITORY / artifacthub.CHART).read_text()
        self.own = (REPOSITORY / artifacthub.REPOSITORY_FILE).read_text()
        self.version = release.version(REPOSITORY)

    def faults(self, old: str, new: str) -> list[str]:
        self.assertIn(old, self.chart)
        return list(artifacthub.faults(self.chart.replace(old, new), self.own, self.version))

    def test_the_charts_own(self) -> None:
        self.assertEqual(list(artifacthub.faults(self.chart, self.own, self.version)), [])

    def test_each_mistake_is_named(self) -> None:
        for old, new, word in (
            ("artifacthub.io/license", "artifacthub.io/licence", "artifacthub.io/licence is none"),
            ("kind: added", "kind: new", "'kind': 'new'"),
            ("url: https", "url: http", "https address"),
            (f"leaderboard-operator:{self.version}", "leaderboard-operator:9.9.9", "9.9.9"),
            ('prerelease: "true"', 'prerelease: "yes"', "prerelease is neither"),
            (f"/blob/v{self.version}/docs/security", "/blob/v9.9.9/docs/security", "another version"),
            ("Basic Install", "Everything", "operatorCapabilities"),
        ):
            with self.subTest(word):
                self.assertTrue(any(word in fault for fault in self.faults(old, new)), self.faults(old, new))

    def test_the_icon_is_a_file_of_this_version(self) -> None:
        self.assertEqual(list(artifacthub.icon_faults(self.chart, self.version, REPOSITORY)), [])
        for old, new, word in (
            ("icon: ", "logo: ", "no icon"),
            (f"/raw/v{self.version}/", "/raw/v9.9.9/", "another version"),
            ("logo.svg", "none.svg", "does not exist"),
        ):
            found = list(artifacthub.icon_faults(self.chart.replace(old, new), self.version, REPOSITORY))
            self.assertEqual([word in fault for fault in found], [True], found)

    def test_a_repository_without_an_owner(self) -> None:
        found = list(artifacthub.faults(self.chart, "repositoryID: x\n", self.version))
        self.assertEqual(found, [f"{artifacthub.REPOSITORY_FILE} names no owner with an email"])
