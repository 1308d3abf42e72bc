"""The table of values, the schema against values.yaml, and the metrics that queries may ask for."""

import json
import re
import tempfile
import unittest
from pathlib import Path

from labkit import chartdocs, chartmetrics, chartrender, chartshows
from labkit.chartshown import ABSENT, Shown
from labkit.errors import LabError

REPOSITORY = Path(__file__).resolve().parents[2]
CHART = chartrender.folder(REPOSITORY)
VALUES = """\
# Of the file.

# Where it runs:
#   place: here
# or <there>.
place: ""
controller:
  # How many, as a|b.
  replicas: 2
  resources:
    requests: {cpu: 1}
bridge:
  enabled: true
  replicas: 1
"""
SOURCE = """
const LEADS: Gauge<0> = Gauge(
    "leads",
    [],
    "1 or 0",
);
impl Parts {
    fn new(r: &mut Families<'_>) -> Self {
        Self {
            total: r.counters("parts", ["kind"], "All"),
            seconds: r.timings("part_seconds", ["kind"], "Long"),
        }
    }
}
impl Metrics {
    pub fn new() -> Self {
        let build = Info::new([("version", env!("CARGO_PKG_VERSION"))]);
        both.register("build", "The program", build);
    }
}
"""


# First cell of a row of the README's tables of rights -> its resource.
RIGHTS = {
    "Pods' logs": "pods/log",
    "Finalizers of both kinds": "finalizers",
}
RULE = re.compile(r"^    resources: \[(.+)\]\n    verbs: \[(.+)\]$", re.MULTILINE)


class Rights(unittest.TestCase):
    def test_the_readme_has_every_right_of_the_controller(self) -> None:
        granted: set[tuple[str, str]] = set()
        for resources, verbs in RULE.findall((CHART / "templates" / "controller-rbac.yaml").read_text()):
            for resource in resources.split(", "):
                kind, _, part = resource.partition("/")
                name = "finalizers" if part == "finalizers" else kind if part == "status" else resource
                granted |= {(name, "write status" if part == "status" else verb) for verb in verbs.split(", ")}
        shown: set[tuple[str, str]] = set()
        text = (CHART / "README.md").read_text().split("## Rights in the cluster")[1].split("\n## ")[0]
        for row in re.findall(r"^\| (.+?) \| (.+?) \|", text, re.MULTILINE):
            resource = RIGHTS.get(row[0], row[0].split(",")[0].lower())
            words = row[1].replace("read", "get, list, watch").replace("`", "")
            shown |= {(resource, word.strip()) for word in re.split(r",|;| and | of ", words)}
        self.assertGreater(len(granted), 30)
        self.assertEqual(sorted(granted - shown), [])


class Table(unittest.TestCase):
    def test_each_value_has_a_row_with_its_default_and_its_comment(self) -> None:
        self.assertEqual(
            chartdocs.table(VALUES).splitlines()[2:],
            [
                '| `place` | `""` | Where it runs: or &lt;there>. |',
                "| `controller.replicas` | `2` | How many, as a\\|b. |",
                "| `controller.resources.requests` | `{cpu: 1}` | As in a container. |",
                "| `bridge.enabled` | `true` | Whether it is made. |",
                "| `bridge.replicas` | `1` | As `controller.replicas`. |",
            ],
        )

    def test_a_value_without_a_comment_is_an_error(self) -> None:
        with self.assertRaisesRegex(LabError, "log.level has no comment"):
            chartdocs.table("log:\n  level: info\n")

    def test_a_value_over_several_lines_is_an_error(self) -> None:
        with self.assertRaisesRegex(LabError, "values.yaml:3"):
            chartdocs.table("# Some.\nsome:\n- one\n")

    def test_the_table_takes_the_place_between_the_marks(self) -> None:
        readme = f"# Title\n{chartdocs.BEGIN}\nold\n{chartdocs.END}\nend\n"
        once = chartdocs.with_table(readme, VALUES)
        self.assertNotIn("old", once)
        self.assertTrue(once.startswith("# Title\n") and once.endswith("\nend\n"))
        self.assertEqual(chartdocs.with_table(once, VALUES), once)

    def test_the_charts_table_is_that_of_its_values(self) -> None:
        chartdocs.same_table(CHART)

    def test_a_stale_table_is_an_error(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / "values.yaml").write_text(VALUES)
            (Path(folder) / "README.md").write_text(f"{chartdocs.BEGIN}\n{chartdocs.END}\n")
            with self.assertRaisesRegex(LabError, "make chart-docs"):
                chartdocs.same_table(Path(folder))


class Schema(unittest.TestCase):
    def compare(self, schema: dict[str, object]) -> None:
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / "values.yaml").write_text(VALUES)
            (Path(folder) / "values.schema.json").write_text(json.dumps(schema))
            chartdocs.same_schema(Path(folder))

    def test_both_must_have_the_same_values(self) -> None:
        program = {"properties": {"replicas": {}, "resources": {}}}
        bridge = {"properties": {"enabled": {}, "replicas": {}}}
        properties = {"place": {}, "controller": {"$ref": "#/definitions/program"}, "bridge": bridge}
        schema = {"properties": properties, "definitions": {"program": program}}
        self.compare(schema)
        with self.assertRaisesRegex(LabError, "values.yaml alone has .'bridge.enabled'"):
            self.compare({**schema, "properties": {**properties, "bridge": {"properties": {"replicas": {}}}}})
        with self.assertRaisesRegex(LabError, "schema.json alone has .'other'"):
            self.compare({**schema, "properties": {**properties, "other": {}}})

    def test_a_program_may_have_what_both_have(self) -> None:
        program = {"properties": {"replicas": {}, "resources": {}, "place": {}}}
        bridge = {"properties": {"enabled": {}, "replicas": {}}}
        self.compare({"properties": {"place": {}, "controller": program, "bridge": bridge}})

    def test_the_charts_are_the_same(self) -> None:
        chartdocs.same_schema(CHART)


class Metrics(unittest.TestCase):
    def setUp(self) -> None:
        self.metrics = chartmetrics.exported(SOURCE)

    def faults(self, query: str) -> list[str]:
        return list(chartmetrics.faults(query, self.metrics, frozenset({"Job"})))

    def test_names_have_the_suffix_of_their_kind(self) -> None:
        self.assertEqual(
            {name: sorted(labels) for name, labels in self.metrics.items()},
            {
                "leaderboard_parts_total": ["kind"],
                "leaderboard_part_seconds_bucket": ["kind", "le"],
                "leaderboard_part_seconds_sum": ["kind"],
                "leaderboard_part_seconds_count": ["kind"],
                "leaderboard_leads": [],
                "leaderboard_build_info": ["version"],
            },
        )

    def test_what_nobody_exports_is_found(self) -> None:
        for query, fault in (
            ("leaderboard_parts", "there is no metric leaderboard_parts"),
            ('leaderboard_leads{kind="Job"}', "leaderboard_leads has no label kind"),
            ('leaderboard_parts_total{kind=~"Job|Jobs"}', "no kind is called Jobs"),
            ("sum by (kinds) (leaderboard_parts_total)", "no metric here has the label kinds"),
        ):
            self.assertEqual(self.faults(query), [fault], query)

    def test_what_is_exported_may_be_asked_for(self) -> None:
        for query in (
            'sum by (namespace, kind) (rate(leaderboard_parts_total{kind="Job",job="controller"}[5m]))',
            "histogram_quantile(0.9, sum by (le) (rate(leaderboard_part_seconds_bucket[5m])))",
            "label_values(leaderboard_build_info, namespace)",
        ):
            self.assertEqual(self.faults(query), [], query)

    def test_the_operators_own_are_read(self) -> None:
        metrics, literals = chartmetrics.of_repository(REPOSITORY)
        # The names that the operator's own test expects in the text of /metrics.
        source = (REPOSITORY / chartmetrics.FOLDER / "tests.rs").read_text()
        lines = source.partition("fn every_metric_has")[2].partition("\n}")[0]
        expected = set(chartmetrics.NAME.findall(lines))
        self.assertGreater(len(expected), 10)
        self.assertEqual(expected - metrics.keys(), set())
        self.assertIn("Pending", literals)

    def test_each_metric_is_asked_for_by_an_alert_or_the_dashboard(self) -> None:
        metrics, _ = chartmetrics.of_repository(REPOSITORY)
        queries = (CHART / "files" / "alerts.yaml").read_text() + (CHART / "files" / "dashboard.json").read_text()
        shown = set(chartmetrics.NAME.findall(queries))
        # For a closer look by hand.
        rest = {
            "leaderboard_reconcile_wait_duration_seconds_bucket",
            "process_max_fds",
            "process_start_time_seconds",
        }
        # Those of a histogram's bucket.
        parts = {name for name in metrics if name.endswith(("_sum", "_count"))}
        self.assertEqual(metrics.keys() - parts - shown, rest)


class Rendered(unittest.TestCase):
    THING = {"a": [{"b": 1, "c": 2}, {"d": "1"}], "e": {}}

    def fault(self, path: str, holds: object, name: str = "Thing/one") -> str | None:
        return chartrender.fault({"Thing/one": self.THING}, Shown(name, path, holds))

    def test_maps_and_lists_may_hold_more(self) -> None:
        for path, holds in (("a", [{"d": "1"}, {"b": 1}]), ("a.0", {"c": 2}), ("a.1.d", "1"), ("e", {}), ("f", ABSENT)):
            self.assertIsNone(self.fault(path, holds), path)

    def test_what_differs_is_a_fault(self) -> None:
        for path, holds in (("a", [{"b": 2}]), ("a.1.d", 1), ("a.2", {}), ("e", ABSENT), ("e.x", 1), ("a.0.b", True)):
            self.assertIsNotNone(self.fault(path, holds), path)

    def test_an_object_may_have_to_be_absent(self) -> None:
        self.assertIsNone(self.fault("", ABSENT, "Thing/two"))
        self.assertIsNotNone(self.fault("", ABSENT))
        # Nothing can be said about a part of what is not there.
        self.assertIsNotNone(self.fault("a", ABSENT, "Thing/two"))

    def test_every_value_of_the_chart_has_a_case(self) -> None:
        self.assertEqual(chartrender.without_case(CHART, chartshows.CASES), [])
        self.assertEqual(chartrender.without_case(CHART, chartshows.CASES[1:])[:1], ["nameOverride"])

    def test_paths_become_groups_and_keys_of_values_stay(self) -> None:
        self.assertEqual(
            chartrender.nested({"a.b": {"x.y/z": 1}, "a.c": 2, "d": 3}), {"a": {"b": {"x.y/z": 1}, "c": 2}, "d": 3}
        )


if __name__ == "__main__":
    unittest.main()
