"""The pure parts of the chart's test and of the test driver."""

import json
import unittest

from labkit import charttest, schemas, testrun
from labkit.chartcases import Access
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


class Driver(unittest.TestCase):
    def test_test_programs_are_found_in_cargos_metadata(self) -> None:
        packages = [
            {"targets": [{"kind": ["lib"], "name": "one"}, {"kind": ["test"], "name": "process"}]},
            {"targets": [{"kind": ["test"], "name": "api"}, {"kind": ["bench"], "name": "merge"}]},
        ]
        self.assertEqual(testrun.names_of_tests({"packages": packages}), ["api", "process"])

    def test_the_table_names_what_failed(self) -> None:
        lines = testrun.table(
            [Result("lab", 1.0, ""), Result("unit", 61.0, "cargo test found failures, see above")]
        ).splitlines()
        self.assertTrue(lines[1].endswith("passed") and lines[2].endswith("see above"))
        self.assertTrue(lines[3].startswith("all") and lines[3].endswith("failed: unit"))


if __name__ == "__main__":
    unittest.main()
