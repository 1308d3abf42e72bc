"""Owns a server of the page's files and of a view, for its test: on loopback, with the policy that the operator sends.

The files are those of `src/page/web`. The view and the submissions are those that the operator's unit tests assert (`src/page/golden`).
"""

import json
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

# An address of one submission, as the operator serves it.
SUBMISSIONS = "/submissions/"
KINDS = {".html": "text/html; charset=utf-8", ".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}
# The moment of the golden view, 2026-11-01T12:00:00Z.
MOMENT = 1793534400


class Page:
    """Serves the page on loopback. `event` is what the stream sends; `changed` sends it to those who look."""

    def __init__(self, repository: Path) -> None:
        self.web = repository / "src" / "page" / "web"
        golden = repository / "src" / "page" / "golden"
        self.view = at_present(json.loads((golden / "view.json").read_text()))
        self.details = at_present(json.loads((golden / "details.json").read_text()))
        self.event = event(self.view)
        self.changes = threading.Condition()
        self.version = 0
        self.refuses = False
        self.server = ThreadingHTTPServer(("127.0.0.1", 0), handler(self))
        self.server.daemon_threads = True
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server.server_port}/"

    def send(self, data: bytes, refuses: bool = False) -> None:
        with self.changes:
            self.event, self.refuses = data, refuses
            self.version += 1
            self.changes.notify_all()

    def news(self, known: int) -> tuple[int, bytes]:
        """Waits for what is newer than a version."""
        with self.changes:
            self.changes.wait_for(lambda: self.version != known)
            return self.version, self.event

    def close(self) -> None:
        self.send(b"", refuses=True)
        self.server.shutdown()
        self.server.server_close()


def event(view: dict[str, Any]) -> bytes:
    return f"retry: 50\ndata: {json.dumps(view)}\n\n".encode()


def at_present(value: Any) -> Any:
    """The view with its moments as long ago as they were."""
    if isinstance(value, dict):
        return {key: at_present(one) for key, one in value.items()}
    if isinstance(value, list):
        return [at_present(one) for one in value]
    is_moment = isinstance(value, int) and not isinstance(value, bool) and value > 1_000_000_000
    return value + int(time.time()) - MOMENT if is_moment else value


def handler(page: Page) -> type[BaseHTTPRequestHandler]:
    policy = (page.web / "policy.txt").read_text().strip()

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

        def do_GET(self) -> None:
            path = page.web / (self.path.strip("/") or "index.html")
            if self.path == "/events":
                self.stream()
            elif self.path.startswith(SUBMISSIONS):
                self.submission(self.path.removeprefix(SUBMISSIONS))
            elif path.suffix in KINDS and path.is_file():
                self.begin(200, KINDS[path.suffix])
                self.wfile.write(path.read_bytes())
            else:
                self.begin(404, "text/plain")

        def begin(self, code: int, kind: str) -> None:
            self.send_response(code)
            self.send_header("content-type", kind)
            self.send_header("content-security-policy", policy)
            self.end_headers()

        def submission(self, key: str) -> None:
            self.begin(200 if key in page.details else 404, "application/json")
            if key in page.details:
                self.wfile.write(json.dumps(page.details[key]).encode())

        def stream(self) -> None:
            if page.refuses:
                return self.begin(503, "text/plain")
            self.begin(200, "text/event-stream")
            known = -1
            while not page.refuses:
                known, data = page.news(known)
                try:
                    self.wfile.write(data)
                    self.wfile.flush()
                except OSError:
                    return None
            return None

    return Handler
