"""Owns the test of the chart's alerts: when each fires, by Prometheus' own tool."""

import re
import subprocess
from pathlib import Path

from .errors import LabError

TOOL = "promtool"
ALERT = re.compile(r"^\s+- alert: (\w+)$", re.MULTILINE)
CASE = re.compile(r"^\s+- name: (.+)$", re.MULTILINE)
# What is tested of each alert.
CASES = ("fires", "is silent")


def fire(repository: Path, folder: Path) -> str:
    """Checks the rules' text and runs their tests, which must cover each alert."""
    rules = repository / "charts" / "leaderboard-operator" / "files" / "alerts.yaml"
    tests = repository / "local" / "alerts" / "alerts.test.yaml"
    missing = untested(rules.read_text(), tests.read_text())
    if missing:
        raise LabError(f"{tests} has no test named {', '.join(missing)}: write one as the others are")
    for argv in (["check", "rules", str(rules)], ["test", "rules", str(tests)]):
        done = subprocess.run([str(folder / TOOL), *argv], capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise LabError(f"promtool {' '.join(argv[:2])}: {(done.stdout + done.stderr).strip()[-1500:]}")
    return f"{len(ALERT.findall(rules.read_text()))} alerts"


def untested(rules: str, tests: str) -> list[str]:
    """The tests that the alerts lack, by name."""
    known = set(CASE.findall(tests))
    return [name for alert in ALERT.findall(rules) for case in CASES if (name := f"{alert} {case}") not in known]
