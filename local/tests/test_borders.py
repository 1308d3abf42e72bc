"""What the crate that decides depends on: nothing that waits, listens, reads a clock or speaks to a server."""

import subprocess
import tomllib
import unittest
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
POLICY = REPOSITORY / "crates/policy"
REFUSED = ("tokio", "hyper", "reqwest", "tower", "kube-client", "kube-runtime", "leaderboard-base", "leaderboard-aws")
# Clocks, environment, files and network: Cargo cannot refuse these, clippy does.
DISALLOWED = {
    "jiff::Timestamp::now",
    "jiff::Zoned::now",
    "std::time::Instant::now",
    "std::time::SystemTime::now",
    "std::env::var",
    "std::env::vars",
    "std::fs::read",
    "std::fs::read_to_string",
    "std::fs::File::open",
    "std::net::TcpStream::connect",
}


class Borders(unittest.TestCase):
    def test_what_decides_depends_on_no_client_and_no_runtime(self) -> None:
        argv = ("cargo", "tree", "--locked", "--package", "leaderboard-policy", "--edges", "normal", "--prefix", "none")
        tree = subprocess.run(argv, cwd=REPOSITORY, check=True, capture_output=True, text=True).stdout
        found = {line.split()[0] for line in tree.splitlines() if line}
        self.assertIn("leaderboard-policy", found)
        self.assertEqual({name for name in found if name in REFUSED or name.startswith("aws-")}, set())

    def test_the_types_of_kube_come_by_the_api_alone(self) -> None:
        manifest = tomllib.loads((POLICY / "Cargo.toml").read_text())
        self.assertNotIn("kube", manifest["dependencies"])

    def test_clippy_refuses_clocks_environment_files_and_network(self) -> None:
        rules = tomllib.loads((POLICY / "clippy.toml").read_text())
        refused = {rule["path"] for rule in rules["disallowed-methods"]}
        self.assertEqual(DISALLOWED - refused, set())

    def test_a_crate_with_rules_of_its_own_has_those_of_the_workspace_too(self) -> None:
        of_workspace = tomllib.loads((REPOSITORY / "clippy.toml").read_text())
        clocks = {rule["path"] for rule in of_workspace.pop("disallowed-methods")}
        self.assertIn("jiff::Timestamp::now", clocks)
        for path in REPOSITORY.glob("crates/*/clippy.toml"):
            with self.subTest(path.parent.name):
                rules = tomllib.loads(path.read_text())
                self.assertEqual(clocks - {rule["path"] for rule in rules["disallowed-methods"]}, set())
                self.assertEqual({name: rules.get(name) for name in of_workspace}, of_workspace)
