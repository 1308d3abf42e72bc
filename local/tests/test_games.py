"""The guessing game as plain processes: its exact score, and that each agent and each evaluator of local/games does what its tests need."""

import json
import os
import socket
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

from labkit import image

REPOSITORY = Path(__file__).resolve().parents[2]
EXAMPLE = REPOSITORY / "examples" / "challenges" / "guessing-game"
GAMES = REPOSITORY / "local" / "games"
# Of the table in local/games/README.md: the guesses of each game, by worker.
SEED = "window"
PLAYED = {1: [7, 9, 4, 10], 2: [10, 10, 7, 9]}
SECONDS = 30


def free_ports() -> int:
    """A port that is free together with the one that the second worker has."""
    while True:
        with socket.socket() as first, socket.socket() as second:
            first.bind(("127.0.0.1", 0))
            port = int(first.getsockname()[1])
            try:
                second.bind(("127.0.0.1", port + 100))
            except (OSError, OverflowError):
                continue
            return port


class Games(unittest.TestCase):
    def setUp(self) -> None:
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)
        self.port = free_ports()

    def start(self, program: Path, worker: int, **variables: str) -> subprocess.Popen[bytes]:
        place = self.folder / f"{'evaluators' if 'evaluator' in program.name else 'agents'}-{worker}"
        place.mkdir(exist_ok=True)
        env = {
            "PATH": os.environ["PATH"],
            "WORKER": str(worker),
            "WORKERS": "2",
            "EVALUATOR_ADDRESS": f"127.0.0.1:{self.port + 100 * (worker - 1)}",
            **variables,
        }
        env |= (
            {"RESULTS": str(place), "GAMES": "8", "SEED": SEED}
            if "evaluator" in program.name
            else {"FOLDER": str(place)}
        )
        log = (place / "log").open("ab")
        self.addCleanup(log.close)
        process = subprocess.Popen([sys.executable, "-u", str(program)], env=env, stdout=log, stderr=log)
        self.addCleanup(process.wait)
        self.addCleanup(process.kill)
        return process

    def evaluator(
        self, worker: int, program: Path = EXAMPLE / "evaluator.py", **variables: str
    ) -> subprocess.Popen[bytes]:
        """An evaluator that listens."""
        process = self.start(program, worker, **variables)
        while process.poll() is None:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", self.port + 100 * (worker - 1))) == 0:
                    return process
        self.fail((self.folder / f"evaluators-{worker}" / "log").read_text())

    def hostile(self, kind: str, worker: int) -> subprocess.Popen[bytes]:
        return self.start(GAMES / "agent.py", worker, KIND=kind)

    def result(self, worker: int) -> dict[str, object]:
        return json.loads((self.folder / f"evaluators-{worker}" / "result.json").read_text())

    def assert_exact(self, worker: int) -> None:
        played = PLAYED[worker]
        metrics = {"guesses": sum(played) / 4, "found": 1.0}
        expected = {"schema": 1, "done": 4, "total": 4, "final": True, "splits": [{"name": "test", "metrics": metrics}]}
        self.assertEqual(self.result(worker), expected)
        self.assertEqual(json.loads((self.folder / f"evaluators-{worker}" / "games.json").read_text()), played)

    def test_the_example_has_the_score_that_was_worked_out_by_hand(self) -> None:
        for worker in PLAYED:
            evaluator = self.evaluator(worker)
            self.assertEqual(self.start(EXAMPLE / "agent.py", worker).wait(SECONDS), 0)
            self.assertEqual(evaluator.wait(SECONDS), 0)
            self.assert_exact(worker)
        rows = [line.split("|") for line in (GAMES / "README.md").read_text().splitlines() if line.startswith("| ")]
        games = [[int(row[2]), len(row[4].split(",")), int(row[5])] for row in rows if row[1].strip().isdigit()]
        self.assertEqual([count for _, count, _ in games], [count for _, _, count in games])
        told = {worker: [count for own, _, count in games if own == worker] for worker in PLAYED}
        self.assertEqual(told, PLAYED)

    def test_one_that_is_ended_goes_on_with_the_games_that_are_left(self) -> None:
        for kind, worker, done in (("hold", 1, 1), ("hold", 2, 3), ("crash-once", 1, 1)):
            with self.subTest(kind=kind, worker=worker):
                self.setUp()
                evaluator = self.evaluator(worker)
                agent = self.hostile(kind, worker)
                while self.result(worker)["done"] != done:
                    self.assertIn(agent.poll(), (None, 1))
                if kind == "crash-once":
                    self.assertEqual(agent.wait(SECONDS), 1)
                agent.kill()
                evaluator.kill()
                evaluator.wait()
                evaluator = self.evaluator(worker, RESUME="1")
                self.assertEqual(self.result(worker)["done"], done)
                self.assertEqual(self.hostile(kind, worker).wait(SECONDS), 0)
                self.assertEqual(evaluator.wait(SECONDS), 0)
                self.assert_exact(worker)

    def test_what_an_agent_sends_changes_no_score(self) -> None:
        evaluator = self.evaluator(1)
        self.assertEqual(self.hostile("provoke", 1).wait(SECONDS), 0)
        self.assertEqual(evaluator.wait(SECONDS), 0)
        self.assert_exact(1)

    def test_an_agent_that_plays_another_workers_games_wins_nothing(self) -> None:
        evaluators = [self.evaluator(worker) for worker in PLAYED]
        self.assertEqual(self.hostile("other-worker", 2).wait(SECONDS), 0)
        for worker, evaluator in zip(PLAYED, evaluators, strict=True):
            self.assertEqual(evaluator.wait(SECONDS), 0)
            self.assert_exact(worker)
        self.assertIn("a second session: 400\n", (self.folder / "agents-2" / "log").read_text())

    def test_an_agent_that_ends_early_has_played_one_game(self) -> None:
        self.evaluator(2)
        self.assertEqual(self.hostile("exit-early", 2).wait(SECONDS), 0)
        self.assertEqual((self.result(2)["done"], self.result(2)["final"]), (1, False))

    def test_an_agent_takes_the_port_of_an_evaluator_that_it_has_ended(self) -> None:
        evaluator = self.evaluator(2, GAMES / "evaluator.py", FAULT="none")
        self.hostile("take-port", 1)
        self.assertEqual(self.hostile("take-port", 2).wait(SECONDS), 1)
        self.assertEqual(evaluator.wait(SECONDS), 1)
        log = self.folder / "agents-1" / "log"
        while "taken" not in log.read_text():
            pass
        again = self.start(GAMES / "evaluator.py", 2, FAULT="none")
        self.assertEqual(again.wait(SECONDS), 1)

    def test_each_evaluator_has_its_fault(self) -> None:
        for fault, code, part in (
            ("none", 0, '"guesses": 3.5'),
            ("late", 0, '"guesses": 3.5'),
            ("nan", 0, '"guesses": NaN'),
            ("no-score", 0, '"metrics": {"found": 1.0}'),
            ("two-splits", 0, '"hard"'),
            ("not-eligible", 0, '"eligible": false'),
            ("refuse", 0, '"refused": "The agent'),
            ("exit-65", 65, ""),
        ):
            with self.subTest(fault):
                self.setUp()
                evaluator = self.evaluator(1, GAMES / "evaluator.py", FAULT=fault)
                self.assertEqual(self.start(EXAMPLE / "agent.py", 1).wait(SECONDS), 0)
                self.assertEqual(evaluator.wait(SECONDS), code)
                result = self.folder / "evaluators-1" / "result.json"
                self.assertIn(part, result.read_text() if result.exists() else "")


class Images(unittest.TestCase):
    def test_the_examples_images_are_those_of_its_dockerfile(self) -> None:
        stages = (EXAMPLE / "Dockerfile").read_text().split("FROM ")[1:]
        specs = {spec.name: spec for spec in image.specs(GAMES / "images.toml")}
        for stage in stages:
            name = stage.split()[2]
            spec = specs[f"guessing-game/{name}:1"]
            copied = [(item.value, item.to) for item in spec.files if item.kind == "repo"]
            [(source, target)] = [line.split()[1:] for line in stage.splitlines() if line.startswith("COPY")]
            self.assertEqual(copied, [(str((EXAMPLE / source).relative_to(REPOSITORY)), target)])
            self.assertIn(f"USER {spec.user}\n", stage)
            self.assertEqual((spec.entrypoint, spec.cmd, spec.env), ((), (), {}))

    def test_every_file_of_an_image_is_there(self) -> None:
        for spec in image.specs(GAMES / "images.toml"):
            for item in spec.files:
                self.assertTrue(item.kind != "repo" or (REPOSITORY / item.value).is_file(), item.value)


if __name__ == "__main__":
    unittest.main()
