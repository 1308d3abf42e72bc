"""Owns jobs that run at the same time: each in a process of its own, whose output is printed whole when it ends. Knows no layer of tests.

So what a job prints can be read as if it had run alone. Until then its output is in a file, whose last line is shown every minute.
Jobs of which each line names what it is of are not captured: their lines are printed as they come.
"""

import multiprocessing
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from . import console
from .console import say, seconds
from .process import tail

HEARTBEAT_SECONDS = 60
MOST_OF_LINE = 100
# The jobs of all lanes but the first get what of the cores the first one leaves.
NICE = 5


@dataclass(frozen=True)
class Job:
    name: str
    # What it returns must be picklable; it raises nothing.
    work: Callable[[], Any]


@dataclass(frozen=True)
class Ended:
    job: Job
    seconds: float
    # None: its process ended without a result.
    value: Any


@dataclass(frozen=True)
class Running:
    job: Job
    # What follows in its lane.
    rest: Iterator[Job]
    nice: int
    process: BaseProcess
    answer: Connection
    # None: its output is not captured.
    log: Path | None
    began: float

    def far(self) -> str:
        line = tail(self.log)[:MOST_OF_LINE] if self.log else ""
        return f"{self.job.name} {seconds(time.monotonic() - self.began)} ({line})"

    def end(self) -> Ended:
        """Waits for what is left of its process, and prints what it has printed."""
        try:
            value = self.answer.recv()
        except EOFError:
            value = None
        self.process.join()
        self.answer.close()
        show(self.log)
        return Ended(self.job, time.monotonic() - self.began, value)


def run(lanes: Sequence[Iterable[Job]], logs: Path, captured: bool = True) -> Iterator[Ended]:
    """Runs the jobs of each lane one after the other, the lanes at the same time; gives the jobs as they end."""
    logs.mkdir(parents=True, exist_ok=True)
    running: list[Running] = []
    try:
        for number, lane in enumerate(lanes):
            running += begin(iter(lane), logs if captured else None, NICE if number else 0)
        while running:
            ready = wait([one.answer for one in running], HEARTBEAT_SECONDS)
            if not ready and captured:
                say(f"still at work: {'; '.join(one.far() for one in running)}")
            for one in [one for one in running if one.answer in ready]:
                running.remove(one)
                ended = one.end()
                running += begin(one.rest, logs if captured else None, one.nice)
                yield ended
    finally:
        for one in running:
            one.process.terminate()
            one.process.join()
            show(one.log)


def begin(jobs: Iterator[Job], logs: Path | None, nice: int) -> list[Running]:
    """Starts the next of a lane's jobs; none if there is none."""
    job = next(jobs, None)
    if job is None:
        return []
    log = logs / f"job-{job.name}.log" if logs else None
    if log:
        log.unlink(missing_ok=True)
    # What is still to be printed would be printed by both.
    sys.stdout.flush()
    sys.stderr.flush()
    context = multiprocessing.get_context("fork")
    answer, sender = context.Pipe(duplex=False)
    process = context.Process(target=work, args=(job, log, nice, sender), name=job.name)
    process.start()
    # The child alone holds it, so that its end shows here.
    sender.close()
    return [Running(job, jobs, nice, process, answer, log, time.monotonic())]


def work(job: Job, log: Path | None, nice: int, sender: Connection) -> None:
    """In the child: all output goes to the file."""
    # Two of them would be drawn on one line.
    console.draws_bars = False
    if log:
        with log.open("wb") as sink:
            os.dup2(sink.fileno(), 1)
            os.dup2(sink.fileno(), 2)
    os.nice(nice)
    sender.send(job.work())


def show(log: Path | None) -> None:
    sys.stdout.flush()
    if log and log.exists():
        with log.open("rb") as source:
            shutil.copyfileobj(source, sys.stdout.buffer)
    sys.stdout.flush()
