"""Owns the order of all tests and what each layer needs around it. Called by `lab test`, which `make test` and `.ci/run` call.

A layer's own output goes through unchanged, so that the closing lines of the runners can be seen; a table and a summary of what
failed close the run. The layer of the cluster mostly waits, so those that compute run next to it (`lanes`).
"""

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import IO, Any

from . import (
    apiserver,
    awsrecorded,
    build,
    chartalerts,
    charttest,
    cluster,
    demo,
    dockerfile,
    gpus,
    kube,
    lanes,
    packages,
    pagetest,
    processors,
    pythonenv,
    quickstart,
    rights,
    tools,
)
from .console import say, seconds
from .errors import LabError, NotRun
from .failures import Failure, Reader, Summary, failed_cases
from .image import target_folder
from .settings import Settings, client_environment, without_proxy
from .toolsets import ENVTEST_TOOLS

# What the tests of the API server start.
API_TOOLS = (*ENVTEST_TOOLS, "prometheus", "otelcol")
# Test programs of cargo with a layer of their own, as they need an API server or a node.
APART = ("api", "cluster")
OPERATOR = "leaderboard-operator"
# Tests of the API server that run at once, as they wait most of their time for controllers.
AT_ONCE = 6
# The most tests of the cluster that do, which wait for the kubelet. How many in fact is what tests/support/cluster/turns.rs finds.
MOST_AT_ONCE = 8
# Tests that disturb every other one, all of them ignored unless named: they run alone, after the others.
ALONE = "cluster::restarts::"
# A backtrace pushes the message out of what is kept of a long log; `cargo test` itself still gives one.
TEST_OUTPUT = {"RUST_BACKTRACE": "0"}
# So many tests of the cluster that failed next to others are run again; more are no accident of a busy machine.
MOST_AGAIN = 4
# A process that a test leaves behind may keep the output open: after the tests' end it is read for so many seconds.
AFTER_END = 10


@dataclass(frozen=True)
class Plan:
    """What is asked for: the settings, and the part of a test's name, empty for all tests."""

    settings: Settings
    filter: str
    # What failed, as far as the run has come.
    summary: Summary = field(default_factory=Summary)


@dataclass(frozen=True)
class Layer:
    name: str
    about: str
    # Raises LabError if it fails, NotRun where this machine lacks what it needs.
    work: Callable[[Plan], None]
    # It runs next to those of the other lane of its stage.
    lane: str
    # Needs root: for a node, or to install what is missing.
    needs_root: bool = False


@dataclass(frozen=True)
class Outcome:
    """What came of one run of `cargo test`."""

    passed: bool
    # Every test program came to its end, so that `failures` has all failed tests.
    is_whole: bool
    failures: list[Failure]


@dataclass(frozen=True)
class Result:
    name: str
    seconds: float
    # Empty: it passed, or was not run.
    failure: str
    # What this machine lacks for it.
    lacks: str = ""
    # Seconds that the processors have worked for it.
    cpu: float = 0


def run(settings: Settings, core: bool, name_filter: str, only: Sequence[str]) -> bool:
    """Runs the layers, going on after a failure; returns whether all of them passed."""
    started, worked = time.monotonic(), processors.machine()
    chosen = [layer for layer in LAYERS if not (core and layer.needs_root) and (not only or layer.name in only)]
    if not chosen:
        raise LabError("no layer is left to run: the cluster's needs a node, so leave --core out")
    # A disk that fills in mid-run fails a layer that has nothing to do with it.
    for folder in (settings.cache, settings.state, target_folder(settings.repository, os.environ)):
        tools.check_space(folder)
    plan = Plan(settings, name_filter)
    results: list[Result] = []
    for at_once in stages(chosen):
        if len(at_once) > 1:
            results += side_by_side(plan, at_once, results)
        for layer in at_once[0] if len(at_once) == 1 else []:
            results.append(run_layer(plan, layer, results))
    results.sort(key=lambda result: NAMES.index(result.name))
    lines = table(results, time.monotonic() - started, processors.machine() - worked)
    print("\n".join([lines, *plan.summary.lines()]), flush=True)
    return not any(result.failure for result in results)


def stages(chosen: Sequence[Layer]) -> Iterator[list[list[Layer]]]:
    """The layers of each stage, the stages in turn: those of a lane in turn, its lanes at once."""
    for stage in STAGES:
        lanes_of = [[layer for layer in chosen if layer.lane == lane] for lane in stage]
        if found := [lane for lane in lanes_of if lane]:
            yield found


def side_by_side(plan: Plan, at_once: Sequence[Sequence[Layer]], before: Sequence[Result]) -> list[Result]:
    """Runs each lane next to the others; the results as the layers end."""
    names = " next to ".join(", ".join(layer.name for layer in lane) for lane in at_once)
    say(f"{names}: each prints its output when it ends; until then it is in {plan.settings.logs}/job-*.log")
    results = []
    for ended in lanes.run([[job(plan, layer, before) for layer in lane] for lane in at_once], plan.settings.logs):
        result, summary = ended.value or (
            Result(ended.job.name, ended.seconds, "its process ended without a result, see above"),
            Summary(),
        )
        results.append(result)
        plan.summary.take(summary)
        say(f"{result.name} took {seconds(result.seconds)}: {result.failure or result.lacks or 'passed'}")
    return results


def job(plan: Plan, layer: Layer, before: Sequence[Result]) -> lanes.Job:
    """A layer as work for a process of its own, which gives back what it found."""
    own = replace(plan, summary=Summary())
    return lanes.Job(layer.name, lambda: (run_layer(own, layer, before), own.summary))


def run_layer(plan: Plan, layer: Layer, before: Sequence[Result]) -> Result:
    if layer.name != "lab" and any(result.name == "build" and result.failure for result in before):
        return Result(layer.name, 0, "not run, as the build failed")
    say(f"--- {layer.name}: {layer.about}")
    started, worked = time.monotonic(), processors.of_this_process()
    failure, lacks = "", ""
    try:
        layer.work(plan)
    except NotRun as reason:
        lacks = str(reason)
        say(f"{layer.name} was not run: {lacks}")
    except LabError as error:
        failure = str(error)
        say(f"{layer.name} failed: {failure}")
    cpu = processors.of_this_process() - worked
    return Result(layer.name, time.monotonic() - started, failure, lacks, cpu)


def table(results: Sequence[Result], whole: float, machine: float) -> str:
    """Each layer with its time, the seconds that the processors have worked for it, and what failed or was not run; and the whole run.

    The machine's seconds have what no layer has waited for: the cluster, and servers that end after their tests.
    """
    lines = ["", f"{'':<9}{'took':>13}{'CPU s':>8}"]
    for result in results:
        lacks = f"not run: {result.lacks}" if result.lacks else ""
        end = result.failure or lacks or "passed"
        lines.append(f"{result.name:<9}{seconds(result.seconds):>13}{result.cpu:>8.0f}   {end}")
    others = machine - sum(result.cpu for result in results)
    if others > 0:
        about = "the cluster's parts and Pods, servers that outlive their tests, other programs"
        lines.append(f"{'others':<9}{'':>13}{others:>8.0f}   {about}")
    failed = [result.name for result in results if result.failure]
    left_out = [result.name for result in results if result.lacks]
    end = f"failed: {', '.join(failed)}" if failed else "passed"
    end += f"; not run: {', '.join(left_out)}" if left_out else ""
    lines.append(f"{'all':<9}{seconds(whole):>13}{machine:>8.0f}   {end}")
    return "\n".join(lines)


def lab(plan: Plan) -> None:
    local = plan.settings.local
    argv = [sys.executable, "-m", "unittest", "discover", "--start-directory", str(local / "tests")]
    argv += ["--top-level-directory", str(local)] + (["-k", plan.filter] if plan.filter else [])
    code = call(plan, argv, {"PYTHONDONTWRITEBYTECODE": "1"})
    # 5: no test has such a name, which is for other layers to have.
    if code not in (0, 5 if plan.filter else 0):
        raise LabError("python3 -m unittest found failures, see above")


def make_tools(plan: Plan) -> None:
    """What would otherwise be built next to tests with limits of time."""
    packages.ensure(plan.settings)
    tools.ensure(
        plan.settings, [*cluster.tools_of(plan.settings), *apiserver.TOOLS, *API_TOOLS, chartalerts.TOOL, gpus.TOOL]
    )
    pythonenv.ensure(plan.settings)


def compile_all(plan: Plan) -> None:
    """Everything at once: the tests, and with them the programs that the later layers run."""
    argv = ["test", "--workspace", "--profile", build.PROFILE, "--no-run"]
    build.cargo(plan.settings, argv, "building the tests", 600)
    build.static_programs(plan.settings)


def unit(plan: Plan) -> None:
    """Pure logic, scenarios against a mock, processes against folders and stand-ins of this machine."""
    names = [name for name in test_targets(plan.settings) if name not in APART]
    target = ["--lib", "--bins", *(f"--test={name}" for name in names)]
    run_twice(plan, target, test_environment(plan.settings), None)


def api(plan: Plan) -> None:
    """Many controllers on one API server; on a busy machine a test can run out of time next to others."""
    require_target(plan.settings, "api")
    run_twice(plan, ["--test=api"], test_environment(plan.settings), AT_ONCE)


def chart(plan: Plan) -> None:
    if plan.filter:
        say("no single test here has a name: left out because of --filter")
        return
    charttest.run(plan.settings, update=False)


def page(plan: Plan) -> None:
    if plan.filter:
        say("no single test here has a name: left out because of --filter")
        return
    pagetest.run(plan.settings, pictures=False)


def image(plan: Plan) -> None:
    if plan.filter:
        say("no single test here has a name: left out because of --filter")
        return
    dockerfile.run(plan.settings, build.PROFILE)


def in_cluster(plan: Plan) -> None:
    """The real thing: the node, the images and the AWS stand-in; EvalAI's runs inside of the tests."""
    require_target(plan.settings, "cluster")
    cluster.check_machine(plan.settings)
    folder = tools.ensure(plan.settings, [*cluster.CLUSTER_TOOLS, "helm", gpus.TOOL])
    cluster.up(plan.settings)
    gpus.ensure(plan.settings, folder)
    demo.take_away(kube.of_lab(plan.settings, folder))
    images = demo.make_images(plan.settings)
    env = {
        **test_environment(plan.settings),
        **without_proxy(os.environ),
        **client_environment(plan.settings),
        "PATH": f"{folder}:{os.environ.get('PATH', '')}",
        # What Pods run next to the participant's image; the test starts controller and bridge itself, to kill them.
        "LEADERBOARD_OPERATOR_IMAGE": images[demo.OPERATOR],
        "LEADERBOARD_QUICKSTART_IMAGES": " ".join(quickstart.images(plan.settings)),
        "LEADERBOARD_OPERATOR_BIN": str(build.program(plan.settings, OPERATOR)),
    }
    lines = plan.settings.logs / "matrix.tsv"
    lines.unlink(missing_ok=True)
    began, worked = rights.now(), parts_worked(plan.settings)
    try:
        run_cluster_tests(plan, {**env, "LEADERBOARD_MATRIX": str(lines)})
    finally:
        say(f"CPU s next to the tests: {processors.since(worked, parts_worked(plan.settings))}")
        if lines.exists():
            text = lines.read_text()
            plan.summary.cases += failed_cases(text)
            print(matrix(text), flush=True)
    # Of a part of the tests it would say that the rest is not used.
    if not plan.filter:
        say(rights.check(kube.of_lab(plan.settings, folder), plan.settings.repository, plan.settings.audit_log, began))
        policies = plan.settings.repository / "examples" / "aws" / "iam"
        say(awsrecorded.check(policies, plan.settings.aws_calls, began))


def parts_worked(settings: Settings) -> dict[str, float]:
    return processors.of_cluster(settings, (*cluster.NAMES, *cluster.GUESTS))


def run_cluster_tests(plan: Plan, env: dict[str, str]) -> None:
    """Most at once, then one by one those that kill what the others need; these too if others have failed."""
    target = ["--test=cluster"]

    def at_once(threads: int, harness: Sequence[str]) -> Outcome:
        return cargo_outcome(plan, target, {**env, "RUST_TEST_THREADS": str(threads)}, harness)

    passed = settle(plan.summary, at_once(MOST_AT_ONCE, [plan.filter]), lambda names: at_once(1, ["--exact", *names]))
    alone = names_alone(ignored_tests(plan, target, env), plan.filter)
    if not alone and not plan.filter:
        raise LabError(
            f"there is no ignored test {ALONE}…: a rename in tests/cluster has lost what testrun.py runs alone"
        )
    if alone:
        say("now, one by one, the tests that disturb every other one")
        last = at_once(1, ["--ignored", "--exact", *alone])
        plan.summary.failed += last.failures
        passed &= last.passed
    if not passed:
        raise LabError("cargo test found failures, see below")


def settle(summary: Summary, first: Outcome, again: Callable[[Sequence[str]], Outcome]) -> bool:
    """Runs a few failed tests once more, alone; returns whether all passed in the end."""
    names = [failure.name for failure in first.failures]
    if first.passed or not first.is_whole or len(names) > MOST_AGAIN:
        summary.failed += first.failures
        return first.passed
    say(f"now once more, one by one, what failed next to others: {', '.join(names)}")
    second = again(names)
    failed = {failure.name for failure in second.failures}
    if not second.is_whole:
        summary.failed += [*first.failures, *second.failures]
        return False
    # The message of the first failure is the one that a person must explain.
    summary.failed += [failure for failure in first.failures if failure.name in failed]
    summary.passed_alone += [failure for failure in first.failures if failure.name not in failed]
    return second.passed


def ignored_tests(plan: Plan, targets: Sequence[str], env: dict[str, str]) -> str:
    """What the test program lists as its ignored tests."""
    argv = [*cargo_argv(targets), "--", "--ignored", "--list", "--format=terse"]
    whole = {**os.environ, **env}
    done = subprocess.run(argv, cwd=plan.settings.repository, env=whole, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise LabError(f"cargo test --list failed: {done.stderr.strip()[-300:]}")
    return done.stdout


def names_alone(listed: str, name_filter: str) -> list[str]:
    """Of a terse list of ignored tests those that run alone and have the filter's text in their names, as cargo's would."""
    names = [line.removesuffix(": test") for line in listed.splitlines() if line.endswith(": test")]
    return [name for name in names if name.startswith(ALONE) and name_filter in name]


def matrix(lines: str) -> str:
    """The cases that the tests wrote down, one a line: what was expected, what was seen, and after how many seconds."""
    titles = ["case", "expected", "seen", "shown after s"]
    rows = [titles, *sorted(line.split("\t") for line in lines.splitlines())]
    widths = [max(len(row[column]) for row in rows) for column in range(len(titles))]
    text = ("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows)
    return "\n".join(["", *text])


def test_environment(settings: Settings) -> dict[str, str]:
    """Where the tests find an API server and the AWS stand-in."""
    assets = tools.ensure(settings, API_TOOLS, os.environ.get("KUBEBUILDER_ASSETS"))
    ministack = pythonenv.ensure(settings) / "ministack"
    return {"KUBEBUILDER_ASSETS": str(assets), "LEADERBOARD_MINISTACK": str(ministack)}


def run_twice(plan: Plan, targets: Sequence[str], env: dict[str, str], threads: int | None) -> None:
    """Runs tests at once, as many as the machine has cores unless told, and a few that failed once more, alone."""
    many = {} if threads is None else {"RUST_TEST_THREADS": str(threads)}
    first = cargo_outcome(plan, targets, {**env, **many}, [plan.filter])

    def again(names: Sequence[str]) -> Outcome:
        return cargo_outcome(plan, targets, {**env, "RUST_TEST_THREADS": "1"}, ["--exact", *names])

    if not settle(plan.summary, first, again):
        raise LabError("cargo test found failures, see below")


def cargo_outcome(plan: Plan, targets: Sequence[str], env: dict[str, str], harness: Sequence[str]) -> Outcome:
    """Runs tests; `harness` are arguments of the test programs: options and parts of names."""
    build.check_cargo()
    reader = Reader()
    argv = [*cargo_argv(targets), "--", *filter(None, harness)]
    code = stream(plan, argv, {**env, **TEST_OUTPUT}, reader)
    return outcome_of(code, reader)


def outcome_of(code: int, reader: Reader) -> Outcome:
    failures = reader.failures()
    if code == 0 or failures and reader.is_whole():
        return Outcome(code == 0, True, failures)
    lost = Failure("a test program that ended without its result, or was not built", [list(reader.tail)])
    return Outcome(False, False, [*failures, lost])


def cargo_argv(targets: Sequence[str]) -> list[str]:
    return ["cargo", "test", "--workspace", "--profile", build.PROFILE, "--no-fail-fast", *targets]


def call(plan: Plan, argv: Sequence[str], env: dict[str, str]) -> int:
    """Runs a test runner with its output left as it is."""
    sys.stdout.flush()
    whole = {**os.environ, "CARGO_TERM_PROGRESS_WHEN": "never", **env}
    return subprocess.run(
        argv, cwd=plan.settings.repository, env=whole, stdin=subprocess.DEVNULL, check=False
    ).returncode


def stream(plan: Plan, argv: Sequence[str], env: dict[str, str], reader: Reader) -> int:
    """Runs a test runner; what it prints goes through unchanged, and to the reader."""
    sys.stdout.flush()
    whole = {**os.environ, "CARGO_TERM_PROGRESS_WHEN": "never", **env}
    # No `with`: it would close the output, and wait for its reader, which may wait for a process that a test left behind.
    process = subprocess.Popen(
        argv,
        cwd=plan.settings.repository,
        env=whole,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    copier = threading.Thread(target=copy, args=(process.stdout, reader), daemon=True)
    copier.start()
    try:
        code = process.wait()
    except BaseException:
        process.kill()
        raise
    copier.join(AFTER_END)
    if not copier.is_alive():
        process.stdout.close()
    return code


def copy(output: IO[bytes], reader: Reader) -> None:
    for line in output:
        sys.stdout.buffer.write(line)
        sys.stdout.buffer.flush()
        reader.feed(line.decode(errors="replace"))


def test_targets(settings: Settings) -> list[str]:
    """The names of all test programs that have a file of their own."""
    argv = ["cargo", "metadata", "--no-deps", "--format-version=1"]
    done = subprocess.run(argv, cwd=settings.repository, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise LabError(f"cargo metadata failed: {done.stderr.strip()[-300:]}")
    return names_of_tests(json.loads(done.stdout))


def names_of_tests(metadata: dict[str, Any]) -> list[str]:
    targets = [target for package in metadata["packages"] for target in package["targets"]]
    return sorted({target["name"] for target in targets if target["kind"] == ["test"]})


def require_target(settings: Settings, name: str) -> None:
    if name not in test_targets(settings):
        raise LabError(f"there is no test program {name}: tests/{name}.rs is missing")


# The first build, of Go next to Rust. Then the cluster, which waits most of its time: for the kubelet, for runs, for what dies. The
# others compute.
GO, RUST, WAITS, COMPUTES = "go", "rust", "waits", "computes"
STAGES = ((GO, RUST), (WAITS, COMPUTES))
LAYERS = (
    Layer("lab", "local/ itself, in Python", lab, COMPUTES),
    Layer("tools", "etcd, the API server and all others, kept from run to run", make_tools, GO, needs_root=True),
    Layer("build", "all tests, and the programs they run", compile_all, RUST),
    Layer("unit", "pure logic, mock clients, and processes on this machine", unit, COMPUTES),
    Layer("api", "a real API server, without nodes", api, COMPUTES),
    Layer("page", "the operator's page, in a headless Chromium", page, COMPUTES, needs_root=True),
    Layer("chart", "the Helm chart, against an API server", chart, COMPUTES),
    Layer("image", "the Dockerfile, by a container engine", image, COMPUTES, needs_root=True),
    Layer("cluster", "a real node with containers", in_cluster, WAITS, needs_root=True),
)
NAMES = tuple(layer.name for layer in LAYERS)
