"""The version in its three places, and the manifest of krew."""

import re
import subprocess
import tempfile
import tomllib
import unittest
from pathlib import Path

from labkit import doccheck, release
from labkit.errors import LabError

REPOSITORY = Path(__file__).resolve().parents[2]
WORKFLOWS = REPOSITORY / ".github" / "workflows"
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


class Owner(unittest.TestCase):
    """The account that publishes the project stands in one place, Cargo.toml, and one command writes it elsewhere."""

    def test_no_file_names_another_account(self) -> None:
        own = {release.owner(REPOSITORY), "${OWNER,,}", "$GITHUB_REPOSITORY"}
        found = {}
        for file in doccheck.tracked(REPOSITORY):
            if file == "local/tests/test_release.py":
                continue
            text = (REPOSITORY / file).read_text(errors="replace") if (REPOSITORY / file).is_file() else ""
            names = re.findall(
                r"github\.com/([\w.$-]+)/leaderboard-operator|ghcr\.io/([\w${},.-]+)/(?:leaderboard|chart|challenge|stand)",
                text,
            )
            if names:
                found[file] = {"".join(name) for name in names}
        self.assertGreater(len(found), 5)
        self.assertEqual({file: names - own for file, names in found.items() if names - own}, {})

    def test_the_command_changes_every_place(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            root = Path(folder)
            subprocess.run(["git", "init", "--quiet", folder], check=True)
            (root / "Cargo.toml").write_text(
                '[workspace.package]\nrepository = "https://github.com/OWNER/leaderboard-operator"\n'
            )
            (root / "a.md").write_text(
                "ghcr.io/OWNER/charts `ghcr.io/OWNER` --repo OWNER/leaderboard-operator @OWNER/leaderboard-operator-x\nOWNER_KEY\n"
            )
            (root / "b.md").write_text("const OWNER: &str;\n")
            subprocess.run(["git", "-C", folder, "add", "--all"], check=True)
            self.assertEqual(release.set_owner(root, "Acme-AI"), ["Cargo.toml", "a.md"])
            self.assertEqual(release.owner(root), "Acme-AI")
            self.assertEqual(
                (root / "a.md").read_text(),
                "ghcr.io/acme-ai/charts `ghcr.io/acme-ai` --repo Acme-AI/leaderboard-operator"
                " @Acme-AI/leaderboard-operator-x\nOWNER_KEY\n",
            )

    def test_a_name_that_is_none_is_refused(self) -> None:
        for name in ("", "-a", "a/b", "a b", "a--b"):
            with self.subTest(name), self.assertRaisesRegex(LabError, "no account"):
                release.set_owner(REPOSITORY, name)


class Krew(unittest.TestCase):
    def test_each_machine_has_its_archive_with_its_sum(self) -> None:
        platforms = release.krew("1.2.3", "https://x.example/v1.2.3/", SUMS)["spec"]["platforms"]
        self.assertEqual(len(platforms), 5)
        windows = platforms[-1]
        self.assertEqual(windows["selector"]["matchLabels"], {"os": "windows", "arch": "amd64"})
        self.assertEqual(windows["uri"], "https://x.example/v1.2.3/kubectl-leaderboard-1.2.3-windows-amd64.tar.gz")
        self.assertEqual((windows["bin"], windows["sha256"]), ("kubectl-leaderboard.exe", "0" * 64))
        files = [file["from"] for file in windows["files"]]
        self.assertEqual(files, ["kubectl-leaderboard.exe", "LICENSE", "man1/*"])

    def test_a_missing_archive_is_named(self) -> None:
        sums = {name: digest for name, digest in SUMS.items() if "darwin-arm64" not in name}
        with self.assertRaisesRegex(LabError, "darwin-arm64"):
            release.krew("1.2.3", "https://x.example", sums)


class Workflows(unittest.TestCase):
    """What can be known of them without running them."""

    def setUp(self) -> None:
        self.release = (WORKFLOWS / "release.yaml").read_text()

    def test_every_action_is_pinned_to_a_commit_with_its_version(self) -> None:
        for file in sorted(WORKFLOWS.iterdir()):
            used = re.findall(r"uses: (.+)", file.read_text())
            self.assertTrue(used, file.name)
            for action in used:
                self.assertRegex(action, r"^[\w./-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+$", file.name)

    def test_no_job_has_more_rights_than_it_names(self) -> None:
        for file in sorted(WORKFLOWS.iterdir()):
            top = re.search(r"^permissions:\n((?:  .+\n)+)", file.read_text(), re.MULTILINE)
            self.assertIsNotNone(top, file.name)
            self.assertEqual(top[1] if top else "", "  contents: read\n", file.name)

    def test_the_plugin_is_built_for_each_machine_of_the_manifest_under_its_name(self) -> None:
        built = dict(re.findall(r"- \{name: ([\w-]+), runner: \S+ target: \S+ program: ([\w.-]+)\}", self.release))
        self.assertEqual(built, {name: program for name, (_, _, program) in release.PLATFORMS.items()})
        name = re.search(r"ARCHIVE: (.+)", self.release)
        expected = release.archive("${{ needs.plan.outputs.version }}", "${{ matrix.name }}")
        self.assertEqual(name[1] if name else "", expected)

    def test_the_archives_hold_the_manual_pages_that_the_program_writes(self) -> None:
        self.assertIn("--package kubectl-leaderboard -- man man1\n", self.release)
        self.assertRegex(self.release, r"name: manual\n +path: man1/\*\.1\n")
        self.assertRegex(self.release, r"name: manual\n +path: archive/man1\n")
        self.assertRegex(self.release, r"tar --create .+ --directory archive \"\$PROGRAM\" LICENSE man1\n")

    def test_the_bases_that_are_resolved_are_those_of_the_dockerfile(self) -> None:
        dockerfile = (REPOSITORY / "Dockerfile").read_text()
        used = re.findall(r"^FROM (\S+)", dockerfile, re.MULTILINE)
        self.assertEqual(used, ["${BUILD_IMAGE}", "${BASE_IMAGE}"])
        for name in ("BUILD_IMAGE", "BASE_IMAGE"):
            self.assertRegex(dockerfile, rf"(?m)^ARG {name}=\S+:\S+$")
            self.assertIn(f'--build-arg "{name}=${name}"', self.release)

    def test_no_dockerfile_of_a_release_takes_its_frontend_by_a_tag(self) -> None:
        for name in ("Dockerfile", "local/quickstart/Dockerfile"):
            self.assertNotRegex((REPOSITORY / name).read_text(), r"(?m)^# *syntax=", name)

    def test_advisories_are_asked_for_every_week_and_before_a_release(self) -> None:
        weekly = (WORKFLOWS / "advisories.yml").read_text()
        self.assertIn("- cron:", weekly)
        self.assertIn("cargo deny --locked check advisories", weekly)
        self.assertIn("cargo deny --locked check\n", self.release)

    def test_images_and_chart_and_checksums_are_signed(self) -> None:
        for signed in ('"$IMAGE@$digest"', '"$made"', "checksums.txt"):
            self.assertRegex(self.release, rf"cosign sign(-blob)? --yes .*{re.escape(signed)}")
        # Images and charts that are pushed elsewhere are handed to the job that signs it.
        for pushed in ('"$IMAGE@$digest" > "made/${IMAGE##*/}"', '"$CHARTS/leaderboard-operator@$digest" > made/chart'):
            self.assertIn(f"echo {pushed}\n", self.release)

    def test_no_job_that_builds_may_sign_or_publish(self) -> None:
        powers = ("id-token: write", "attestations: write", "contents: write")
        jobs = dict(
            re.findall(r"^  (\w+):\n((?:(?:    .*)?\n|  #.*\n)+)", self.release.split("\njobs:\n")[1], re.MULTILINE)
        )
        self.assertIn("draft", jobs)
        mighty = {name for name, text in jobs.items() if any(power in text for power in powers)}
        self.assertEqual(mighty, {"index", "sign", "draft"})
        for name in mighty:
            # Neither the repository's programs nor those of a registry of packages.
            for word in ("checkout", "cargo", "rustup", "make ", "local/", "buildx build", "npm", "pip"):
                self.assertNotIn(word, jobs[name], f"{name}: {word}")


class Crates(unittest.TestCase):
    def test_every_crate_comes_from_one_public_registry_with_its_checksum(self) -> None:
        packages = tomllib.loads((REPOSITORY / "Cargo.lock").read_text())["package"]
        foreign = [package for package in packages if "source" in package]
        self.assertEqual(len({package["source"] for package in foreign}), 1)
        self.assertTrue(all(package["source"].startswith("registry+") for package in foreign))
        self.assertEqual([package["name"] for package in foreign if "checksum" not in package], [])

    def test_no_crate_of_the_operator_may_be_unsafe(self) -> None:
        workspace = tomllib.loads((REPOSITORY / "Cargo.toml").read_text())["workspace"]
        self.assertEqual(workspace["lints"]["rust"]["unsafe_code"], "forbid")
        for member in (".", *(member for member in workspace["members"] if member.startswith("crates/"))):
            manifest = tomllib.loads((REPOSITORY / member / "Cargo.toml").read_text())
            self.assertEqual(manifest["lints"], {"workspace": True}, member)

    def test_nothing_turns_the_verification_of_tls_off(self) -> None:
        sources = [*(REPOSITORY / "src").rglob("*.rs"), *(REPOSITORY / "crates").rglob("*.rs")]
        switches = re.compile(r"danger_\w+|dangerous\(|accept_invalid\w*|ServerCertVerifier|insecure_skip")
        self.assertGreater(len(sources), 200)
        self.assertEqual([str(file) for file in sources if switches.search(file.read_text())], [])
