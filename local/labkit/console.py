"""Owns what a person sees while something runs: progress lines and heartbeats on stderr. stdout is for results only."""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from .errors import LabError

HEARTBEAT_SECONDS = 30
# On a terminal a bar moves that often.
BAR_SECONDS = 1
BAR_CELLS = 24
# Of the log of a command that failed.
LAST_LINES = 30
LONGEST_LINE = 300
LONGEST_REASON = 200
# False in a process whose lines are shown next to those of others.
draws_bars = True
NETWORK_WORDS = (
    "dial tcp",
    "no such host",
    "Temporary failure resolving",
    "Could not connect to",
    "Failed to fetch",
    "NewConnectionError",
    "Network is unreachable",
    "proxyconnect",
    "i/o timeout",
    "TLS handshake timeout",
)


def say(text: str) -> None:
    """Prints one progress line."""
    print(f"lab: {text}", file=sys.stderr, flush=True)


def seconds(value: float) -> str:
    """A duration for people: `4.2 s`, `37 s` or `6 min 27 s`."""
    if value < 10:
        return f"{value:.1f} s"
    if value < 120:
        return f"{value:.0f} s"
    return f"{int(value) // 60} min {int(value) % 60} s"


def bar(what: str, spent: float, usual: float) -> str:
    """How far something is that usually takes so long: one line for a terminal."""
    part = min(spent / usual, 0.99)
    cells = "#" * int(part * BAR_CELLS)
    rest = f"of about {seconds(usual)}" if spent < usual else f"where {seconds(usual)} are usual"
    return f"  {what} [{cells:.<{BAR_CELLS}}] {part:4.0%}  {seconds(spent)} {rest}"


def network_failure(output: str) -> str | None:
    """The line of a registry client's output that reports that the network failed, if there is one."""
    lines = [line.strip() for line in output.splitlines()]
    return next((line for line in reversed(lines) if any(word in line for word in NETWORK_WORDS)), None)


def run_long(
    argv: Sequence[str],
    what: str,
    log: Path,
    *,
    cwd: Path | None = None,
    env: Mapping[str, str] | None = None,
    keep: Sequence[int] = (),
    progress: Callable[[str], str] | None = None,
    usual: float = 0,
    group: bool = False,
) -> None:
    """Runs a command that may take minutes: its output goes to `log`, a heartbeat to stderr; raises LabError if it fails.

    `progress` makes of the log so far how far it is, for the heartbeat. With `usual` seconds, a bar takes its place on a terminal.
    With `group`, what the command has started ends with it when we are interrupted, also where the command leaves it behind.
    The command inherits the descriptors in `keep`: a lock among them is held as long as the command lives, even if we die.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    started = time.monotonic()
    draws = draws_bars and usual > 0 and sys.stderr.isatty()
    with log.open("wb") as sink:
        child = subprocess.Popen(
            argv,
            cwd=cwd,
            env=env,
            stdin=subprocess.DEVNULL,
            stdout=sink,
            stderr=subprocess.STDOUT,
            pass_fds=keep,
            process_group=0 if group else None,
        )
        try:
            while True:
                try:
                    code = child.wait(timeout=BAR_SECONDS if draws else HEARTBEAT_SECONDS)
                    break
                except subprocess.TimeoutExpired:
                    if draws:
                        draw(bar(what, time.monotonic() - started, usual))
                        continue
                    far = progress(log.read_text(errors="replace")) if progress else "still running"
                    say(f"  {what}: {far} after {seconds(time.monotonic() - started)}")
        except BaseException:
            if group:
                os.killpg(child.pid, signal.SIGTERM)
            else:
                child.terminate()
            child.wait()
            raise
        finally:
            if draws:
                draw("")
    if code != 0:
        show_end(log)
        raise LabError(failure_line(what, code, log))


def show_end(log: Path) -> None:
    """Prints the last lines of a failed command's log, as the log itself does not outlive every machine."""
    lines = [line.rstrip() for line in log.read_text(errors="replace").splitlines() if line.strip()]
    if lines:
        say("\n".join([f"the end of {log}:", *(f"  | {line[:LONGEST_LINE]}" for line in lines[-LAST_LINES:])]))


def draw(line: str) -> None:
    """Puts one line in place of the last one on the terminal, cut to its width."""
    width = shutil.get_terminal_size().columns - 1
    print(f"\r\x1b[K{line[:width]}", end="", file=sys.stderr, flush=True)


def failure_line(what: str, code: int, log: Path) -> str:
    """One line for a failed command: the network's words if the network failed, else its first error, else its last line."""
    output = log.read_text(errors="replace")
    network = network_failure(output)
    if network is not None:
        return (
            f"{what}: the registry can't be reached ({network[:200]}); "
            f"check the network or the proxy settings, then run the same command again"
        )
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    # A compiler says first what is wrong, everything else says it last.
    words = next((line for line in lines if line.startswith("error")), lines[-1] if lines else "no output")
    return f"{what} failed with exit code {code} ({both_ends(words)}); the whole output is in {log}"


def both_ends(line: str) -> str:
    """A line without its middle where it is long: an engine names the step first and the reason last."""
    if len(line) <= LONGEST_REASON:
        return line
    return f"{line[: LONGEST_REASON // 2]} … {line[-LONGEST_REASON // 2 :]}"
