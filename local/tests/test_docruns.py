"""How commands and manifests are read from the documents, and that a wrong one is noticed; `lab chart-test` runs all that there are."""

import json
import subprocess
import tempfile
import unittest
from pathlib import Path

from labkit import docpages, docprograms, docruns, pythonenv, settings
from labkit.docpages import Block
from labkit.docruns import Note
from labkit.kube import Kube

REPOSITORY = Path(__file__).resolve().parents[2]
PAGE = """# Look

Type `kubectl get pods -o
wide`, not `kubectl drain` or `make …`; `make demo` works, and `leaderboard-operator labels --format v2`.

```sh
kubectl get pods    # `kubectl get none`
```

1. Then

   ```yaml
   spec: {a: 1}
   ---
     gpu: {mode: None}
   ---
   kind: Pod
   metadata: {name: a}
   ---
   version: v1
   ```
"""
# Stands for kubectl and helm: refuses some words, in the words of an API server.
SERVER = """#!/bin/sh
for word in "$@"; do
    case "$word" in
    lost) echo 'Error from server (NotFound): pods "lost" not found' >&2; exit 1 ;;
    deployment/gone) echo 'Error from server (NotFound): deployments.apps "gone" not found' >&2; exit 1 ;;
    --odd) echo 'error: unknown flag: --odd' >&2; exit 1 ;;
    esac
done
# As kubectl starts a plugin.
if [ "$1" = leaderboard ]; then shift; exec kubectl-leaderboard "$@"; fi
"""


class Pages(unittest.TestCase):
    def test_blocks_and_commands_in_prose_are_found_with_their_lines(self) -> None:
        spans = [(block.line, block.text) for block in docpages.spans("a.md", PAGE)]
        labels = "leaderboard-operator labels --format v2"
        self.assertEqual(spans, [(3, "kubectl get pods -o wide"), (4, "make demo"), (4, labels)])
        blocks = [(block.line, block.language) for block in docpages.blocks("a.md", PAGE)]
        self.assertEqual(blocks, [(6, "sh"), (12, "yaml")])

    def test_every_page_of_this_repository_is_read(self) -> None:
        found = docpages.of_repository(REPOSITORY)
        self.assertGreater(sum(block.language == "sh" for block in found), 90)
        self.assertGreater(sum(block.language == "span" for block in found), 90)
        fences = sum(page.read_text().count("```") for page in docpages.pages(REPOSITORY))
        self.assertEqual(sum(block.language != "span" for block in found), fences // 2)

    def test_a_block_of_manifests_is_taken_apart(self) -> None:
        block = next(block for block in docpages.blocks("a.md", PAGE) if block.language == "yaml")
        wanted = [
            ("whole", "kind: Pod\nmetadata: {name: a}\n"),
            ("part", "spec: {a: 1}\n"),
            ("part", "spec:\n  gpu: {mode: None}\n"),
            ("other", "version: v1\n"),
        ]
        self.assertEqual(docpages.manifests(block, frozenset({"gpu"})), wanted)

    def test_a_name_that_the_reader_puts_in_is_replaced_and_no_part_of_another(self) -> None:
        line = "kubectl -n NAMESPACE get pod <name> $QUEUE_NAME | sed s/<REGION>/REGION/"
        wanted = "kubectl -n leaderboard get pod sample $QUEUE_NAME | sed s/<REGION>/us-east-1/"
        self.assertEqual(docruns.filled(line), wanted)


class Shell(unittest.TestCase):
    def typed(self, *lines: str) -> tuple[list[Note], list[str]]:
        """What a page of these lines starts, and what is wrong with it."""
        with tempfile.TemporaryDirectory() as folder:
            tools = Path(folder) / "tools"
            tools.mkdir()
            for name in ("kubectl", "helm"):
                (tools / name).write_text(SERVER)
                (tools / name).chmod(0o755)
            found = [Block("docs/a.md", number, "sh", line) for number, line in enumerate(lines)]
            notes, faults = docruns.typed(REPOSITORY, Kube(tools, {}), Path(folder), found)
        return notes, [*faults, *docruns.judged(notes)]

    def test_a_page_is_one_shell_whose_programs_are_noted_with_their_place(self) -> None:
        notes, faults = self.typed(
            "cp -r examples/aws my-aws && cd my-aws\nname() { echo b; }",
            "kubectl apply -f gpu-test.yaml | grep a",
            "aws iam create-policy --policy-document file://iam/$(name)ridge.json",
            "kubectl leaderboard why -n a",
        )
        self.assertEqual(faults, [])
        self.assertEqual([note.place for note in notes], ["docs/a.md:1", "docs/a.md:2", "docs/a.md:3"])
        self.assertEqual([note.code for note in notes], [0, None, None])
        self.assertEqual(notes[1].words[-1], "file://iam/bridge.json")
        self.assertEqual(notes[2].words, ("kubectl-leaderboard", "why", "-n", "a"))

    def test_what_is_wrong_with_a_line_is_named(self) -> None:
        for line, fault in (
            ("kubectl get pods --odd", "docs/a.md:0: kubectl get pods --odd: error: unknown flag: --odd"),
            ("kubectl get pod lost", "(NotFound)"),
            ("kubectl logs deployment/gone", "(NotFound)"),
            ("kubctl get pods", "kubctl: command not found"),
            ("for a in b; do", "syntax error"),
            ("sed -i s/a/b/ examples/none.yaml", "examples/none.yaml"),
            ("helm template x charts/leaderboard-operator --values none.yaml --odd", "unknown flag"),
            ("helm install x oci://registry.example/x --values none.yaml", "there is no file none.yaml"),
        ):
            with self.subTest(line):
                self.assertIn(fault, "\n".join(self.typed(line)[1]))

    def test_a_pod_that_no_node_has_is_no_fault_of_the_line_that_asks_for_it(self) -> None:
        notes, faults = self.typed("kubectl -n a logs lost", "kubectl get pods")
        self.assertEqual(faults, [])
        self.assertEqual([docruns.how(note) for note in notes], ["answered", "commands run"])

    def test_nothing_waits_for_nodes_that_never_come(self) -> None:
        for line, wanted in (
            ("kubectl get pods --watch", "kubectl get pods"),
            ("kubectl exec a -- ls -w", "kubectl exec a --pod-running-timeout=1s -- ls -w"),
            ("kubectl -n a delete crd b", "kubectl -n a delete crd b --dry-run=server --wait=false"),
            (
                "helm upgrade a b --namespace leaderboard-system --wait",
                "helm upgrade a b --namespace leaderboard-system",
            ),
            ("helm install a b --namespace c", "helm install a b --namespace c --dry-run=client"),
        ):
            self.assertEqual(docprograms.changed(line.split()), wanted.split())
        for line, started in (
            ("kubectl leaderboard why a", "kubectl-leaderboard why a"),
            ("kubectl -n a leaderboard why", "kubectl -n a leaderboard why"),
        ):
            self.assertEqual(docprograms.as_started(line.split()), started.split())
        for line in ("kubectl-leaderboard why -n a", "helm -n a test b", "helm install a oci://b", "aws s3 ls"):
            self.assertIsNone(docprograms.changed(line.split()), line)


class Words(unittest.TestCase):
    """Of programs that do not run."""

    def faults(self, *lines: str) -> list[str]:
        notes = [Note("docs/a.md:1", tuple(line.split()), None, "") for line in lines]
        return list(docruns.of_words(settings.load(REPOSITORY), notes))

    def test_targets_commands_packages_and_options_must_exist(self) -> None:
        right = (
            "make demo bench-report BENCH_FLAGS=x",
            "lab chart-test --update",
            "cargo test -p leaderboard-results --test corpus",
            "docker build --file local/quickstart/Dockerfile --target agent .",
            "docker build --file my-challenge/Dockerfile --target agent my-challenge",
            "docker build --target labels --tag REGISTRY/classification/labels:1 examples/challenges/classification",
            "docker build --tag REGISTRY/leaderboard-operator:1 .",
            "try.sh --memory 24g IMAGE",
        )
        self.assertEqual(self.faults(*right), [])
        for line, fault in (
            ("make dem", "no target dem"),
            ("lab chart-tests", "no command chart-tests"),
            ("cargo test -p leaderboard-result", "there is no"),
            ("cargo test -p leaderboard-results --test corpora", "corpora.rs"),
            ("docker build --file local/quickstart/Dockerfile --target agents .", "no target agents"),
            ("docker build --target label examples/challenges/classification", "no target label"),
            ("try.sh --memories 24g IMAGE", "no option --memories"),
        ):
            self.assertIn(fault, "\n".join(self.faults(line)), line)

    def test_lines_of_aws_are_held_against_its_models(self) -> None:
        lines = {
            "sqs get-queue-url --queue-name a --query QueueUrl --output text": [],
            "s3 cp s3://a/b -": [],
            "sqs get-queue-urls --queue-name a": ["sqs has no operation get-queue-urls"],
            "sqss get-queue-url": ["no service sqss"],
            "sqs get-queue-url --name a": ["no option --name", "--queue-name is missing"],
            "sqs get-queue-attributes --queue-url a --attribute-names Arn": ["--attribute-names: there is no Arn"],
            "sqs get-queue-url --queue-name a b": ["--queue-name with 2 words"],
            "sqs get-queue-url --queue-name a --query [": [
                "--query: Invalid jmespath expression: Incomplete expression:"
            ],
            "ecr get-login-password --name a": ["no option --name"],
        }
        environment = settings.load(REPOSITORY)
        argv = [str(pythonenv.ensure(environment) / "python"), "-m", "labkit.awscommands"]
        given = json.dumps([line.split() for line in lines])
        env = {"PYTHONPATH": str(REPOSITORY / "local"), "PYTHONDONTWRITEBYTECODE": "1"}
        done = subprocess.run(argv, env=env, input=given, capture_output=True, text=True, check=True)
        self.assertEqual(dict(zip(lines, json.loads(done.stdout), strict=True)), lines)
        (fault,) = self.faults("aws sqs get-queue-url")
        self.assertIn("--queue-name is missing", fault)
        prose = Note("docs/a.md:1 (prose)", ("aws", "sqs", "get-queue-url"), None, "")
        self.assertEqual(list(docruns.aws_faults(environment, [prose])), [])


if __name__ == "__main__":
    unittest.main()
