"""The examples of challenges whose submissions are files, as plain processes: exact scores, wrong files, and what fits on a screen."""

import csv
import json
import os
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

EXAMPLES = Path(__file__).resolve().parents[2] / "examples" / "challenges"
CLASSIFICATION, PREDICTIONS = EXAMPLES / "classification", EXAMPLES / "predictions"
SECONDS = 30
# How many of the 100 rows of each worker the example's agent gets right, and of all 200.
RIGHT = {1: 75, 2: 83}
ACCURACY = 0.79


class Challenge(unittest.TestCase):
    def setUp(self) -> None:
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)
        for name in ("submission", "results"):
            (self.folder / name).mkdir()
        self.run_program(CLASSIFICATION / "data.py", str(self.folder))

    def run_program(self, program: Path, *arguments: str, code: int = 0, **variables: str | None) -> str:
        """What it prints, if it ends with this code. A variable that is None is not set."""
        env: dict[str, str | None] = {
            "PATH": os.environ["PATH"],
            "DATASET": str(self.folder / "dataset"),
            "SUBMISSION_PATH": str(self.folder / "submission"),
            "INPUT": str(self.folder / "submission"),
            "LABELS": str(self.folder / "labels"),
            "ANNOTATIONS": str(self.folder / "labels" / "labels.csv"),
            "RESULTS": str(self.folder / "results"),
            "TRACK": "test",
            "WORKER": "1",
            "WORKERS": "1",
            "PYTHONDONTWRITEBYTECODE": "1",
            **variables,
        }
        argv = [sys.executable, str(program), *arguments]
        given = {name: value for name, value in env.items() if value is not None}
        done = subprocess.run(argv, env=given, capture_output=True, text=True, timeout=SECONDS, check=False)
        self.assertEqual(done.returncode, code, done.stderr)
        return done.stdout + done.stderr

    def submit(self, content: bytes | None, name: str = "predictions.csv") -> None:
        """Leaves a file as the submission, or the predictions of the example's agent."""
        if content is None:
            self.run_program(CLASSIFICATION / "agent.py")
            content = (self.folder / "submission" / "predictions.csv").read_bytes()
        (self.folder / "submission" / name).write_bytes(content)

    def result(self) -> dict[str, object]:
        found: dict[str, object] = json.loads((self.folder / "results" / "result.json").read_text())
        # What the operator asks of every result at the end, and what docs/evaluator-result.schema.json says of `final`.
        is_refused = bool(found.get("refused"))
        self.assertEqual((found["schema"], found["final"]), (1, not is_refused))
        self.assertTrue(is_refused or found["done"] == found["total"])
        return found


class Classification(Challenge):
    def evaluate(self, worker: int = 1, workers: int = 1) -> dict[str, object]:
        self.run_program(CLASSIFICATION / "evaluator.py", WORKER=str(worker), WORKERS=str(workers))
        return self.result()

    def test_the_data_are_split_and_the_labels_are_apart(self) -> None:
        files = {file.name: list(csv.DictReader(file.read_text().splitlines())) for file in self.folder.rglob("*.csv")}
        self.assertEqual([len(files[name]) for name in ("train.csv", "test.csv", "labels.csv")], [800, 200, 200])
        self.assertEqual({*files["test.csv"][0]}, {"id", "name"})
        self.assertFalse({row["name"] for row in files["train.csv"]} & {row["name"] for row in files["test.csv"]})
        self.assertEqual([row["id"] for row in files["test.csv"]], [row["id"] for row in files["labels.csv"]])
        inside = {file.name for file in (self.folder / "dataset").iterdir()}
        self.assertEqual(inside, {"train.csv", "test.csv"})

    def test_the_agent_has_the_same_score_each_time_and_the_workers_share_the_rows(self) -> None:
        self.submit(None)
        for worker, right in RIGHT.items():
            split = {"name": "test", "metrics": {"accuracy": right / 100}}
            expected = {"schema": 1, "final": True, "done": 100, "total": 100, "splits": [split]}
            self.assertEqual(self.evaluate(worker, len(RIGHT)), expected)
        self.assertEqual(self.evaluate()["splits"], [{"name": "test", "metrics": {"accuracy": ACCURACY}}])

    def test_a_file_that_is_no_list_of_all_ids_refuses_the_submission(self) -> None:
        self.submit(None)
        whole = (self.folder / "submission" / "predictions.csv").read_bytes()
        for content, word in (
            (b"", "ValueError: it must have the 200 ids"),
            (b"name,class\na,b\n", "KeyError"),
            (b"id,category\n0,\xff\xfe\n", "UnicodeDecodeError"),
            (b'id,category\n0,"' + b"x" * 200_000 + b'"\n', "Error"),
            (whole.rsplit(b"\r\n", 2)[0] + b"\r\n", "ValueError: it must have the 200 ids"),
            (whole + b"more,Lo\r\n", "ValueError: it must have the 200 ids"),
            (whole + b"0,Lo\r\n", "ValueError: it must have the 200 ids"),
        ):
            with self.subTest(content[-20:]):
                self.submit(content)
                # Every worker refuses it, whatever rows are its own.
                for worker in RIGHT:
                    self.assertIn(word, str(self.evaluate(worker, len(RIGHT)).get("refused", "")))
        (self.folder / "submission" / "predictions.csv").unlink()
        self.assertIn("FileNotFoundError", str(self.evaluate()["refused"]))
        (self.folder / "submission" / "predictions.csv").mkdir()
        self.assertIn("IsADirectoryError", str(self.evaluate()["refused"]))

    def test_a_file_of_a_spreadsheet_counts_as_any_other(self) -> None:
        self.submit(None)
        self.submit("\ufeff".encode() + (self.folder / "submission" / "predictions.csv").read_bytes())
        self.assertEqual(self.evaluate()["splits"], [{"name": "test", "metrics": {"accuracy": ACCURACY}}])

    def test_labels_that_are_missing_are_the_hosts_fault(self) -> None:
        self.submit(None)
        self.run_program(CLASSIFICATION / "evaluator.py", LABELS=str(self.folder / "none"), code=1)
        self.assertFalse((self.folder / "results" / "result.json").exists())


class Predictions(Challenge):
    """`shim.py` with the example's main.py, and with others that return or raise what hosts' scripts do."""

    def evaluate(self, script: str | None = None, code: int = 0, file: str = "main.py", **variables: str | None) -> str:
        """What it prints. Without a script, main.py is the example's."""
        place = self.folder / "evaluator"
        (place / file).parent.mkdir(parents=True, exist_ok=True)
        (place / "shim.py").write_text((PREDICTIONS / "shim.py").read_text())
        (place / file).write_text(script or (PREDICTIONS / "main.py").read_text())
        return self.run_program(place / "shim.py", code=code, **variables)

    def test_the_file_has_the_score_that_the_classification_gives_it(self) -> None:
        expected = {
            "schema": 1,
            "total": 1,
            "final": True,
            "done": 1,
            "splits": [{"name": "test", "metrics": {"accuracy": ACCURACY}}],
            "message": json.dumps({"accuracy": ACCURACY}),
        }
        self.submit(None, "file")
        of_a_spreadsheet = "\ufeff".encode() + (self.folder / "submission" / "file").read_bytes()
        for content in (None, of_a_spreadsheet):
            self.submit(content, "file")
            self.assertIn("Evaluating the phase test", self.evaluate())
            self.assertEqual(self.result(), expected)

    def test_a_wrong_file_is_refused_with_the_class_and_the_first_line(self) -> None:
        for content, refused in (
            (b"id,category\n0,Lo\n", "ValueError: the file must have the 200 ids of test.csv, each once"),
            (b"category,id\nLo\n", "ValueError: the file must have the 200 ids of test.csv, each once"),
            (b"a,b\n0,Lo\n", "KeyError: 'id'"),
            (b"id,category\n0,\xff\n", "UnicodeDecodeError: 'utf-8' codec"),
        ):
            with self.subTest(refused):
                self.submit(content, "file")
                self.evaluate()
                self.assertEqual(self.result()["splits"], [])
                self.assertTrue(str(self.result()["refused"]).startswith(refused), self.result())

    def test_errors_are_the_participants_or_the_hosts_by_their_class(self) -> None:
        """Those of pandas and json have a ValueError as their base, as here."""
        self.submit(b"", "file")
        raising = "import csv, json\nclass ParserError(ValueError): pass\ndef evaluate(*_, **more):\n    "
        for raised, refused in (
            ("raise ParserError('line 3\\nlong')", "ParserError: line 3"),
            ("json.loads('{')", "JSONDecodeError: Expecting property name"),
            ("raise csv.Error('NUL')", "Error: NUL"),
            ("assert 1 == 2, 'not the same number of rows'", "AssertionError: not the same number of rows"),
            ("[][0]", "IndexError: list index out of range"),
            ("len(None)", "TypeError: object of type"),
            ("raise KeyError()", "KeyError: "),
            ("raise OSError('no such labels')", None),
            ("raise MemoryError", None),
            ("1 / 0", None),
            ("import none", None),
            ("exit(7)", None),
        ):
            with self.subTest(raised):
                (self.folder / "results" / "result.json").unlink(missing_ok=True)
                code = 0 if refused is not None else 7 if "exit" in raised else 1
                self.evaluate(raising + raised, code=code)
                if refused is not None:
                    self.assertTrue(str(self.result()["refused"]).startswith(refused), self.result())
                    self.assertNotIn("\n", str(self.result()["refused"]))
                else:
                    self.assertFalse((self.folder / "results" / "result.json").exists())

    def test_what_scripts_return_becomes_splits_and_a_message(self) -> None:
        self.submit(b"", "file")
        two = "{'result': [{'train_split': {'f1': 1}}, {'test_split': {'f1': '0.5', 'loss': 2.5}}]}"
        splits = [
            {"name": "train_split", "metrics": {"f1": 1.0}},
            {"name": "test_split", "metrics": {"f1": 0.5, "loss": 2.5}},
        ]
        for returned, wanted, message in (
            (two, splits, None),
            ("{'result': [{'a': {}, 'b': {}}]}", [{"name": "a", "metrics": {}}, {"name": "b", "metrics": {}}], None),
            ("{'result': [], 'submission_result': 'x' * 5000}", [], '"' + "x" * 1023),
            ("{'result': [], 'submission_result': {}}", [], None),
            ("{'result': [], 'submission_result': {'a': {1}}}", [], '{"a": "{1}"}'),
        ):
            with self.subTest(returned):
                self.evaluate(f"def evaluate(*_, **more): return {returned}")
                self.assertEqual((self.result()["splits"], self.result()["message"]), (wanted, message))
        # No metric: that is the script's mistake.
        for returned in ("None", "{}", "{'result': [{'a': {'f1': None}}]}", "{'result': [{'a': {'f1': 'high'}}]}"):
            with self.subTest(returned):
                self.evaluate(f"def evaluate(*_, **more): return {returned}", code=1)

    def test_a_metric_that_is_no_finite_number_refuses_the_submission_by_its_name(self) -> None:
        self.submit(b"", "file")
        for number in ("float('nan')", "float('-inf')", "'nan'"):
            with self.subTest(number):
                result = f"[{{'a': {{'f1': 1, 'loss': {number}}}}}]"
                self.evaluate(f"def evaluate(*_, **more): return {{'result': {result}}}")
                found = self.result()
                refused = "these metrics of the file are no finite numbers: loss"
                self.assertEqual((found["refused"], found["splits"]), (refused, []))

    def test_a_host_adds_classes_of_errors(self) -> None:
        self.submit(b"", "file")
        raising = "def evaluate(*_, **more): raise zipfile.BadZipFile('no archive')"
        self.evaluate(f"import zipfile\n{raising}", code=1)
        self.evaluate(f"import zipfile\nOF_THE_FILE = (zipfile.BadZipFile,)\n{raising}")
        self.assertEqual(self.result()["refused"], "BadZipFile: no archive")

    def test_what_is_missing_around_the_script_is_the_hosts_fault(self) -> None:
        self.submit(None, "file")
        for lacking in ("import none", "raise ValueError('at its import')", "def other(): pass"):
            with self.subTest(lacking):
                self.evaluate(lacking, code=1)
        for name in ("ANNOTATIONS", "INPUT", "TRACK", "RESULTS"):
            with self.subTest(name):
                self.assertIn(f"KeyError: '{name}'", self.evaluate(code=1, **{name: None}))
        self.assertFalse((self.folder / "results" / "result.json").exists())

    def test_a_package_in_place_of_a_file_runs_by_its_name(self) -> None:
        self.submit(None, "file")
        self.evaluate(file="evaluation_script/main.py", code=1)
        self.evaluate("from .main import evaluate", file="evaluation_script/__init__.py", SCRIPT="evaluation_script")
        self.assertEqual(self.result()["splits"], [{"name": "test", "metrics": {"accuracy": ACCURACY}}])

    def test_the_script_gets_what_evalais_workers_give_it(self) -> None:
        self.submit(b"content", "file")
        script = """
def evaluate(test_annotation_file, user_submission_file, phase_codename, **kwargs):
    assert open(user_submission_file).read() == "content" and open(test_annotation_file).readline() == "id,category\\n"
    return {"result": [{phase_codename: {"ok": 1}}], "submission_result": kwargs["submission_metadata"]}
"""
        self.evaluate(script)
        self.assertEqual(self.result()["splits"], [{"name": "test", "metrics": {"ok": 1.0}}])


class Folders(unittest.TestCase):
    def test_each_example_fits_into_what_a_host_reads_at_once(self) -> None:
        folders = sorted(folder for folder in EXAMPLES.iterdir() if folder.is_dir())
        self.assertEqual([folder.name for folder in folders], ["classification", "guessing-game", "predictions"])
        for folder in folders:
            lines = sum(len(file.read_text().splitlines()) for file in folder.iterdir() if file.is_file())
            self.assertLess(lines, 120, folder.name)
        self.assertIn(len((PREDICTIONS / "shim.py").read_text().splitlines()), range(20, 41))

    def test_every_image_that_a_leaderboard_names_has_a_target(self) -> None:
        made = set()
        for folder in EXAMPLES.iterdir():
            stages = [line.split()[-1] for line in (folder / "Dockerfile").read_text().splitlines() if " AS " in line]
            made |= {f"REGISTRY/{folder.name}/{stage}:1" for stage in stages}
        for file in EXAMPLES.glob("*/leaderboard.yaml"):
            # Where policies are enforced, nothing can be stored without it.
            self.assertIn("\n  network: {egress: [", file.read_text())
            words = file.read_text().replace('"', " ").replace(",", " ").split()
            named = {word for word in words if word.startswith("REGISTRY/")}
            self.assertTrue(named, file)
            self.assertLessEqual(named, made)


if __name__ == "__main__":
    unittest.main()
