"""Owns the life of our background processes: start with a pidfile, recognize, stop.

A process is ours only if its pid, its start time, the boot and its program are the ones of the pidfile, so a pid that was
given to someone else is never signaled. The pidfile is written by the child itself just before it becomes the program:
however the starter dies, no process of ours runs without one.
"""

import json
import os
import select
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from .errors import LabError

LOG_LIMIT_BYTES = 32 << 20
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


@dataclass(frozen=True)
class Identity:
    """What distinguishes our process from every other one, and the digest of what it was started with."""

    pid: int
    start: int
    boot: str
    program: str
    digest: str


def start_time(stat: str) -> int:
    """Field 22 of /proc/PID/stat, in clock ticks since boot. The second field may hold blanks and brackets."""
    return int(stat.rpartition(")")[2].split()[19])


def state(stat: str) -> str:
    """Field 3 of /proc/PID/stat: `Z` and `X` are processes that have ended."""
    return stat.rpartition(")")[2].split()[0]


def same(identity: Identity, stat: str, cmdline: bytes, boot: str) -> bool:
    """Whether what /proc shows of a pid is the process of `identity`, still running."""
    return (
        boot == identity.boot
        and state(stat) not in "ZX"
        and start_time(stat) == identity.start
        and identity.program.encode() in cmdline.split(b"\0")[:2]
    )


def boot_id() -> str:
    return BOOT_ID.read_text().strip()


def read_pidfile(file: Path) -> Identity | None:
    """The identity in a pidfile; None if there is none or it is torn."""
    try:
        return Identity(**json.loads(file.read_text()))
    except (OSError, ValueError, TypeError):
        return None


def running(identity: Identity | None) -> bool:
    """Whether that very process runs now."""
    if identity is None:
        return False
    folder = Path("/proc") / str(identity.pid)
    try:
        return same(identity, (folder / "stat").read_text(), (folder / "cmdline").read_bytes(), boot_id())
    except (OSError, ValueError):
        return False


# Writes the pidfile, then becomes the program: $0 is the pidfile, $1 the rest of its JSON, the others are the command line.
LAUNCHER = """
pidfile=$0 rest=$1; shift
read -r stat < /proc/$$/stat
start() { shift 21; printf %s "$1"; }
printf '{"pid": %d, "start": %s, %s' $$ "$(start $stat)" "$rest" > "$pidfile.new" && mv "$pidfile.new" "$pidfile" && exec "$@"
"""


def start(
    name: str, argv: Sequence[str], *, env: Mapping[str, str], pidfile: Path, log: Path, digest: str
) -> subprocess.Popen[bytes]:
    """Starts a background process in a session of its own; its output is appended to `log`. Returns once it is the program."""
    pidfile.parent.mkdir(parents=True, exist_ok=True)
    log.parent.mkdir(parents=True, exist_ok=True)
    if log.exists() and log.stat().st_size > LOG_LIMIT_BYTES:
        log.rename(log.with_suffix(".log.1"))
    pidfile.unlink(missing_ok=True)
    rest = json.dumps({"boot": boot_id(), "program": argv[0], "digest": digest}).removeprefix("{")
    with log.open("ab") as sink:
        child = subprocess.Popen(
            ["/bin/sh", "-c", LAUNCHER, str(pidfile), rest, *argv],
            env=dict(env),
            cwd="/",
            stdin=subprocess.DEVNULL,
            stdout=sink,
            stderr=sink,
            start_new_session=True,
        )
    if not wait_until(lambda: running(read_pidfile(pidfile)) or child.poll() is not None, 30, pause=0.005):
        raise LabError(
            f"{name}: {argv[0]} is not started after 30 s: the machine is overloaded, run the same command again"
        )
    return child


def stop(identity: Identity | None, patience: float) -> bool:
    """Asks the process to end, kills it after `patience` seconds, and returns when it is gone. False: it was not running."""
    return end(identity, patience)


def kill(identity: Identity | None) -> bool:
    """Kills the process, which has no moment to prepare, and returns when it is gone. False: it was not running."""
    return end(identity, None)


def end(identity: Identity | None, patience: float | None) -> bool:
    """Ends the process and returns when it is gone; without a request before if `patience` is None."""
    if identity is None:
        return False
    try:
        handle = os.pidfd_open(identity.pid)
    except ProcessLookupError:
        return False
    try:
        # The handle is taken first: from here on the pid can't become someone else's unnoticed.
        if not running(identity):
            return False
        if patience is not None:
            signal.pidfd_send_signal(handle, signal.SIGTERM)
        if patience is None or not ended(handle, patience):
            signal.pidfd_send_signal(handle, signal.SIGKILL)
            if not ended(handle, 20):
                raise LabError(
                    f"process {identity.pid} ({identity.program}) can't be killed: it hangs in the kernel; restart the machine"
                )
        return True
    except ProcessLookupError:
        return True
    finally:
        os.close(handle)


def ended(handle: int, patience: float) -> bool:
    """Waits until the process behind a pidfd has ended, at most `patience` seconds."""
    poll = select.poll()
    poll.register(handle, select.POLLIN)
    return bool(poll.poll(max(0, int(patience * 1000))))


def wait_until(probe: Callable[[], bool], patience: float, pause: float = 0.05) -> bool:
    """Asks `probe` until it is true, at most `patience` seconds; for what can't be watched."""
    deadline = time.monotonic() + patience
    while True:
        if probe():
            return True
        if time.monotonic() >= deadline:
            return False
        time.sleep(pause)


def write_whole(file: Path, text: str, mode: int = 0o600) -> None:
    """Writes a file under a temporary name and renames it: it is there whole or not at all."""
    temporary = file.with_name(f".{file.name}.{os.getpid()}")
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, mode)
    with os.fdopen(descriptor, "w", encoding="utf-8") as handle:
        handle.write(text)
    temporary.rename(file)


def tail(log: Path, lines: int = 1) -> str:
    """The last lines of a log that are not empty, for an error message."""
    try:
        with log.open("rb") as handle:
            handle.seek(max(0, log.stat().st_size - 8192))
            text = handle.read().decode(errors="replace")
    except OSError:
        return ""
    return " | ".join([line.strip() for line in text.splitlines() if line.strip()][-lines:])
