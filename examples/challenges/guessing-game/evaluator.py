"""The evaluator of a guessing game: an agent looks for numbers from 1 to 1000 with as few guesses as it can."""
import json, os, random, secrets
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

RESULTS, KEPT = Path(os.environ["RESULTS"], "result.json"), Path(os.environ["RESULTS"], "games.json")
HOST, PORT = os.environ["EVALUATOR_ADDRESS"].split(":")
GAMES = range(int(os.environ["WORKER"]) - 1, int(os.environ["GAMES"]), int(os.environ["WORKERS"]))  # this worker's share
played = json.loads(KEPT.read_text()) if KEPT.exists() else []  # after a crash, and with RESUME=1
session, guesses = None, 0

def write(file, document):  # renamed into place: a reader finds the old file or the new one, never a part
    part = file.with_name(f".{file.name}")
    part.write_text(json.dumps(document))
    part.replace(file)

def report():
    write(KEPT, played)
    metrics = {"guesses": sum(played) / len(played), "found": sum(n <= 20 for n in played) / len(played)} if played else {}
    result = {"schema": 1, "done": len(played), "total": len(GAMES), "final": len(played) == len(GAMES)}
    write(RESULTS, result | {"splits": [{"name": "test", "metrics": metrics}]})

class Handler(BaseHTTPRequestHandler):
    timeout = 10  # seconds that a silent connection may keep others waiting

    def do_POST(self):
        global session, guesses
        if self.path == "/session" and session is None:  # one session: other workers' agents reach this port, too
            session = secrets.token_hex(16)
            return self.answer({"session": session})
        try:
            asked = json.loads(self.rfile.read(min(int(self.headers["Content-Length"]), 1000)))
            valid, number = asked["session"] == session, int(asked["number"])
        except (KeyError, TypeError, ValueError):
            valid = False
        if not valid or len(played) == len(GAMES):
            return self.send_error(400)
        secret = random.Random(f"{os.environ['SEED']}-{GAMES[len(played)]}").randint(1, 1000)
        guesses += 1
        if number == secret or guesses > 20:
            played.append(guesses)
            guesses = 0
            report()
        hint = "found" if number == secret else "higher" if number < secret else "lower"
        self.answer({"hint": hint, "over": len(played) == len(GAMES)})

    def answer(self, document):
        self.send_response(200)
        self.end_headers()
        self.wfile.write(json.dumps(document).encode())

report()
server = HTTPServer((HOST, int(PORT)), Handler)
while len(played) < len(GAMES):
    server.handle_request()
