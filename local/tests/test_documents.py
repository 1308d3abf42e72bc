"""What the documents promise: runbooks, links, and the tests that the table of attacks names."""

import unittest
from pathlib import Path

from labkit import doccheck

REPOSITORY = Path(__file__).resolve().parents[2]


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
