"""The challenges of the tests as plain processes: exact scores, and that each program of local/games does what its tests need."""

import csv
import json
import os
import socket
import stat
import subprocess
import sys
import tempfile
import unittest
from dataclasses import replace
from pathlib import Path

from labkit import image
from labkit.errors import LabError
from labkit.process import wait_until
from labkit.settings import Settings

REPOSITORY = Path(__file__).resolve().parents[2]
EXAMPLES = REPOSITORY / "examples" / "challenges"
EXAMPLE, CLASSIFICATION = EXAMPLES / "guessing-game", EXAMPLES / "classification"
GAMES = REPOSITORY / "local" / "games"
# Of the table in local/games/README.md: the guesses of each game, by worker.
SEED = "window"
PLAYED = {1: [7, 9, 4, 10], 2: [10, 10, 7, 9]}
# Of its other table: how many of each worker's rows are right in the first half, in the second, and by a blind guess.
RIGHT = {1: (34, 41, 40), 2: (39, 44, 38)}
HALF = 50
SECONDS = 30
# Between two looks at what can't be watched: a test that looks without a pause takes the processor from what it waits for.
PAUSE = 0.01


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

        def listens() -> bool:
            with socket.socket() as probe:
                return probe.connect_ex(("127.0.0.1", self.port + 100 * (worker - 1))) == 0

        wait_until(lambda: listens() or process.poll() is not None, SECONDS, PAUSE)
        self.assertIsNone(process.poll(), (self.folder / f"evaluators-{worker}" / "log").read_text())
        return process

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
                played = wait_until(
                    lambda worker=worker, done=done: self.result(worker)["done"] == done, SECONDS, PAUSE
                )
                self.assertTrue(played, agent.poll())
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
        self.assertTrue(wait_until(lambda: "taken" in log.read_text(), SECONDS, PAUSE))
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


class Classification(unittest.TestCase):
    def setUp(self) -> None:
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)
        for name in ("submission", "agent", "results-1", "results-2"):
            (self.folder / name).mkdir()
        subprocess.run([sys.executable, str(CLASSIFICATION / "data.py"), str(self.folder)], check=True)

    def start(self, program: Path, **variables: str) -> subprocess.Popen[str]:
        """An agent or an evaluator, and with it what the operator tells it."""
        env = {
            "PATH": os.environ["PATH"],
            "PYTHONDONTWRITEBYTECODE": "1",
            "TRACK": "test",
            "DATASET": str(self.folder / "dataset"),
            "SUBMISSION_PATH": str(self.folder / "submission"),
            "FOLDER": str(self.folder / "agent"),
            "EXAMPLE": str(CLASSIFICATION / "agent.py"),
            **variables,
        }
        argv = [sys.executable, "-u", str(program)]
        process = subprocess.Popen(argv, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        self.addCleanup(process.communicate)
        self.addCleanup(process.kill)
        return process

    def agent(self, kind: str, code: int = 0, **variables: str) -> str:
        """What an agent prints that ends with this code."""
        process = self.start(GAMES / "classification_agent.py", TRACK=kind, **variables)
        printed, _ = process.communicate(timeout=SECONDS)
        self.assertEqual(process.returncode, code, printed)
        return printed

    def evaluator(self, worker: object, fault: str, splits: str, resume: str, **more: str) -> subprocess.Popen[str]:
        place = self.folder / f"results-{worker}"
        return self.start(
            GAMES / "classification_evaluator.py",
            INPUT=str(self.folder / "submission"),
            LABELS=str(self.folder / "labels"),
            RESULTS=str(place),
            WORKER=str(worker),
            WORKERS="2",
            RESUME=resume,
            FAULT=fault,
            SPLITS=splits,
            **more,
        )

    def result(self, worker: int) -> dict[str, object]:
        file = self.folder / f"results-{worker}" / "result.json"
        return json.loads(file.read_text()) if file.exists() else {}

    def left(self) -> list[Path]:
        return sorted((self.folder / "submission").iterdir())

    def assert_predicted(self) -> None:
        """What the example's agent leaves is there."""
        found = (self.folder / "submission" / "predictions.csv").read_bytes()
        self.agent("predict")
        self.assertEqual(found, (self.folder / "submission" / "predictions.csv").read_bytes())

    def test_an_evaluator_that_is_ended_goes_on_to_the_score_that_was_worked_out_by_hand(self) -> None:
        self.agent("predict")
        for fault, splits, first, last in (
            ("hold", "test", ["test"], ["test"]),
            ("crash-once", "easy,hard", ["easy"], ["easy", "hard"]),
        ):
            for worker, (easy, hard, _) in RIGHT.items():
                with self.subTest(fault=fault, worker=worker):
                    process = self.evaluator(worker, fault, splits, "")
                    if fault == "hold":
                        begun = wait_until(lambda worker=worker: "done" in self.result(worker), SECONDS, PAUSE)
                        self.assertTrue(begun, process.poll())
                    if fault == "crash-once":
                        self.assertEqual(process.wait(SECONDS), 1)
                    process.kill()
                    rates = [easy / HALF]
                    self.assert_result(worker, HALF, dict(zip(first, rates, strict=True)))
                    again = self.evaluator(worker, fault, splits, "1")
                    printed, _ = again.communicate(timeout=SECONDS)
                    self.assertEqual((again.returncode, printed), (0, f"goes on after {HALF} rows\n"))
                    rates = [easy / HALF, hard / HALF] if len(last) == 2 else [(easy + hard) / 2 / HALF]
                    self.assert_result(worker, 2 * HALF, dict(zip(last, rates, strict=True)))
                    for file in (self.folder / f"results-{worker}").iterdir():
                        file.unlink()

    def test_the_one_that_merges_takes_the_median_of_all_halves(self) -> None:
        self.agent("predict")
        (self.folder / "parts").mkdir()
        for worker in RIGHT:
            self.assertEqual(self.evaluator(worker, "none", "test", "").wait(SECONDS), 0)
            (self.folder / "parts" / str(worker)).symlink_to(self.folder / f"results-{worker}")
        (self.folder / "results-merge").mkdir()
        for resume, code in (("", 1), ("1", 0)):
            merge = self.evaluator("merge", "crash-once", "test", resume, PARTS=str(self.folder / "parts"))
            self.assertEqual(merge.wait(SECONDS), code)
        splits = [{"name": "test", "metrics": {"median": 0.8}}]
        expected = {"schema": 1, "done": 1, "total": 1, "final": True, "splits": splits}
        self.assertEqual(json.loads((self.folder / "results-merge" / "result.json").read_text()), expected)

    def assert_result(self, worker: int, done: int, rates: dict[str, float]) -> None:
        splits = [{"name": name, "metrics": {"accuracy": rate}} for name, rate in rates.items()]
        expected = {"schema": 1, "done": done, "total": 2 * HALF, "final": done == 2 * HALF, "splits": splits}
        self.assertEqual(self.result(worker), expected)

    def test_the_page_has_these_numbers(self) -> None:
        page = (GAMES / "README.md").read_text()
        with (self.folder / "labels" / "labels.csv").open(newline="") as text:
            labels = {row["id"]: row["category"] for row in csv.DictReader(text)}
        for worker, numbers in RIGHT.items():
            own = sorted(labels)[worker - 1 :: 2]
            self.assertEqual(sum(labels[row] == "Lo" for row in own), numbers[2])
            self.assertIn(f"| worker {worker} | {' | '.join(map(str, numbers))} |\n", page)

    def test_an_agent_that_crashes_predicts_in_its_next_life(self) -> None:
        self.assertEqual(self.agent("crash-once", code=1), "crashes\n")
        self.agent("crash-once")
        self.assert_predicted()

    def test_what_agents_leave_that_no_evaluator_may_get(self) -> None:
        predictions = self.folder / "submission" / "predictions.csv"
        for kind, names in (
            ("link-labels", ["predictions.csv"]),
            ("link-dataset", ["data", "predictions.csv"]),
            ("sparse", ["predictions.csv"]),
            ("fifo", ["predictions.csv"]),
            ("nothing", []),
        ):
            with self.subTest(kind):
                self.agent(kind)
                self.assertEqual([path.name for path in self.left()], names)
                found = predictions.lstat() if names else None
                seen = {
                    "link-labels": found and predictions.is_symlink() and str(predictions.readlink()),
                    "link-dataset": (predictions.parent / "data").is_symlink(),
                    "sparse": found and (found.st_size, found.st_blocks < 2048),
                    "fifo": found and stat.S_ISFIFO(found.st_mode),
                    "nothing": True,
                }[kind]
                expected = {"link-labels": "/labels/labels.csv", "sparse": (10 << 30, True)}
                self.assertEqual(seen, expected.get(kind, True))
                for path in self.left():
                    path.unlink()
        self.agent("many")
        self.assertEqual(len(self.left()), 1001)

    def test_an_agent_that_searches_finds_what_it_can_read(self) -> None:
        printed = self.agent("search", ROOT=str(self.folder), LABELS="anything").splitlines()
        for found in ("variable LABELS", str(self.folder / "labels" / "labels.csv"), "a dataset that it can change"):
            self.assertIn(found, printed[0])
        self.assert_predicted()

    def test_an_agent_that_hangs_says_so(self) -> None:
        process = self.start(GAMES / "classification_agent.py", KIND="hang")
        assert process.stdout
        self.assertEqual(process.stdout.readline(), "waits\n")
        self.assertIsNone(process.poll())


class Images(unittest.TestCase):
    def test_the_examples_images_are_those_of_their_dockerfiles(self) -> None:
        specs = {spec.name: spec for spec in image.specs(GAMES / "images.toml")}
        for example in sorted(file.parent for file in EXAMPLES.glob("*/Dockerfile")):
            stages = (example / "Dockerfile").read_text().split("FROM ")[1:]
            # The others only make what these copy.
            made = {stage.split()[2]: stage for stage in stages if "USER " in stage}
            for name, stage in made.items():
                spec = specs[f"{example.name}/{name}:1"]
                found = [(item.value, item.to) for item in spec.files if item.kind != "python"]
                [words] = [line.split()[1:] for line in stage.splitlines() if line.startswith("COPY")]
                self.assertEqual(found, copied(example, words), spec.name)
                has_python = any(item.kind == "python" for item in spec.files)
                self.assertEqual(has_python, stage.startswith("python:"), spec.name)
                self.assertIn(f"USER {spec.user}\n", stage)
                self.assertEqual((spec.entrypoint, spec.cmd, spec.env), ((), (), {}))

    def test_every_file_of_an_image_is_there(self) -> None:
        for spec in image.specs(GAMES / "images.toml"):
            for item in spec.files:
                place = REPOSITORY / item.value.split(" ")[0]
                self.assertTrue(item.kind == "python" or place.is_file(), item.value)

    def test_a_program_makes_the_files_of_an_image(self) -> None:
        specs = {spec.name: spec for spec in image.specs(GAMES / "images.toml")}
        settings = Settings(
            REPOSITORY, REPOSITORY / ".local", Path("/nowhere"), {}, internet=False, builds_containerd=False
        )
        nothing = image.Search({}, Path(), "")
        for name, files in (
            ("dataset", ["/dataset/test.csv", "/dataset/train.csv"]),
            ("labels", ["/labels/labels.csv"]),
        ):
            [item] = specs[f"classification/{name}:1"].files
            entries = list(image.file_entries(settings, item, nothing, name))
            self.assertEqual([entry.path for entry in entries if not entry.is_dir], files)
            self.assertTrue(all(entry.content for entry in entries if not entry.is_dir))
            wrong = replace(item, value=f"{item.value}s")
            with self.assertRaisesRegex(LabError, f"writes no folder '{name}s'"):
                list(image.file_entries(settings, wrong, nothing, name))


def copied(example: Path, words: list[str]) -> list[tuple[str, str]]:
    """What a line COPY of an example puts where, in the words of an image file."""
    place = str(example.relative_to(REPOSITORY))
    if words[0].startswith("--from="):
        return [(f"{place}/data.py {Path(words[1]).name}", words[2])]
    *sources, target = words
    return [(f"{place}/{source}", target + source if target.endswith("/") else target) for source in sources]


if __name__ == "__main__":
    unittest.main()
