"""What participants and hosts are promised of their images: the tables of the documents and the scripts to try an image."""

import json
import os
import subprocess
import tempfile
import unittest
from pathlib import Path

from labkit import contractcheck

REPOSITORY = Path(__file__).resolve().parents[2]
CONTENTS = REPOSITORY / "local" / "challenge" / "contents"
TRY = REPOSITORY / "examples" / "participants" / "try.sh"
CHECK = REPOSITORY / "examples" / "contents" / "check.sh"
# In Docker's place: notes its arguments, and copies the contents for the script that asks for it.
DOCKER = """#!/usr/bin/env python3
import json, os, shutil, sys
with open(os.environ["NOTES"], "a") as notes:
    notes.write(json.dumps(sys.argv[1:]) + "\\n")
if "cp -r" in sys.argv[-1]:
    for word in sys.argv:
        host, _, inside = word.partition(":")
        if inside.startswith("/tmp/"):
            shutil.copytree(os.path.join(os.environ["CONTENTS"], os.path.basename(inside)), host, dirs_exist_ok=True)
"""


class Calls:
    """What a script asked of Docker."""

    def __init__(self, script: Path, *arguments: str, contents: Path = CONTENTS) -> None:
        with tempfile.TemporaryDirectory() as folder:
            here = Path(folder)
            docker = here / "docker"
            docker.write_text(DOCKER)
            docker.chmod(0o755)
            runner = here / "leaderboard-runner"
            runner.write_text("#!/bin/sh\n")
            runner.chmod(0o755)
            path = f"{here}:{os.environ['PATH']}"
            env = {**os.environ, "PATH": path, "NOTES": str(here / "notes"), "CONTENTS": str(contents)}
            words = [argument.format(runner=runner, contents=contents) for argument in arguments]
            self.ended = subprocess.run([str(script), *words], cwd=here, env=env, capture_output=True, text=True)
            notes = here / "notes"
            self.calls = [json.loads(line) for line in notes.read_text().splitlines()] if notes.exists() else []

    def container(self, image: str) -> contractcheck.Container:
        """The container of an image that was started."""
        call = next(call for call in self.calls if call[0] == "run" and image in call)
        at = call.index(image)
        options = list(zip(call[1:at], call[2 : at + 1], strict=True))
        env = dict(value.partition("=")[::2] for option, value in options if option == "--env")
        volumes = [value.split(":") for option, value in options if option == "--volume"]
        return contractcheck.Container(
            words=("runner", *call[at + 1 :]), env=env, mounts={volume[1]: volume[2:] == ["ro"] for volume in volumes}
        )


class Tables(unittest.TestCase):
    def text(self, page: str) -> str:
        return (REPOSITORY / "docs" / page).read_text()

    def test_participants_read_which_variables_and_mounts_an_agent_has(self) -> None:
        self.assertEqual(list(contractcheck.agent_faults(REPOSITORY, self.text("participants.md"))), [])

    def test_hosts_read_how_their_images_are_started(self) -> None:
        self.assertEqual(list(contractcheck.contents_faults(REPOSITORY, self.text("contents-image.md"))), [])

    def test_hosts_read_which_labels_a_leaderboard_needs(self) -> None:
        self.assertEqual(list(contractcheck.label_faults(REPOSITORY, self.text("evalai.md"))), [])

    def test_what_is_wrong_with_a_page_is_named(self) -> None:
        page, other = self.text("participants.md"), self.text("contents-image.md")
        for text, fault in (
            (page.replace("| `RESUME` |", "| `CONTINUE` |"), "the variable RESUME is not on the page"),
            (
                page.replace("| `RESUME` |", "| `CONTINUE` |"),
                "the variable CONTINUE is on the page, and the Job has none",
            ),
            (
                page.replace("| `/tmp/agent` | writable", "| `/tmp/agent` | read-only"),
                "the mount /tmp/agent is read-only",
            ),
        ):
            self.assertTrue(any(fault in found for found in contractcheck.agent_faults(REPOSITORY, text)), fault)
        for text in (other.replace("cp -r ${LEAD", "cp ${LEAD"), other.replace("-opengl -nosound", "-opengl")):
            self.assertNotEqual(list(contractcheck.contents_faults(REPOSITORY, text)), [])
        labels = self.text("evalai.md").replace("`Driving score` |", "`Driving Score` |")
        self.assertNotEqual(list(contractcheck.label_faults(REPOSITORY, labels)), [])


class TryAtHome(unittest.TestCase):
    # What the cluster alone knows: which GPU, that a pair has a node's name files, and how many routes a resume may find done.
    GPU = ("NVIDIA_VISIBLE_DEVICES", "NVIDIA_DRIVER_CAPABILITIES")
    ROUTE_RUNS = "--route-runs="
    NAME_FILES = ("/etc/hosts", "/etc/resolv.conf", "/etc/hostname")

    def test_an_agent_runs_as_in_the_cluster(self) -> None:
        for version in ("v1", "v2"):
            with self.subTest(version):
                made = contractcheck.container(REPOSITORY, version, "agent-1")
                file = made.env["ROUTES"].removeprefix("/workspace/leaderboard/")
                scenarios = made.env.get("SCENARIOS", "").removeprefix("/workspace/leaderboard/")
                calls = Calls(
                    TRY, "--runner", "{runner}", "--contents", "{contents}", "--version", version.upper(),
                    "--routes", file, "--scenarios", scenarios or "none", "--subset", made.env["ROUTES_SUBSET"],
                    "--repetitions", made.env["REPETITIONS"], "team/agent:1",
                )  # fmt: skip
                self.assertEqual(calls.ended.returncode, 0, calls.ended.stderr)
                tried = calls.container("team/agent:1")
                self.assertEqual(tried.command, made.command)
                flags = tuple(flag for flag in made.flags if not flag.startswith(self.ROUTE_RUNS))
                self.assertEqual(tried.flags, flags)
                wanted = {name: value for name, value in made.env.items() if name not in self.GPU}
                self.assertEqual({name: tried.env.get(name) for name in wanted}, {**wanted, "RESUME": ""})
                self.assertEqual(set(tried.env) - set(wanted) - set(self.GPU), set())
                mounts = {path: read_only for path, read_only in made.mounts.items() if path not in self.NAME_FILES}
                own = ("/leaderboard-tools/leaderboard-runner", "/dev/termination-log")
                mounts.pop("/leaderboard-tools")
                self.assertEqual({path: ro for path, ro in tried.mounts.items() if path not in own}, mounts)

    def test_a_server_runs_as_in_the_cluster_and_without_a_network(self) -> None:
        for version in ("v1", "v2"):
            with self.subTest(version):
                made = contractcheck.container(REPOSITORY, version, "simulator-1")
                arguments = ("--runner", "{runner}", "--contents", "{contents}", "--routes", "data/routes_testing.xml")
                calls = Calls(
                    TRY, *arguments, "--version", version.upper(), "--simulator", "a/server:1", "team/agent:1"
                )
                tried = calls.container("a/server:1")
                # Docker's own flag chooses the GPU.
                self.assertEqual(tried.command, tuple(word for word in made.command if "GraphicsAdapter" not in word))
                self.assertEqual({**tried.env, "LEADERBOARD_GPU_INDEX": "0"}, dict(made.env))
                server, agent = (call for call in calls.calls if call[0] == "run")
                self.assertEqual(server[server.index("--network") + 1], "none")
                self.assertTrue(agent[agent.index("--network") + 1].startswith("container:try-"))

    def test_mistakes_are_named(self) -> None:
        for arguments, fault in (
            ((), "usage: try.sh"),
            (("--runner", "none", "--contents", "{contents}", "i"), "none is no program"),
            (("--runner", "{runner}", "--contents", "{contents}", "i"), "data/routes_devtest.xml is missing"),
            (("--runner", "{runner}", "--contents", "{contents}", "--pairs", "4", "i"), "unknown option --pairs"),
            (("--runner", "{runner}", "--contents", "{contents}", "i", "j"), "two images: i and j"),
        ):
            calls = Calls(TRY, *arguments)
            self.assertEqual((calls.ended.returncode, calls.calls), (2, []), fault)
            self.assertIn(fault, calls.ended.stderr)


class CheckContents(unittest.TestCase):
    def test_the_contents_are_copied_as_in_the_cluster(self) -> None:
        calls = Calls(CHECK, "a/contents:1")
        self.assertEqual(calls.ended.returncode, 0, calls.ended.stdout + calls.ended.stderr)
        self.assertEqual(
            calls.ended.stdout, "20 routes: evaluation.carla.routes of the Leaderboard\nThe contents are complete.\n"
        )
        made = contractcheck.container(REPOSITORY, "v2", "contents")
        copy = calls.container("a/contents:1")
        self.assertEqual(("/bin/bash", *copy.words[1:]), made.command)
        # In the cluster the runner keeps what the command prints, which Docker shows.
        runners = {"/leaderboard-tools", "/tmp/leaderboard-log"}
        self.assertEqual(set(copy.mounts) | runners, set(made.mounts))

    def test_what_is_missing_or_out_of_order_is_named(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            contents = Path(folder)
            for inside in (
                "leaderboard/data",
                "leaderboard/leaderboard",
                "scenario_runner",
                "CARLA/PythonAPI/carla/agents",
            ):
                (contents / inside).mkdir(parents=True)
            (contents / "leaderboard/leaderboard/leaderboard_evaluator.py").touch()
            routes = '<routes><route id="0"/><route id="2"/></routes>'
            (contents / "leaderboard/data/routes_testing.xml").write_text(routes)
            (contents / "CARLA/PythonAPI/carla/agents/secret.py").touch(0o600)
            calls = Calls(CHECK, "a/contents:1", "V1", contents=contents)
        self.assertEqual(calls.ended.returncode, 1)
        for line in (
            "missing: scenario_runner/srunner",
            "missing: leaderboard/data/all_towns_traffic_scenarios_private.json",
            "the route at position 1 has the id 2",
            "agents/secret.py",
        ):
            self.assertIn(line, calls.ended.stdout)


class CheckAgent(unittest.TestCase):
    def test_its_agent_lies_where_the_contents_are_mounted(self) -> None:
        text = (REPOSITORY / "examples" / "check-agent" / "Dockerfile").read_text()
        agent = next(line.partition("=")[2] for line in text.splitlines() if line.startswith("ENV TEAM_AGENT="))
        root = contractcheck.container(REPOSITORY, "v2", "agent-1").env["LEADERBOARD_ROOT"]
        # The code of the Leaderboard, and in it the agents that come with it.
        self.assertTrue(agent.startswith(f"{root}/leaderboard/autoagents/"), agent)
