"""Owns the commands of `local/lab`: arguments in, exit code out. Results go to stdout, everything else to stderr."""

import argparse
import os
import shlex
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from . import (
    apidocs,
    aws,
    book,
    build,
    chartdocs,
    chartrender,
    charttest,
    cluster,
    crash,
    demo,
    demo_elsewhere,
    dockerfile,
    image,
    kube,
    metricdocs,
    pagetest,
    pictures,
    programdocs,
    pythonenv,
    release,
    testrun,
    tools,
)
from .console import say
from .errors import LabError
from .settings import API_SERVICE_ADDRESS, HOST_ADDRESS, PORTS, Settings, client_environment, load
from .toolsets import SETS

# containerd is built for those who ask for it by a setting.
ALL_TOOLS = [
    name for tool_set in SETS.values() for name in tool_set.tools if name != "pause" and tool_set.name != "containerd"
]


def parser() -> argparse.ArgumentParser:
    top = argparse.ArgumentParser(
        prog="local/lab", description="A real one-node Kubernetes cluster with an AWS stand-in, on this machine."
    )
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    commands.add_parser("up", help="start the cluster, or repair it; prints what to put into the environment")
    commands.add_parser("down", help="end the cluster and remove its data")
    crashed = commands.add_parser("crash", help="kill a part of the running cluster and start it again")
    # Not `choices`: its error is two lines and names no next step.
    crashed.add_argument("part", metavar="PART", help=f"one of {', '.join(crash.PARTS)}")
    crashed.add_argument("--away", type=int, default=0, metavar="SECONDS", help="stay away so long (default: 0)")
    commands.add_parser("status", help="what runs; exits with 1 unless everything does")
    commands.add_parser("env", help='print shell exports: `eval "$(local/lab env)"`')
    named = commands.add_parser("tools", help="build the pinned tools that are missing; prints their folder")
    named.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(ALL_TOOLS)}; none: all of them")
    stand_in = commands.add_parser("aws", help="run the AWS stand-in alone, in the foreground")
    stand_in.add_argument("--port", type=int, default=PORTS["aws"])
    stand_in.add_argument("--bind", default="127.0.0.1", metavar="ADDRESS")
    commands.add_parser(
        "aws-venv", help="print the folder of programs of the Python environment with ministack and boto3"
    )
    demonstration = commands.add_parser(
        "demo", help="start everything, run one submission from message to score, and check it"
    )
    demonstration.add_argument(
        "--registry",
        metavar="NAME",
        help="use the cluster of KUBECONFIG in place of one of our own, and push the images there, such as registry.example/demo",
    )
    add_arguments_of_test(commands.add_parser("test", help="run the tests; prints what each layer took"))
    chart = commands.add_parser("chart-test", help="check the Helm chart against an API server of its own")
    chart.add_argument("--update", action="store_true", help="copy crds/ into the chart first")
    page = commands.add_parser("page-test", help="test the operator's page in a headless Chromium")
    page.add_argument("--pictures", action="store_true", help="take pictures of its test data too, in .local/pictures")
    commands.add_parser(
        "pictures", help="take the pictures of docs/images on the demo's cluster; prints what terminals show"
    )
    engine = commands.add_parser("dockerfile", help="build the Dockerfile with buildah and check its image")
    engine.add_argument("--profile", default=build.PROFILE, help=f"cargo profile (default: {build.PROFILE})")
    commands.add_parser(
        "chart-docs", help="write docs/reference and the tables of the chart's values and of the metrics"
    )
    a_book = commands.add_parser("book", help="make a book of the documents with mdBook, and check its links")
    a_book.add_argument("--search", action="store_true", help="with a search, as it is published")
    one_file = commands.add_parser("install-yaml", help="print one file that installs the operator without Helm")
    one_file.add_argument("more", nargs="*", metavar="ARGUMENT", help="for `helm template`: -- --set a=b")
    commands.add_parser("version", help="print the version of programs and chart; fails where they differ")
    account = commands.add_parser(
        "owner",
        help="write the account on GitHub that publishes the project, wherever it stands; prints the changed files",
    )
    account.add_argument("name", metavar="NAME")
    manifest = commands.add_parser("krew-manifest", help="print the manifest by which krew installs the plugin")
    manifest.add_argument("base", metavar="URL", help="the folder from which the archives are downloaded")
    manifest.add_argument("archives", nargs="+", type=Path, metavar="ARCHIVE", help="the plugin for each machine")
    images = commands.add_parser(
        "image", help="make images and push them to the cluster's registry; prints their references"
    )
    images.add_argument("file", type=Path, metavar="FILE.toml")
    images.add_argument("--profile", default="local", help="cargo profile of the binaries (default: local)")
    images.add_argument("--bin", action="append", default=[], metavar="NAME=PATH", help="a binary in place of cargo's")
    images.add_argument(
        "--tar", type=Path, metavar="OUT", help="write an archive instead of pushing (a file with one image)"
    )
    return top


def add_arguments_of_test(tests: argparse.ArgumentParser) -> None:
    tests.add_argument("--core", action="store_true", help="only the layers that need neither root nor a node")
    tests.add_argument("--filter", default="", metavar="TEXT", help="only tests whose name contains TEXT")
    tests.add_argument(
        "--only",
        action="append",
        default=[],
        choices=testrun.NAMES,
        metavar="LAYER",
        help=f"only this layer (may be repeated): {', '.join(testrun.NAMES)}",
    )


def run(settings: Settings, arguments: argparse.Namespace) -> int:
    """Carries out one command and returns the exit code."""
    match arguments.command:
        case "up":
            cluster.up(settings)
            say('in your shell: eval "$(local/lab env)", or only the line below')
            print(f"export KUBECONFIG={shlex.quote(str(settings.kubeconfig))}")
        case "down":
            cluster.down(settings)
        case "crash":
            crash.crash(settings, arguments.part, arguments.away)
        case "status":
            return 0 if cluster.status(settings) else 1
        case "env":
            print_environment(settings)
        case "tools":
            print(tools.ensure(settings, arguments.names or ALL_TOOLS, os.environ.get("KUBEBUILDER_ASSETS")))
        case "aws":
            aws.foreground(settings, arguments.bind, arguments.port)
        case "aws-venv":
            print(pythonenv.ensure(settings))
        case "demo":
            if arguments.registry:
                demo_elsewhere.run(settings, arguments.registry)
            else:
                demo.run(settings)
        case "test":
            return 0 if testrun.run(settings, arguments.core, arguments.filter, arguments.only) else 1
        case "chart-test":
            charttest.run(settings, arguments.update)
        case "page-test":
            pagetest.run(settings, arguments.pictures)
        case "pictures":
            pictures.run(settings)
        case "dockerfile":
            dockerfile.run(settings, arguments.profile)
        case "chart-docs":
            chartdocs.update(chartrender.folder(settings.repository))
            metricdocs.update(settings.repository)
            apidocs.update(settings.repository)
            programdocs.update(settings.repository)
        case "book":
            say(book.make(settings, arguments.search))
        case "install-yaml":
            helm = kube.Kube(tools.ensure(settings, ["helm"]), dict(os.environ))
            print(chartrender.one_file(helm, chartrender.folder(settings.repository), arguments.more), end="")
        case "version":
            print(release.version(settings.repository))
        case "owner":
            print("\n".join(release.set_owner(settings.repository, arguments.name)))
        case "krew-manifest":
            print(release.krew_manifest(settings.repository, arguments.base, arguments.archives))
        case "image":
            target = image.target_folder(settings.repository, os.environ)
            search = image.Search(image.given_binaries(arguments.bin), target, arguments.profile)
            print("\n".join(image.make(settings, arguments.file, search, arguments.tar)))
    return 0


def print_environment(settings: Settings) -> None:
    """Shell lines that make kubectl, helm and every AWS client speak to the lab, and give kubectl the plugin as cargo builds it."""
    for name, value in client_environment(settings).items():
        print(f"export {name}={shlex.quote(value)}")
    for name in ("NO_PROXY", "no_proxy"):
        print(f'export {name}="{HOST_ADDRESS},{API_SERVICE_ADDRESS}${{{name}:+,${name}}}"')
    folder = tools.gather(settings, {})
    built = image.target_folder(settings.repository, os.environ) / build.PROFILE
    print(f'export PATH={shlex.quote(str(folder))}:"$PATH":{shlex.quote(str(built))}')


def unwind(number: int, _: object) -> None:
    """Ends the program by an exception, so that what it has started ends with it."""
    raise SystemExit(128 + number)


def main(repository: Path, argv: Sequence[str]) -> int:
    """The program: 0 fine, 1 `status` of something that does not run, 2 an error with its next step, 130 interrupted, 143 terminated."""
    signal.signal(signal.SIGTERM, unwind)
    try:
        return run(load(repository), parser().parse_args(argv))
    except LabError as error:
        print(f"lab: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("lab: interrupted; run the same command again to go on", file=sys.stderr)
        return 130
