"""The table of metrics in docs/metrics.md: what it shows of a source, and that its page asks for nothing that is not exported."""

import re
import unittest
from pathlib import Path

from labkit import chartmetrics, metricdocs
from labkit.errors import LabError

REPOSITORY = Path(__file__).resolve().parents[2]
SOURCE = """
pub const OPEN: Gauge<0> = Gauge("watches_open", [], "Watches that are open");

impl Watches {
    fn new(r: &mut Families<'_>) -> Self {
        Self {
            errors: r.counters("watch_errors", ["kind"], "Errors of a watch"),
            seconds: r.timings(
                "watch_seconds",
                ["kind"],
                "Duration of a watch",
            ),
        }
    }
}

impl Collector for Process {
    fn encode(&self, encoder: DescriptorEncoder<'_>) -> fmt::Result {
        to.counter("process_cpu_seconds", "Time of the process", seconds)
    }
}

impl Metrics {
    fn new() {
        let build = Info::new([("version", VERSION)]);
        both.register("build", "The running program", build);
        Self { watches: Watches::new(&mut bridge) }
    }
}
"""


class Table(unittest.TestCase):
    def test_each_family_has_one_row_with_the_name_that_queries_use(self) -> None:
        lines = metricdocs.table(SOURCE).splitlines()[2:]
        self.assertEqual(
            lines,
            [
                "| `leaderboard_build_info` | info | `version` | both | The running program |",
                "| `leaderboard_watch_errors_total` | counter | `kind` | bridge | Errors of a watch |",
                "| `leaderboard_watch_seconds` | histogram | `kind` | bridge | Duration of a watch |",
                "| `leaderboard_watches_open` | gauge |  | controller | Watches that are open |",
                "| `process_cpu_seconds_total` | counter |  | both | Time of the process |",
            ],
        )

    def test_a_page_without_its_place_for_the_table_is_refused(self) -> None:
        with self.assertRaisesRegex(LabError, "lacks the lines"):
            metricdocs.page("# Metrics", SOURCE)

    def test_the_page_asks_for_what_is_exported(self) -> None:
        metrics, literals = chartmetrics.of_repository(REPOSITORY)
        text = (REPOSITORY / metricdocs.PAGE).read_text().partition(metricdocs.BEGIN)[0]
        queries = re.findall(r"`([^`]*leaderboard_[^`]*)`", text)
        self.assertGreater(len(queries), 5)
        self.assertEqual([fault for query in queries for fault in chartmetrics.faults(query, metrics, literals)], [])

    def test_the_page_is_that_of_the_source(self) -> None:
        metricdocs.same(REPOSITORY)
