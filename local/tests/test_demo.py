"""What the demo compares, shows and sends: every place's difference is found, nothing else is one."""

import copy
import json
import tempfile
import unittest
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from labkit import demo, demo_check, evalai_server, follow, pki
from labkit.demo_check import Findings

LOCAL = Path(__file__).resolve().parent.parent
EXPECTED: dict[str, Any] = json.loads((LOCAL / "challenge" / "expected.json").read_text())


def good() -> Findings:
    """What the four places show after the standard run."""
    metrics = EXPECTED["metrics"]
    conditions = [
        {"type": name, "status": "True", "lastTransitionTime": "2026-11-20T10:00:31Z"} for name in demo_check.CONDITIONS
    ]
    merged = {
        "entry_status": EXPECTED["entry_status"],
        "eligible": EXPECTED["eligible"],
        "values": EXPECTED["values"],
        "_checkpoint": {"progress": EXPECTED["progress"]},
    }
    columns = zip(map(demo_check.column, metrics), EXPECTED["values"], strict=True)
    return Findings(
        submission={
            "metadata": {
                "name": "submission-1",
                "creationTimestamp": "2026-11-20T10:00:01Z",
                "annotations": {"leaderboard.carla.org/ingested": '{"message": "m", "sent": 1795168800500}'},
            },
            "status": {
                "state": "Finished",
                "resultsURL": "s3://leaderboard-20/1",
                "score": {"text": "69.41"},
                "progress": {"done": 20, "total": 20, "text": "20/20"},
                "conditions": conditions,
                "times": {"submitted": "2026-11-20T10:00:00Z", "started": "2026-11-20T10:00:05Z"},
            },
        },
        objects={},
        texts={
            "agent/agent_results.json": json.dumps(merged),
            "evalai/results.json": json.dumps([{"split": "leaderboard", "accuracies": metrics}]),
        },
        row={"submission_status": "FINISHED", "progress": "20/20", **dict(columns)},
        evalai={"status": "finished"},
        entries=[{"submission": 1, "result": copy.deepcopy(metrics)}],
    )


class Shown(unittest.TestCase):
    def test_each_place_has_a_heading_that_names_it(self) -> None:
        shown = StringIO()
        with redirect_stdout(shown):
            demo.show(SimpleNamespace(run=lambda *_: "the table of kubectl"), good())
        headings = [line for line in shown.getvalue().splitlines() if line.startswith("--- ")]
        self.assertEqual(
            headings[2:], ["--- S3: s3://leaderboard-20/1", "--- DynamoDB: table leaderboard-20", "--- EvalAI"]
        )


class Comparison(unittest.TestCase):
    def test_the_standard_run_has_no_difference(self) -> None:
        self.assertEqual(demo_check.differences(EXPECTED, good()), [])

    def test_every_single_difference_is_found_and_names_its_place(self) -> None:
        def change(found: Findings) -> dict[str, Any]:
            return {
                "Kubernetes: state": lambda: found.submission["status"].update(state="Failed"),
                "Kubernetes: progress": lambda: found.submission["status"]["progress"].update(text="19/20"),
                "Kubernetes: score": lambda: found.submission["status"].update(score={"text": "~69.41"}),
                "Kubernetes: condition Published": lambda: found.submission["status"]["conditions"][3].update(
                    status="False"
                ),
                "S3: entry_status": lambda: texts(found, "entry_status", "Rejected"),
                "S3: eligible": lambda: texts(found, "eligible", False),
                "S3: values": lambda: texts(found, "values", [*EXPECTED["values"][:-1], "0.094"]),
                "S3: “Driving score”": lambda: found.texts.pop("evalai/results.json"),
                "DynamoDB: submission_status": lambda: (found.row or {}).update(submission_status="RUNNING"),
                "DynamoDB: off_road_infractions": lambda: (found.row or {}).pop("off_road_infractions"),
                "EvalAI: status": lambda: found.evalai.update(status="running"),
                "EvalAI: number of leaderboard rows": lambda: found.entries.append(found.entries[0]),
                "EvalAI: “Route completion”": lambda: found.entries[0]["result"].update({"Route completion": 87.4126}),
                "EvalAI: “Surprise”": lambda: found.entries[0]["result"].update({"Surprise": 1}),
            }

        for place in change(good()):
            with self.subTest(place):
                found = good()
                change(found)[place]()
                differences = demo_check.differences(EXPECTED, found)
                self.assertTrue(differences and differences[0].startswith(place), differences)

    def test_nothing_at_all_is_reported_and_never_raises(self) -> None:
        empty = Findings({}, {}, {}, None, {}, [])
        places = {line.partition(":")[0] for line in demo_check.differences(EXPECTED, empty)}
        self.assertEqual(places, {"Kubernetes", "S3", "DynamoDB", "EvalAI"})

    def test_the_timeline_is_in_order_and_counts_seconds(self) -> None:
        lines = demo_check.timeline(good().submission)
        self.assertEqual(
            [line.split(None, 1)[1].strip() for line in lines[:3]],
            ["submitted to EvalAI", "+0.5 s  EvalAI's message in SQS", "+0.5 s  Submission created by the bridge"],
        )
        self.assertIn("31.0 s in all", lines[-1])


def texts(found: Findings, key: str, value: Any) -> None:
    merged = json.loads(found.texts["agent/agent_results.json"])
    found.texts["agent/agent_results.json"] = json.dumps(merged | {key: value})


class Namespace(unittest.TestCase):
    def test_kubectl_takes_that_of_the_demo_and_the_file_stays_json(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "kubeconfig"
            file.write_text('{"contexts": [{"name": "a", "context": {"cluster": "b", "user": "c"}}]}')
            pki.choose_namespace(file, "leaderboard")
            (context,) = json.loads(file.read_text())["contexts"]
            self.assertEqual(context["context"], {"cluster": "b", "user": "c", "namespace": "leaderboard"})


class Following(unittest.TestCase):
    def line(self, *parts: str) -> str:
        return follow.SEPARATOR.join(parts)

    def test_a_line_of_kubectl_is_read(self) -> None:
        seen = follow.parse(self.line("Running", "3/20", "~61.00", "", "node", "", "", "3 of 20 routes are done"))
        assert seen is not None
        self.assertEqual(seen.line(), "Running   3/20   ~61.00")
        self.assertFalse(seen.is_stored or seen.is_lost)
        stopping = follow.parse(self.line("Running", "3/20", "", "Stopping", "node", "", "", "it was cancelled"))
        assert stopping is not None
        self.assertTrue(stopping.line().endswith("it was cancelled"))

    def test_it_is_stored_when_both_services_have_it(self) -> None:
        finished = ("Finished", "20/20", "69.41", "", "node")
        for published, recorded, stored in (("", "", False), ("True", "False", False), ("True", "True", True)):
            seen = follow.parse(self.line(*finished, published, recorded, ""))
            assert seen is not None
            self.assertEqual(seen.is_stored, stored)
        self.assertIn("stored in S3, EvalAI, DynamoDB", seen.line())

    def test_half_a_line_is_nothing(self) -> None:
        self.assertIsNone(follow.parse(self.line("Running", "3/20")))


class Server(unittest.TestCase):
    def test_a_form_holds_fields_and_files(self) -> None:
        self.assertEqual(
            evalai_server.form_part("b", "status", None, "x"),
            '--b\r\nContent-Disposition: form-data; name="status"\r\n\r\nx\r\n',
        )
        self.assertIn(
            'filename="f.json"\r\nContent-Type: application/json\r\n\r\n{}',
            evalai_server.form_part("b", "n", "f.json", "{}"),
        )

    def test_no_two_lives_share_a_key(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "lives"
            firsts = [evalai_server.next_life(file) for _ in range(3)]
        self.assertEqual(firsts, [1, 1001, 2001])


if __name__ == "__main__":
    unittest.main()
