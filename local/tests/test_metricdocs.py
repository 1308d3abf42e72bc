"""The table of metrics in docs/metrics.md: what it shows of a source, and that its page asks for nothing that is not exported."""

import re
import unittest
from pathlib import Path

from labkit import chartmetrics, metricdocs
from labkit.errors import LabError

REPOSITORY = Path(__file__).resolve().parents[2]
SOURCE = """
struct Kind {
    kind: String,
}

struct Build {
    version: String,
}

struct Watches {
    errors: Family<Kind, Counter>,
    seconds: Timings<Kind>,
    open: Gauge,
}

impl Watches {
    fn new(r: &mut Registry) -> Self {
        Self {
            errors: zero(r, "watch_errors", "Errors of a watch"),
            seconds: add(
                r,
                "watch_seconds",
                "Duration of a watch",
                timings(),
            ),
            open: zero(r, "watches_open", "Watches that are open"),
        }
    }
}

struct Process {
    cpu: FloatCounter,
}

impl Process {
    fn new(r: &mut Registry) -> Self {
        Self {
            cpu: zero(r, "cpu_seconds", "Time of the process"),
        }
    }
}

impl Metrics {
    fn new() {
        let process = Process::new(registry.sub_registry_with_prefix("process"));
        let both = registry.sub_registry_with_prefix("leaderboard");
        both.register("build", "The running program", Info::new(build));
        Self { watches: Watches::new(bridge) }
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
                "| `leaderboard_watches_open` | gauge |  | bridge | Watches that are open |",
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
