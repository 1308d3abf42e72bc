"""Owns the following of one Submission: a line for each change, until its end is stored everywhere. Called by `demo`."""

import os
import selectors
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from .console import seconds
from .errors import LabError
from .kube import Kube

SEPARATOR = "\x1f"
CONDITION = '{{.status.conditions[?(@.type=="{}")].status}}'
FIELDS = (
    "{.status.state}",
    "{.status.progress.text}",
    "{.status.score.text}",
    "{.status.reason}",
    "{.status.nodeName}",
    CONDITION.format("Published"),
    CONDITION.format("Recorded"),
    "{.status.message}",
)
TEMPLATE = SEPARATOR.join(FIELDS) + '{"\\n"}'


@dataclass(frozen=True)
class Seen:
    """What one version of the object shows."""

    state: str
    progress: str
    score: str
    reason: str
    node: str
    published: str
    recorded: str
    message: str

    @property
    def is_stored(self) -> bool:
        """Nothing more will come."""
        return self.state == "Finished" and self.published == "True" and self.recorded == "True"

    @property
    def is_lost(self) -> bool:
        return self.state in ("Failed", "Cancelled")

    def line(self) -> str:
        """For people, without what does not change at the end."""
        end = [name for name, truth in (("EvalAI", self.published), ("DynamoDB", self.recorded)) if truth == "True"]
        stored = f"stored in S3{''.join(f', {place}' for place in end)}" if self.state == "Finished" else ""
        # While routes are driven the columns show it all.
        is_driven = self.state in ("Running", "Resumed") and not self.reason
        note = stored or ("" if is_driven else self.message or self.reason)
        return f"{self.state or 'New':<10}{self.progress:<7}{self.score:<9}{note}".rstrip()


def parse(line: str) -> Seen | None:
    """One line of kubectl's; None if it is not whole."""
    parts = line.split(SEPARATOR, len(FIELDS) - 1)
    return Seen(*(part.strip() for part in parts)) if len(parts) == len(FIELDS) else None


def follow(kube: Kube, namespace: str, name: str, since: float, patience: float, show: Callable[[str], None]) -> Seen:
    """Shows every change, with the seconds since `since`, until the end is stored; raises if it is not a good one in time."""
    last: Seen | None = None
    deadline = time.monotonic() + patience
    for line in lines(kube, namespace, name, deadline):
        seen = parse(line)
        if seen is None:
            continue
        if last is None or seen.line() != last.line():
            show(f"{seconds(time.monotonic() - since):>8}  {seen.line()}")
        last = seen
        if seen.is_stored:
            return seen
        if seen.is_lost:
            raise LabError(
                f"{name} ended as {seen.state}, {seen.reason}: {seen.message or 'no message'}; {hint(namespace, name)}"
            )
    state = "never had a status" if last is None else f"is still “{last.line()}”"
    raise LabError(f"{name} {state} after {seconds(patience)}; {hint(namespace, name)}")


def hint(namespace: str, name: str) -> str:
    return f"see `kubectl -n {namespace} describe submission {name}` and the controller's log"


def lines(kube: Kube, namespace: str, name: str, deadline: float) -> Iterator[str]:
    """The lines of `kubectl get --watch` until `deadline`; a watch that ends is begun again."""
    command = kube.command(
        "kubectl", "get", "submission", name, f"--namespace={namespace}", "--watch", f"--output=jsonpath={TEMPLATE}"
    )
    while time.monotonic() < deadline:
        with subprocess.Popen(command, env=kube.env, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as watch:
            try:
                yield from until_ended(watch, deadline)
            finally:
                watch.terminate()
        if time.monotonic() < deadline:
            time.sleep(1)


def until_ended(watch: "subprocess.Popen[bytes]", deadline: float) -> Iterator[str]:
    """Whole lines of its output until it ends or the deadline comes."""
    if watch.stdout is None:
        return
    text = b""
    with selectors.DefaultSelector() as selector:
        selector.register(watch.stdout, selectors.EVENT_READ)
        while (left := deadline - time.monotonic()) > 0:
            if not selector.select(left):
                return
            chunk = os.read(watch.stdout.fileno(), 65536)
            if not chunk:
                return
            *whole, text = (text + chunk).split(b"\n")
            yield from (line.decode(errors="replace") for line in whole)
