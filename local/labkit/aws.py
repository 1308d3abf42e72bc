"""Owns the use of the AWS stand-in from the lab's side: running it in the foreground, and having the resources created."""

import os
import subprocess
from collections.abc import Sequence
from pathlib import Path

from . import components, pki, pythonenv
from .errors import LabError
from .settings import Settings, client_environment, without_proxy


def foreground(settings: Settings, address: str, port: int) -> None:
    """Becomes the AWS stand-in, listening at `address`:`port`, until it is interrupted."""
    python = pythonenv.ensure(settings) / "python"
    argv, env = components.aws_command(settings, python, address, port)
    os.execve(argv[0], argv, {**os.environ, **env})


def create_resources(settings: Settings) -> None:
    """Creates the queues, bucket, tables, secrets and the log group in the stand-in, those that are missing."""
    call_client(settings, "aws_resources", ["base", pki.authority_data(settings), settings.api_endpoint])


def create_repositories(settings: Settings, names: Sequence[str]) -> None:
    """Creates the named ECR repositories, those that are missing."""
    call_client(settings, "aws_resources", ["repositories", *names])


def call_client(settings: Settings, module: str, arguments: Sequence[str]) -> str:
    """Runs a module of labkit in the virtual environment, which has boto3; returns what it prints."""
    python: Path = pythonenv.ensure(settings) / "python"
    env = {
        **without_proxy(os.environ),
        **client_environment(settings),
        "PYTHONPATH": str(settings.local),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    argv = [str(python), "-m", f"labkit.{module}", *arguments]
    done = subprocess.run(argv, env=env, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        last = done.stderr.strip().splitlines()[-1:] or ["no output"]
        raise LabError(
            f"the AWS stand-in at {settings.aws_endpoint} refused ({last[0][:300]}); see {settings.logs}/aws.log"
        )
    return done.stdout
