"""Agents of the guessing game that cheat, disturb or fail, for tests. The variable KIND names one; README.md here lists them.

Where its kind says nothing else, each plays as examples/challenges/guessing-game/agent.py does, so that its score shows what it has gained.
"""

import http.client
import json
import os
import signal
import socket
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

WORKER, WORKERS = int(os.environ["WORKER"]), int(os.environ["WORKERS"])
ADDRESS = os.environ["EVALUATOR_ADDRESS"].split(":")
HOST, PORT = ADDRESS[0], int(ADDRESS[1])
# What is in here outlives containers and Pods.
FOLDER = Path(os.environ.get("FOLDER", "/tmp/agent"))
# Ports of two workers of a Pod are so far apart.
STEP = 100
# An evaluator that ends or refuses raises one of these.
BROKEN = (OSError, http.client.HTTPException)
# What the system shows of itself.
SYSTEM = ("/proc", "/sys")


def post(path: str, body: bytes = b"{}", port: int = PORT) -> dict[str, object]:
    with urllib.request.urlopen(f"http://{HOST}:{port}{path}", body, timeout=30) as answer:
        return json.load(answer)


def begin(port: int = PORT) -> object:
    """Begins the only session of an evaluator."""
    return post("/session", port=port)["session"]


def play(session: object, port: int = PORT, most: int | None = None, always: int | None = None) -> None:
    """Plays until no game is left, or so many: halves the range with each guess, or guesses the same number always."""
    low, high, found, over = 1, 1000, 0, False
    while not over and found != most:
        number = always or (low + high) // 2
        answer = post("/guess", json.dumps({"session": session, "number": number}).encode(), port)
        hint, over = answer["hint"], bool(answer["over"])
        found += hint == "found"
        low, high = {"higher": (number + 1, high), "lower": (low, number - 1), "found": (1, 1000)}[str(hint)]
        print(f"{number}: {hint}", flush=True)


def is_first_life() -> bool:
    """Whether no agent of this worker has asked before."""
    mark = FOLDER / "began"
    if mark.exists():
        return False
    mark.write_text("1\n")
    return True


def folders() -> Iterator[Path]:
    for folder, names, _ in os.walk("/"):
        names[:] = [name for name in names if os.path.join(folder, name) not in SYSTEM]
        yield Path(folder)


def hold() -> None:
    """Plays one game as worker 1, three as worker 2, and waits; another life plays the rest."""
    session = begin()
    if is_first_life():
        play(session, most=2 * WORKER - 1)
        signal.pause()
    play(session)


def crash_once() -> None:
    """Crashes after its first game; another life plays the rest."""
    session = begin()
    if is_first_life():
        play(session, most=1)
        sys.exit(1)
    play(session)


def exit_early() -> None:
    """Says after the first game that all is done."""
    play(begin(), most=1)


def never() -> None:
    """Prints and does nothing."""
    signal.pause()


def forge() -> None:
    """Writes into each folder that it can write to that all is done, with the best score, then guesses blindly."""
    if not Path("/tmp/status").is_dir():
        sys.exit("this agent writes into every folder, and belongs into a Pod")
    splits = [{"name": "test", "metrics": {"guesses": 1.0, "found": 1.0}}]
    result = {"schema": 1, "done": 8, "total": 8, "final": True, "splits": splits}
    files = {
        f"{side}-{worker}.done": "" for side in ("agent", "evaluator") for worker in range(1, WORKERS + 1)
    } | dict.fromkeys(("result.json", f"evaluators/{WORKER}/result.json"), json.dumps(result))
    written = 0
    for folder in [Path("/results"), *folders()]:
        for name, text in files.items():
            with suppress(OSError):
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                (folder / name).write_text(text)
                written += 1
    print(f"forged: {written} files", flush=True)
    play(begin(), always=1)


def steal() -> None:
    """Looks for what the evaluator holds in memory, in files and in its environment, prints it, then plays."""
    found = [str(path) for path in Path("/dev/shm").iterdir()]
    found += [f"variable {name}" for name in ("SEED", "GAMES", "RESULTS", "RESUME") if name in os.environ]
    secret = {"evaluator.py", "evaluators", "games.json", "labels", "result.json"}
    found += [str(path) for folder in folders() for path in listed(folder) if path.name in secret]
    found += [str(path) for path in listed(Path("/results"))]
    for process in Path("/proc").glob("[0-9]*"):
        for name, trace in (("cmdline", b"evaluator.py"), ("environ", b"SEED=")):
            with suppress(OSError):
                found += [str(process / name)] if trace in (process / name).read_bytes() else []
    print(f"found: {', '.join(found) or 'nothing'}", flush=True)
    play(begin())


def listed(folder: Path) -> list[Path]:
    with suppress(OSError):
        return list(folder.iterdir())
    return []


def other_worker() -> None:
    """As worker 2, takes the session of worker 1, whose agent waits, asks for a second one, and plays both."""
    if WORKER == 1:
        signal.pause()
    other = PORT - STEP
    session = None
    while session is None:
        try:
            session = begin(other)
        except urllib.error.HTTPError:
            raise
        except urllib.error.URLError:
            # It does not listen yet.
            time.sleep(0.05)
    try:
        begin(other)
        print("a second session: given", flush=True)
    except urllib.error.HTTPError as error:
        print(f"a second session: {error.code}", flush=True)
    # The evaluator may be ended with its last game, before it has answered.
    with suppress(*BROKEN):
        play(session, other)
    play(begin())


def provoke() -> None:
    """Sends what a careless evaluator raises at, and asks it to raise; plays on if it goes on."""
    session = begin()
    texts = [b"", b"[", b"\xff\xfe", b"null", b"[]", b"[" * 900, b'{"number": NaN}', b'{"number": 1e999}']
    numbers = [b"null", b"[]", b'"x"', b"1e999", b"NaN"]
    texts += [b'{"session": "%s", "number": %s}' % (str(session).encode(), number) for number in numbers]
    for text in texts:
        with suppress(*BROKEN):
            post("/guess", text)
    for length in (b"-1", b"x", b"9" * 20):
        with suppress(*BROKEN), socket.create_connection((HOST, PORT), 30) as stream:
            stream.sendall(b"POST /guess HTTP/1.1\r\nContent-Length: %s\r\n\r\n" % length)
            stream.shutdown(socket.SHUT_WR)
            stream.recv(1000)
    with suppress(urllib.error.HTTPError):
        post("/raise")
    play(session)


def make_raise() -> None:
    """Asks its evaluator to raise, in each life."""
    begin()
    with suppress(*BROKEN):
        post("/raise")
    signal.pause()


def take_port() -> None:
    """As worker 2, makes its evaluator end once worker 1 is there; as worker 1, listens on that evaluator's port from then on."""
    if WORKER == 2:
        while True:
            with suppress(ConnectionRefusedError):
                socket.create_connection((HOST, PORT - STEP + 1)).close()
                break
            time.sleep(0.05)
        post("/raise")
    with socket.create_server((HOST, PORT + 1)), socket.socket() as taken:
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        while True:
            try:
                taken.bind((HOST, PORT + STEP))
                break
            except OSError:
                time.sleep(0.001)
        taken.listen()
        print("taken", flush=True)
        signal.pause()


KINDS = {
    "hold": hold,
    "crash-once": crash_once,
    "exit-early": exit_early,
    "never": never,
    "forge": forge,
    "steal": steal,
    "other-worker": other_worker,
    "provoke": provoke,
    "raise": make_raise,
    "take-port": take_port,
}

KINDS[os.environ["KIND"]]()
