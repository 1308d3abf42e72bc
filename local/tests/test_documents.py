"""What the documents promise: runbooks, links, and the tests that the table of attacks names."""

import re
import tempfile
import unittest
from pathlib import Path

from labkit import doccheck, kubeversions, toolsets

REPOSITORY = Path(__file__).resolve().parents[2]
# Numbered as in the review that they come from, so that none can be lost.
ATTACKS = 160
TABLE = """
The table has 5 attacks: 1 are held, 1 are held by policy, 1 are inherent, 1 are open, and 1 are struck.

| # | attack | | why |
|---|---|---|---|
| 1 | a | held | `src/a.rs::a_test` |
| 2 | b \\| c | by policy | Named: `tests/b.rs::b_test`, `local/tests/test_c.py::test_c` |

| 3 | c | inherent | So it is |
| 4 | d | open | It is not held |
| 5 | e | struck | It is gone |
"""
TESTS = "| # | test |\n|---:|---|\n| 1 | `src/d.rs::d_test` |\n"


class Runbooks(unittest.TestCase):
    def test_each_alert_has_its_page_and_each_page_its_alert(self) -> None:
        self.assertEqual(list(doccheck.runbook_faults(REPOSITORY)), [])


class Links(unittest.TestCase):
    def test_a_heading_has_the_anchor_that_github_gives_it(self) -> None:
        text = "# Why a submission is `Pending`\n```sh\n# no heading\n```\n## `verify`: do the scores follow?\n"
        self.assertEqual(doccheck.anchors(text), {"why-a-submission-is-pending", "verify-do-the-scores-follow"})

    def test_every_link_between_documents_leads_somewhere(self) -> None:
        pages = doccheck.pages(REPOSITORY)
        self.assertGreater(len(pages), 20)
        self.assertEqual([fault for page in pages for fault in doccheck.link_faults(page)], [])

    def test_every_page_that_a_file_names_exists(self) -> None:
        """In messages of programs, comments, charts and workflows: links between pages are above."""
        named = re.compile(r"\bdocs/((?:[a-z][\w-]*/)*[\w-]+\.md)\b")
        lost = []
        for name in doccheck.tracked(REPOSITORY):
            file = REPOSITORY / name
            # The ledger names what is gone, and tests make pages of their own.
            if name == "docs/decisions/ledger.md" or name.startswith("local/tests/") or not file.is_file():
                continue
            text = file.read_bytes().decode(errors="ignore")
            lost += [
                f"{name}: docs/{page}" for page in named.findall(text) if not (REPOSITORY / "docs" / page).exists()
            ]
        self.assertEqual(lost, [])


class Messages(unittest.TestCase):
    def test_every_page_that_a_message_names_exists_and_has_its_address(self) -> None:
        files = doccheck.tracked(REPOSITORY)
        self.assertGreater(sum(bool(doccheck.MESSAGES.match(file)) for file in files), 200)
        self.assertEqual(list(doccheck.message_faults(REPOSITORY, files)), [])

    def test_a_wrong_page_of_a_message_is_named(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            repository = Path(folder)
            (repository / "docs").mkdir()
            (repository / "docs" / "a.md").write_text("# A\n## Rights\n")
            (repository / "src").mkdir()
            for text, faults in (
                ('"{DOCUMENTS}a.md#rights"', []),
                ('// docs/a.md has it.\n"{DOCUMENTS}b.md"', ["src/x.rs: there is no docs/b.md"]),
                ('"{DOCUMENTS}a.md#wrongs"', ["src/x.rs: docs/a.md has no heading wrongs"]),
                ('"see docs/a.md"', ["src/x.rs: name docs/a.md by DOCUMENTS"]),
                ('"{DOCUMENTS}a.md"\n#[cfg(test)]\n"see docs/a.md"', []),
            ):
                with self.subTest(text):
                    (repository / "src" / "x.rs").write_text(text)
                    self.assertEqual(list(doccheck.message_faults(repository, ["src/x.rs"])), faults)


class Places(unittest.TestCase):
    """Pages that lead a contributor to a file: those of hosts name the objects of a cluster and the keys of a bucket as well."""

    def test_every_file_and_name_in_a_page_for_contributors_exists(self) -> None:
        files = doccheck.tracked(REPOSITORY)
        pages = [
            REPOSITORY / name
            for name in ("CONTRIBUTING.md", "docs/architecture.md", "local/changes.md", "tests/README.md")
        ]
        # The ledger names what is gone.
        pages += sorted(page for page in (REPOSITORY / "docs" / "decisions").glob("*.md") if page.name != "ledger.md")
        self.assertEqual([fault for page in pages for fault in doccheck.place_faults(REPOSITORY, page, files)], [])

    def test_what_a_page_misplaces_is_named(self) -> None:
        files = ("local/labkit/doccheck.py", "src/cli/mod.rs")
        with tempfile.TemporaryDirectory() as folder:
            page = Path(folder) / "page.md"
            page.write_text(
                "`place_faults` in `labkit/doccheck.py`, `src/cli`, `cli/mod.rs`, `<run>/agent.rs`, and `s3/key/of.txt`"
            )
            self.assertEqual(list(doccheck.place_faults(REPOSITORY, page, files)), [])
            page.write_text("`absent` in\n`doccheck.py`, `src/page`, `check.py`")
            faults = [
                "page.md: there is no check.py",
                "page.md: there is no src/page",
                "page.md: absent is not in doccheck.py",
            ]
            self.assertEqual(list(doccheck.place_faults(REPOSITORY, page, files)), faults)


class Logs(unittest.TestCase):
    def test_no_page_reads_the_log_of_one_of_two_controllers(self) -> None:
        """kubectl takes one Pod of a Deployment, and only the leader's log has what a person looks for."""
        reads = re.compile(r"logs deploy(ment)?/\S*-controller")
        self.assertEqual([str(page) for page in doccheck.pages(REPOSITORY) if reads.search(page.read_text())], [])


class Readme(unittest.TestCase):
    """The first screen, which people trust more than any other page."""

    def setUp(self) -> None:
        self.text = (REPOSITORY / "README.md").read_text()
        self.flat = " ".join(self.text.split())

    def page(self, name: str) -> str:
        return (REPOSITORY / "docs" / name).read_text()

    def test_it_has_the_figures_of_the_page_on_performance(self) -> None:
        page = self.page("performance.md")
        for row, column, written in (
            ("burst with a restart: lost submissions", 2, "**{:.0f}** were lost"),
            ("API server", 2, "**{:.0f}** API writes, or 7 with EvalAI and a table"),
            ("RSS, 5,000 live", 2, "**{} MB**"),
            ("last container's end to Finished at 2/s, p50", 2, "**{} ms** after its last container"),
            ("cancelled in EvalAI → stop on the Pod, 300 running", 1, "Half of them stopped within **{} s**"),
        ):
            with self.subTest(row):
                found = re.search(rf"^\| {re.escape(row)} \|(.+)\|$", page, re.MULTILINE)
                self.assertIsNotNone(found, f"docs/performance.md has no row {row!r}")
                cell = found[1].split("|")[column - 1] if found else ""
                figure = re.search(r"p50 ([\d.]+)", cell) or re.search(r"([\d.]+)", cell)
                number = figure[1] if figure else ""
                self.assertIn(written.format(float(number) if ":" in written else number), self.flat)
        undone = re.search(r"^\| cancels undone by a write in that run \| (\d+) of (\d+) \|", page, re.MULTILINE)
        of = int(undone[2]) if undone else 0
        self.assertIn(f"**{of - int(undone[1]) if undone else 0} of {of}** stayed so", self.flat)

    def test_it_has_the_sums_of_the_table_of_attacks(self) -> None:
        found = doccheck.attacks(self.page("security.md"), "")
        held = sum(attack.kind == "held" for attack in found)
        self.assertIn(f"**{held} of {len(found)}** [attacks](docs/security.md#the-attacks) are held", self.flat)

    def test_it_promises_no_more_reasons_than_there_are(self) -> None:
        reasons = re.findall(r"^\| `[A-Z]\w+` \|", self.page("states.md"), re.MULTILINE)
        promised = re.search(r"more than \*\*(\d+)\*\* \[reasons\]", self.flat)
        self.assertGreater(len(reasons), int(promised[1]) if promised else 10**6)

    def test_it_fits_into_what_a_reader_gives_it(self) -> None:
        self.assertLessEqual(len(self.text.split()), 700)


class Versions(unittest.TestCase):
    """docs/versions.md names what the tests run."""

    def test_the_page_has_the_versions_that_are_pinned(self) -> None:
        page = (REPOSITORY / "docs" / "versions.md").read_text()
        modules = "\n".join(file.read_text() for file in sorted((REPOSITORY / "local" / "tools").rglob("go.mod")))
        helm = re.findall(r"^\s*(?:require )?helm\.sh/helm/v4 v(\S+)", modules, re.MULTILINE)
        # Prometheus counts its module apart from itself: 3.13.4 is v0.313.4.
        prometheus = re.findall(r"prometheus/prometheus v0\.(\d)(\d+)\.(\d+)", modules)
        pinned = {
            "Kubernetes": [toolsets.KUBERNETES_VERSION[1:], *(version[1:] for version in kubeversions.SUMS)],
            "Helm": helm[:1],
            "Prometheus": [".".join(prometheus[0])] if prometheus else [],
        }
        for name, versions in pinned.items():
            self.assertTrue(versions, name)
            lost = [version for version in versions if version not in page]
            self.assertEqual(lost, [], f"docs/versions.md lacks these versions of {name}")


class Security(unittest.TestCase):
    def setUp(self) -> None:
        self.text = (REPOSITORY / "docs" / "security.md").read_text()
        self.tests = (REPOSITORY / "docs" / "reference" / "attacks.md").read_text()

    def test_every_attack_has_its_row_and_the_sums_are_right(self) -> None:
        self.assertEqual(list(doccheck.attack_faults(self.text, self.tests, ATTACKS)), [])

    def test_every_test_that_is_named_exists(self) -> None:
        named = [test for attack in doccheck.attacks(self.text, self.tests) for test in attack.tests]
        self.assertGreater(len(named), ATTACKS // 2)
        self.assertEqual(list(doccheck.test_faults(REPOSITORY, named)), [])

    def test_rows_are_read_with_their_tests(self) -> None:
        rows = doccheck.attacks(TABLE, TESTS)
        self.assertEqual([(row.number, row.kind) for row in rows][1:3], [(2, "by policy"), (3, "inherent")])
        self.assertEqual(rows[1].tests, (("tests/b.rs", "b_test"), ("local/tests/test_c.py", "test_c")))
        self.assertEqual(rows[0].tests, (("src/a.rs", "a_test"), ("src/d.rs", "d_test")))
        self.assertEqual(list(doccheck.attack_faults(TABLE, TESTS, 5)), [])

    def test_what_is_wrong_with_a_table_is_named(self) -> None:
        for text, attacks, word in (
            (TABLE.replace("| 3 |", "| 6 |"), 5, "[3, 6]"),
            (TABLE, 6, "[6]"),
            (TABLE.replace("1 are open", "2 are open"), 5, "the text says [5, 1, 1, 1, 2, 1]"),
            (TABLE.replace("has 5", "has about 5"), 5, "the sums are not in the text"),
            (TABLE.replace("| open |", "| closed |"), 5, "'closed'"),
            (TABLE.replace("`src/a.rs::a_test`", "it is"), 5, "attack 1 is held and names no test"),
            (TABLE, 5, "the page of tests has attack 7, which the table lacks"),
        ):
            with self.subTest(word):
                self.assertTrue(
                    any(
                        word in fault for fault in doccheck.attack_faults(text, "| 7 | `src/d.rs::d_test` |\n", attacks)
                    )
                )

    def test_tests_are_found_under_their_attributes_unless_they_are_ignored(self) -> None:
        rust = "\n".join(
            [
                "#[test]\nfn a_name() {}",
                "#[tokio::test(start_paused = true)]\n#[cfg(unix)]\nasync fn another() {}",
                '#[test]\n#[ignore = "takes minutes"]\nfn only_if_asked_for() {}',
                "fn none() {}",
            ]
        )
        self.assertEqual(doccheck.tests_of(rust, ".rs"), {"a_name", "another"})
        python = 'class A:\n    def test_x(self):\n    def none(self):\n    check("a", lambda: b.c(d))\n'
        self.assertEqual(doccheck.tests_of(python, ".py"), {"test_x", "c"})
        faults = list(doccheck.test_faults(REPOSITORY, [("src/none.rs", "a"), ("src/lib.rs", "b")]))
        self.assertEqual(faults, ["src/lib.rs has no test b", "src/none.rs does not exist, which has a"])
