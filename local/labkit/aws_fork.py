"""Runs AWS's own program many times and loads it once: `python -m labkit.aws_fork SOCKET`, in the virtual environment that has it.

Loading takes longer than a call does. Each call is a connection to the socket, on which `client` is the other side, and a fork of the
process that has the program loaded: no call sees anything of another one.
"""

import json
import os
import signal
import socket
import sys
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NoReturn

# A program under the name `aws`: sends its standard files, words, folder and variables, and ends with the code that comes back.
CLIENT = """#!{python} -S
import json, os, socket, sys
with socket.socket(socket.AF_UNIX) as call:
    call.connect({place!r})
    socket.send_fds(call, [b"."], [0, 1, 2])
    asked = {{"words": sys.argv[1:], "folder": os.getcwd(), "env": dict(os.environ)}}
    call.sendall(json.dumps(asked).encode() + b"\\n")
    sys.exit(int(call.recv(9) or 1))
"""


def client(place: Path) -> str:
    """The text of the program that asks the server at this socket."""
    return CLIENT.format(python=sys.executable, place=str(place))


def serve(place: str, program: Callable[[], int], own: Mapping[str, str]) -> NoReturn:
    """Answers calls until it is killed; a line on standard output shows that it is ready. `own` are variables that the program has set for
    itself as it was loaded."""
    # No one waits for the forks.
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(place)
        server.listen()
        print("ready", flush=True)
        while True:
            call, _ = server.accept()
            if os.fork() == 0:
                answer(call, program, own)
            call.close()


def answer(call: socket.socket, program: Callable[[], int], own: Mapping[str, str]) -> NoReturn:
    """In the fork: becomes the process that asks, as far as the program can see."""
    code: object = 1
    try:
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        _, files, _, _ = socket.recv_fds(call, 1, 3)
        asked = json.loads(call.makefile().readline())
        for number, file in enumerate(files):
            os.dup2(file, number)
        os.chdir(asked["folder"])
        os.environ.clear()
        os.environ.update({**asked["env"], **own})
        sys.argv = ["aws", *asked["words"]]
        code = program()
    except SystemExit as end:
        code = end.code
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        call.sendall(str(code if isinstance(code, int) else int(code is not None)).encode())
        os._exit(0)


def main(place: str) -> NoReturn:
    before = dict(os.environ)
    # Only here, so that a test needs no virtual environment.
    from awscli import clidriver  # noqa: PLC0415

    # What a first call would load.
    clidriver.create_clidriver()
    own = {name: value for name, value in os.environ.items() if before.get(name) != value}
    serve(place, clidriver.main, own)


if __name__ == "__main__":
    main(sys.argv[1])
