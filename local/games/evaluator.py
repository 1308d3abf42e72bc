"""Evaluators of the guessing game with one fault each, for tests. The variable FAULT names it; README.md here lists them.

All but `labels` take the first guess for the end of their only game, and then write their result.
"""

import json
import math
import os
import runpy
import sys
import time
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

RESULTS = Path(os.environ["RESULTS"])
HOST, PORT = os.environ["EVALUATOR_ADDRESS"].split(":")
# No game needs so many halves or so few.
GUESSES = {"guesses": 3.5, "found": 1.0}


class Handler(BaseHTTPRequestHandler):
    is_over = False

    def do_POST(self) -> None:
        if self.path == "/raise":
            os._exit(1)
        Handler.is_over |= self.path == "/guess"
        self.send_response(200)
        self.end_headers()
        answer = {"session": "any", "hint": "found", "over": Handler.is_over}
        self.wfile.write(json.dumps(answer).encode())


def write(*splits: dict[str, object], **more: object) -> None:
    result = {"schema": 1, "done": 1, "total": 1, "final": True, "splits": splits, **more}
    part = RESULTS / ".result.json"
    part.write_text(json.dumps(result))
    part.replace(RESULTS / "result.json")


def split(name: str, **metrics: float) -> dict[str, object]:
    return {"name": name, "metrics": GUESSES | metrics}


def late() -> None:
    """It computes on when its agent has ended."""
    time.sleep(2)
    write(split("test"))


FAULTS = {
    "none": lambda: write(split("test")),
    "late": late,
    "nan": lambda: write(split("test", guesses=math.nan)),
    "no-score": lambda: write({"name": "test", "metrics": {"found": 1.0}}),
    "two-splits": lambda: write(split("easy"), split("hard", guesses=7.25)),
    "not-eligible": lambda: write(split("test"), eligible=False),
    "refuse": lambda: write(final=False, done=0, refused="The agent has guessed a number that is not in the game."),
    "exit-65": lambda: sys.exit(65),
}

if os.environ["FAULT"] == "labels":
    Path("/dev/shm/labels").write_text(os.environ["SEED"])
    runpy.run_path("/honest.py", run_name="__main__")
    sys.exit()
server = HTTPServer((HOST, int(PORT)), Handler)
while not Handler.is_over:
    server.handle_request()
FAULTS[os.environ["FAULT"]]()
