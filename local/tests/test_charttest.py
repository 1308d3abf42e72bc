"""The pure parts of the chart's test and of the test driver."""

import json
import subprocess
import unittest
from typing import cast

from labkit import chartnotes, chartrender, charttest, schemas, testrun
from labkit.chartcases import Access
from labkit.errors import LabError
from labkit.kube import Kube
from labkit.testrun import Result

OPENAPI = {
    "definitions": {
        "io.x.Thing": {
            "type": "object",
            "x-kubernetes-group-version-kind": [{"group": "x.io", "version": "v1", "kind": "Thing"}],
            "properties": {"spec": {"$ref": "#/definitions/io.x.Spec"}, "port": {"$ref": "#/definitions/Port"}},
        },
        "io.x.Spec": {
            "type": "object",
            "properties": {"again": {"type": "array", "items": {"$ref": "#/definitions/io.x.Spec"}}},
        },
        "Port": {"type": "string", "format": "int-or-string"},
        "Map": {"type": "object", "properties": {}, "additionalProperties": {"type": "string"}},
        "Core": {
            "x-kubernetes-group-version-kind": [{"group": "", "version": "v1", "kind": "Core"}],
            "properties": {"labels": {"$ref": "#/definitions/Map"}},
        },
    }
}


class Printed:
    """A kubectl that prints these objects."""

    def __init__(self, items: list[dict[str, object]]) -> None:
        self.items = items

    def run(self, *_argv: str, given: str) -> str:
        return given + json.dumps({"kind": "List", "items": self.items})


class Definitions:
    """A server that removes its one definition when it is reminded for the n-th time."""

    def __init__(self, reminders: int) -> None:
        self.left = reminders
        self.calls: list[tuple[str, ...]] = []

    def run(self, *_argv: str) -> str:
        return "customresourcedefinition.apiextensions.k8s.io/x\n" if self.left > 0 else ""

    def attempt(self, *argv: str) -> subprocess.CompletedProcess[str]:
        self.calls.append(argv)
        if argv[1] == "annotate":
            self.left -= 1
        return subprocess.CompletedProcess(argv, 0, "", "")


class Removal(unittest.TestCase):
    def test_the_server_is_reminded_until_the_definitions_are_gone(self) -> None:
        server = Definitions(3)
        chartrender.definitions_removed(cast(Kube, server))
        self.assertEqual([argv[1] for argv in server.calls], ["annotate", "wait"] * 3)

    def test_definitions_that_stay_are_named(self) -> None:
        with self.assertRaisesRegex(LabError, "after 180 s there still are customresourcedefinition.*/x"):
            chartrender.definitions_removed(cast(Kube, Definitions(1000)))


class Schemas(unittest.TestCase):
    def setUp(self) -> None:
        self.files = dict(schemas.files(OPENAPI))

    def test_each_kind_has_a_file_where_kubeconform_looks(self) -> None:
        self.assertEqual(set(self.files), {"x.io_v1_thing.json", "v1_v1_core.json"})

    def test_a_file_holds_what_it_refers_to_and_no_more(self) -> None:
        self.assertEqual(set(self.files["x.io_v1_thing.json"]["definitions"]), {"io.x.Thing", "io.x.Spec", "Port"})

    def test_unknown_properties_are_refused_where_the_server_knows_all(self) -> None:
        thing = self.files["x.io_v1_thing.json"]["definitions"]
        self.assertIs(thing["io.x.Thing"]["additionalProperties"], False)
        self.assertIs(thing["io.x.Spec"]["additionalProperties"], False)
        self.assertEqual(
            self.files["v1_v1_core.json"]["definitions"]["Map"]["additionalProperties"], {"type": "string"}
        )


class Questions(unittest.TestCase):
    def test_a_resource_is_split_into_group_name_and_part(self) -> None:
        for text, group, resource, part in (
            ("pods", "", "pods", ""),
            ("pods:log", "", "pods", "log"),
            ("leaderboard.carla.org/submissions:status", "leaderboard.carla.org", "submissions", "status"),
        ):
            attributes = charttest.review(Access("a", True, "get", text))["spec"]["resourceAttributes"]
            self.assertEqual(
                (attributes["group"], attributes["resource"], attributes["subresource"]), (group, resource, part)
            )

    def test_objects_one_after_the_other_are_read(self) -> None:
        text = (
            json.dumps({"kind": "A"}, indent=1) + "\n" + json.dumps({"kind": "List", "items": [{"kind": "B"}]}) + "\n"
        )
        self.assertEqual([one["kind"] for one in charttest.documents(text)], ["A", "B"])


class Notes(unittest.TestCase):
    BOUNDS = {"queues": ["submissions*"], "buckets": ["results/boards/*"], "secretsManager": ["evalai/*"]}

    def refused(self, **spec: object) -> list[str]:
        place = {"s3": {"bucket": "results", "prefix": "boards/a/"}}
        return list(chartnotes.refused({"storage": place, **spec}, self.BOUNDS))

    def test_what_a_manifest_names_is_held_against_the_bounds(self) -> None:
        self.assertEqual(self.refused(), [])
        self.assertEqual(self.refused(queue={"sqs": {"url": "https://sqs.example/1/submissions-2"}}), [])
        self.assertEqual(
            self.refused(queue={"sqs": {"url": "https://sqs.example/submissions/other"}}),
            ["queues https://sqs.example/submissions/other"],
        )
        self.assertEqual(self.refused(table={"dynamoDB": {"name": "rows"}}), ["tables rows"])
        self.assertEqual(self.refused(evalai={"token": {"secretsManager": {"id": "evalai/a"}}}), [])
        self.assertEqual(
            self.refused(storage={"s3": {"bucket": "results", "prefix": "arena/"}}), ["buckets results/arena/"]
        )

    def test_a_manifest_is_found_with_its_namespace(self) -> None:
        text = "say\n\nkubectl -n boards apply --filename=- <<'EOF'\nkind: A\n\nb: c\nEOF\nkubectl -n boards get a\n"
        self.assertEqual(chartnotes.PASTED.findall(text), [("boards", "kind: A\n\nb: c")])


class Objects(unittest.TestCase):
    def test_objects_of_one_name_are_told_apart_by_their_namespaces(self) -> None:
        items = [{"kind": "Role", "metadata": {"name": "r", "namespace": name}} for name in ("a", "b")]
        found = chartrender.objects(cast(Kube, Printed(items)), "")
        self.assertEqual(sorted(found), ["Role/a/r", "Role/b/r", "Role/r"])
        self.assertEqual(found["Role/r"]["metadata"]["namespace"], "a")
        with self.assertRaisesRegex(LabError, "Role/a/r is rendered twice"):
            chartrender.objects(cast(Kube, Printed([items[0], items[0]])), "")


class Driver(unittest.TestCase):
    def test_test_programs_are_found_in_cargos_metadata(self) -> None:
        packages = [
            {"targets": [{"kind": ["lib"], "name": "one"}, {"kind": ["test"], "name": "process"}]},
            {"targets": [{"kind": ["test"], "name": "api"}, {"kind": ["bench"], "name": "merge"}]},
        ]
        self.assertEqual(testrun.names_of_tests({"packages": packages}), ["api", "process"])

    def test_the_table_names_what_failed(self) -> None:
        results = [Result("lab", 1.0, "", cpu=2.0), Result("unit", 61.0, "cargo test found failures, see above")]
        lines = testrun.table(results, 61.5, 3.0).splitlines()
        self.assertTrue(lines[2].endswith("passed") and lines[3].endswith("see above"))
        self.assertRegex(lines[4], r"^others +1   the cluster")
        self.assertRegex(lines[5], r"^all +62 s +3   failed: unit$")


if __name__ == "__main__":
    unittest.main()
