"""The demo on a cluster that is there already: what it asks of kubectl, helm and the engine, and what it refuses. Each is a stand-in."""

import contextlib
import io
import json
import os
import sys
import tempfile
import unittest
from pathlib import Path
from unittest import mock

from labkit import build, demo, demo_elsewhere, follow, image, layer, quickstart, settings
from labkit.errors import LabError

REPOSITORY = Path(__file__).resolve().parents[2]
EXPECTED = json.loads((REPOSITORY / "local" / "challenge" / "expected.json").read_text())
# Answers as kubectl, helm and docker do, and notes what it was asked and given.
PROGRAM = f"""#!{sys.executable}
import json, os, sys
name, words = os.path.basename(sys.argv[0]), sys.argv[1:]
given = sys.stdin.read() if "--filename=-" in words else ""
with open(os.environ["NOTES"], "a") as notes:
    notes.write(json.dumps([name, words, given]) + "\\n")
for part, answer in json.loads(os.environ["ANSWERS"]):
    if part in " ".join([name, *words]):
        print(answer)
        sys.exit("FAIL" in answer)
"""
FINISHED = {
    "status": {
        "state": "Finished",
        "progress": {"text": "20/20"},
        "score": {"text": "69.41"},
        "conditions": [{"type": name, "status": "True"} for name in ("Finished", "Archived", "Recorded", "Published")],
    }
}
LINE = follow.SEPARATOR.join(("Finished", "20/20", "69.41", "Finished", "node", "True", "True", ""))
ANSWERS = [
    ("kubectl config current-context", "theirs"),
    ("kubectl get nodes", json.dumps({"items": [{}]})),
    ("evalai-stand-in submit", "submission 7 is submitted; message {}"),
    ("--watch", LINE),
    ("kubectl get submission submission-7 --namespace=leaderboard-demo --output=json", json.dumps(FINISHED)),
    ("evalai-stand-in leaderboard", "1. team-a (submission 7), Driving score 69.410625"),
]


class Elsewhere(unittest.TestCase):
    def setUp(self) -> None:
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)
        for name in ("kubectl", "helm", "docker"):
            program = self.folder / "bin" / name
            program.parent.mkdir(exist_ok=True)
            program.write_text(PROGRAM)
            program.chmod(0o755)
        self.env = {
            "PATH": str(self.folder / "bin"),
            "HOME": str(self.folder),
            "KUBECONFIG": "/theirs",
            "NOTES": str(self.folder / "notes"),
        }
        self.settings = settings.load(REPOSITORY, {**self.env, "LEADERBOARD_LAB_STATE": str(self.folder / "state")})

    def run_with(self, answers: list[tuple[str, str]], registry: str = "registry.example/demo") -> str:
        """Runs the demo where these come first, and returns what it prints."""
        env = {**self.env, "ANSWERS": json.dumps([*answers, *ANSWERS])}
        made = layer.build([layer.Entry("/a", 0o644, b"a")], {}, "amd64")
        out = io.StringIO()
        with (
            mock.patch.dict(os.environ, env, clear=True),
            mock.patch.object(image, "build", return_value=made),
            mock.patch.object(build, "programs"),
            mock.patch.object(demo_elsewhere, "RUN_PATIENCE", 10),
            mock.patch.object(build, "static_programs"),
            mock.patch.object(sys, "stderr", io.StringIO()),
            contextlib.redirect_stdout(out),
        ):
            demo_elsewhere.run(self.settings, registry)
        return out.getvalue()

    def notes(self) -> list[tuple[str, list[str], str]]:
        return [json.loads(line) for line in (self.folder / "notes").read_text().splitlines()]

    def test_everything_is_asked_of_the_machines_own_programs_in_one_namespace(self) -> None:
        printed = self.run_with([])
        self.assertIn("Driving score 69.410625", printed)
        notes = self.notes()
        pushed = [words[1] for name, words, _ in notes if name == "docker" and words[0] == "push"]
        self.assertEqual(len(pushed), 8)
        self.assertEqual(pushed, [words[1] for name, words, _ in notes if name == "docker" and words[0] == "rmi"])
        self.assertTrue(all(one.startswith("registry.example/demo/") for one in pushed), pushed)
        [install] = [words for name, words, _ in notes if name == "helm"]
        self.assertIn("--namespace=leaderboard-demo", install)
        repository, _, tag = pushed[0].rpartition(":")
        self.assertIn(f"--set=image.repository={repository},image.tag={tag}", install)
        [applied] = [given for name, words, given in notes if words[0] == "apply"]
        self.assertNotIn(quickstart.PUBLISHED, applied)
        named = set(quickstart.IMAGE.findall(applied))
        self.assertEqual(len(named), 5)
        self.assertLessEqual(named, set(pushed))
        changing = [words for name, words, _ in notes if name == "kubectl" and words[0] in ("apply", "exec", "wait")]
        self.assertTrue(all("--namespace=leaderboard-demo" in words for words in changing), changing)

    def test_another_score_fails(self) -> None:
        for answer, word in (
            (("evalai-stand-in leaderboard", "no entries yet"), "EvalAI: no row"),
            (("-demo --output=json", json.dumps({"status": {"state": "Finished"}})), "Kubernetes: progress is missing"),
        ):
            with self.subTest(word), self.assertRaisesRegex(LabError, word):
                self.run_with([answer])

    def test_what_is_in_the_way_is_named(self) -> None:
        for answers, registry, word in (
            ([("kubectl get nodes", json.dumps({"items": []}))], "registry.example/demo", "no node for amd64"),
            ([("leaderboard/leaderboard-20", "FAIL")], "registry.example/demo", "does not become Ready"),
            ([("evalai-stand-in submit", "nothing")], "registry.example/demo", "names no submission"),
            ([], "https://registry.example", "is no registry"),
        ):
            with self.subTest(word), self.assertRaisesRegex(LabError, word):
                self.run_with(answers, registry)
        del self.env["KUBECONFIG"]
        with self.assertRaisesRegex(LabError, "KUBECONFIG, which is not set"):
            self.run_with([])

    def test_a_push_that_is_refused_names_what_to_do(self) -> None:
        for said, word in (
            ("http: server gave HTTP response to HTTPS client", "list registry.example as insecure"),
            ("name unknown: repository name not known to registry", "make demo/leaderboard-operator, demo/challenge"),
            ("unauthorized: authentication required", "log in to registry.example"),
            ("no space left on device", "FAIL no space left on device"),
        ):
            with self.subTest(word), self.assertRaisesRegex(LabError, word) as raised:
                self.run_with([("docker push", f"FAIL {said}")])
            self.assertNotIn("{", str(raised.exception))

    def test_only_what_the_machine_lacks_is_built(self) -> None:
        with mock.patch.dict(os.environ, {**self.env, "ANSWERS": "[]"}, clear=True):
            self.assertEqual(demo_elsewhere.built_here(), [])
            (self.folder / "bin" / "helm").unlink()
            (self.folder / "bin" / "docker").unlink()
            self.assertEqual(demo_elsewhere.built_here(), ["helm", "crane"])
            self.assertIn("for helm and crane, which this machine lacks", demo_elsewhere.forecast(self.settings))

    def test_an_engine_that_does_not_answer_is_none(self) -> None:
        with mock.patch.dict(os.environ, {**self.env, "ANSWERS": json.dumps([["docker info", "FAIL"]])}, clear=True):
            self.assertIsNone(demo_elsewhere.engine())

    def test_the_demo_leaves_a_cluster_alone_that_nobody_has_offered(self) -> None:
        self.assertIn("/theirs", demo.foreign_cluster(self.settings, {"KUBECONFIG": "/theirs"}))
        for own in ({}, {"KUBECONFIG": str(self.settings.kubeconfig)}):
            self.assertEqual(demo.foreign_cluster(self.settings, own), "")


if __name__ == "__main__":
    unittest.main()
