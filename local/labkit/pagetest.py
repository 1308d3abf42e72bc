"""Owns the test of the operator's page in a headless Chromium, and how pictures of it are taken.

Called by `lab test` and `lab page-test`. The page's files and the policy of their content are those that the operator serves
(`src/page/web`), the view is the one that its unit tests assert (`src/page/golden`); the operator's own server has its tests in
`src/page` and `tests/api/page.rs`.
"""

import hashlib
import json
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from . import browser, packages, pythonenv
from .browser import Tab, complaints
from .console import say, seconds
from .errors import LabError
from .settings import Settings
from .tools import lock

KINDS = {".html": "text/html; charset=utf-8", ".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}
# The moment of the golden view, 2026-11-01T12:00:00Z.
MOMENT = 1793534400
# name -> width, height, colours
PICTURES = {
    "page-light": (1200, 1000, "light"),
    "page-dark": (1200, 1000, "dark"),
    "page-phone-light": (360, 1100, "light"),
    "page-phone-dark": (360, 1100, "dark"),
}
LARGEST_PICTURE = 400 * 1024
# The view of a draw as large as the operator sends is drawn within this time, on a busy machine.
DRAW_MS = 5000


class Page:
    """Serves the page on loopback. `event` is what the stream sends; `changed` sends it to those who look."""

    def __init__(self, repository: Path) -> None:
        self.web = repository / "src" / "page" / "web"
        self.view = at_present(json.loads((repository / "src" / "page" / "golden" / "view.json").read_text()))
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


def run(settings: Settings, pictures: bool) -> None:
    """All checks; raises with the first one that fails. `pictures`: of the view of the tests, to look at a change of the page."""
    ensure_browser(settings)
    script = axe(settings)
    page = Page(settings.repository)
    try:
        with browser.tab() as tab:
            for what, work in CHECKS.items():
                started = time.monotonic()
                try:
                    summary = work(tab, page)
                except LabError as error:
                    raise LabError(f"page: {what}: {error}") from error
                print(f"ok    {what:<48} {summary} ({seconds(time.monotonic() - started)})", flush=True)
            accessible(tab, page, script)
            if pictures:
                take(tab, page, settings.state / "pictures")
    finally:
        page.close()


def ensure_browser(settings: Settings) -> None:
    if browser.program() is None:
        say(f"installing {browser.PACKAGE} with apt-get, usually 30 s")
        packages.install(settings, [browser.PACKAGE])


def axe(settings: Settings) -> str:
    """The script of axe-core, from a Python package that carries it."""
    requirements = settings.local / "requirements-page.txt"
    key = hashlib.sha256(requirements.read_bytes()).hexdigest()[:16]
    folder = settings.cache / f"axe-{key}"
    script = folder / "axe_playwright_python" / "axe.min.js"
    with lock(settings.cache / f"{folder.name}.lock", "axe-core"):
        if not script.exists():
            python = str(pythonenv.ensure(settings) / "python")
            argv = [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps"]
            argv += ["--target", str(folder), "--requirement", str(requirements)]
            done = subprocess.run(argv, capture_output=True, text=True, check=False)
            if done.returncode != 0:
                raise LabError(f"pip could not install axe-core: {done.stderr.strip()[-300:]}")
    return script.read_text()


def fresh(tab: Tab, page: Page, width: int = 1280, colours: str = "light") -> None:
    """Opens the page anew and waits until it shows what is sent."""
    page.send(event(page.view))
    show(tab, page.address, width, colours)


def show(tab: Tab, address: str, width: int, colours: str) -> None:
    """Opens a page at an address, and waits until it shows what it was sent."""
    tab.prefer(prefers_color_scheme=colours)
    tab.size(width, 900)
    tab.open(address)
    tab.wait("document.querySelector('#connection')?.dataset.state === 'live' && document.querySelector('#ended .row')")


def need(holds: object, what: str) -> None:
    if not holds:
        raise LabError(what)


def shows(tab: Tab, page: Page) -> str:
    fresh(tab, page)
    text = str(tab.run("document.querySelector('main').innerText"))
    found = [row for name in ("running", "waiting", "ended", "failures") for row in page.view[name]["rows"]]
    for row in [*found, *page.view["leaderboards"]["rows"]]:
        need(row["name"] in text, f"{row['name']} is not shown")
    for part in ("41 of 60 requests in the last minute", "crashed, starts again", "All four slots", "starts in about"):
        need(part in text, f"`{part}` is not shown")
    need(tab.run("document.title") == "4 running, 6 in line", "the title does not count")
    said = complaints(tab)
    need(not said, f"the browser complains: {said}")
    return f"{len(found)} rows"


def texts_stay_texts(tab: Tab, page: Page) -> str:
    """Names of strangers with markup, in every field that has a text."""
    evil = "<img src=x onerror=\"document.title='gone'\"><script>document.title='gone'</script>\u202e"

    def poisoned(value: Any, key: str = "") -> Any:
        if isinstance(value, dict):
            return {name: poisoned(one, name) for name, one in value.items()}
        if isinstance(value, list):
            return [poisoned(one, key) for one in value]
        return value + evil if isinstance(value, str) and key not in ("class", "state") else value

    fresh(tab, page)
    page.send(event(poisoned(page.view)))
    tab.wait("document.body.innerText.includes('onerror')")
    need(tab.run("document.querySelectorAll('img, main script, [onerror]').length") == 0, "a name became an element")
    need(tab.run("document.title") == "4 running, 6 in line", "a name was run as a script")
    refused = "(() => { try { document.body.innerHTML = '<b>x</b>'; return false } catch { return true } })()"
    need(tab.run(refused), "the policy of the content lets a script make markup of a text")
    return "no element, no script"


def keyboard(tab: Tab, page: Page) -> str:
    fresh(tab, page)
    reached = []
    for _ in range(4):
        tab.key("Tab", 9)
        reached.append(tab.run("document.activeElement.id || document.activeElement.className"))
    need(reached[:3] == ["skip", "leaderboard", "text"], f"Tab reaches {reached}")
    tab.run("document.querySelector('.skip').focus()")
    tab.key("Enter", 13, "\r")
    tab.wait("document.activeElement.id === 'running'")
    tab.run("document.querySelector('#text').focus()")
    for letter in "seven":
        tab.key(letter, ord(letter.upper()), letter)
    tab.wait("document.querySelectorAll('#running .row').length === 1")
    need("Team Seven" in str(tab.run("document.querySelector('#running').innerText")), "the filter shows others")
    return "skip link, filter"


def updates(tab: Tab, page: Page) -> str:
    """News change what has changed: a row stays the same node, and the reader's place stays where it is."""
    fresh(tab, page)
    tab.run(
        "document.querySelector('#text').focus(); document.querySelector('#running .row').mark = 1; scrollTo(0, 200)"
    )
    news = json.loads(json.dumps(page.view))
    first = news["running"]["rows"][0]
    first["done"] += 1
    news["running"]["rows"].append({**first, "name": "submission-9999"})
    news["running"]["rows"].reverse()
    page.send(event(news))
    tab.wait("document.querySelector('#running .row').innerText.includes('submission-9999')")
    need(tab.run("[...document.querySelectorAll('#running .row')].at(-1).mark") == 1, "a row was made anew")
    need(tab.run("document.activeElement.id") == "text" and tab.run("scrollY") > 0, "the reader lost the place")
    need(f"{first['done']}/80" in str(tab.run("document.querySelector('#running').innerText")), "the news is not shown")
    return "same nodes, same focus"


def connection(tab: Tab, page: Page) -> str:
    fresh(tab, page)
    page.send(b"", refuses=True)
    tab.wait("document.querySelector('#connection').dataset.state === 'lost'")
    need("old" in str(tab.run("document.querySelector('#connection').textContent")), "old data look new")
    fresh(tab, page)
    page.send(b"retry: 50\nevent: full\ndata: {}\n\n")
    tab.wait("document.querySelector('#connection').textContent.includes('All places are taken')")
    return "lost, full"


def narrow(tab: Tab, page: Page) -> str:
    for width in (320, 390, 768, 1280):
        fresh(tab, page, width)
        wide = tab.run("document.documentElement.scrollWidth")
        need(wide <= width, f"{wide} pixels do not fit into {width}")
    return "320 to 1280 pixels"


def motion(tab: Tab, page: Page) -> str:
    fresh(tab, page)
    moving = """[...document.styleSheets].flatMap((sheet) => [...sheet.cssRules])
        .filter((rule) => /transition|animation/.test(rule.cssText) && !/no-preference/.test(rule.conditionText ?? ""))
        .map((rule) => rule.cssText)"""
    found = tab.run(moving)
    need(found == [], f"these move for those who asked for less: {found}")
    return "none without consent"


def without_scripts(tab: Tab, page: Page) -> str:
    tab.call("Emulation.setScriptExecutionDisabled", value=True)
    tab.open(page.address)
    try:
        root = tab.call("DOM.getDocument", depth=-1)["root"]["nodeId"]
        found = tab.call("DOM.querySelector", nodeId=root, selector="noscript p")["nodeId"]
        text = tab.call("DOM.getOuterHTML", nodeId=found)["outerHTML"]
        need("needs JavaScript" in text, "the page does not say what it needs")
        shape = tab.call("DOM.getBoxModel", nodeId=found)["model"]
        need(shape["height"] > 0, "what it needs is not shown")
        need("kubectl leaderboard status" in text, "the page names no other way")
    finally:
        tab.call("Emulation.setScriptExecutionDisabled", value=False)
    return "says what it needs"


def largest(tab: Tab, page: Page) -> str:
    """A view with every list at its longest."""
    fresh(tab, page)
    view = json.loads(json.dumps(page.view))
    for name, most in (("running", 60), ("waiting", 200), ("ended", 40), ("failures", 20)):
        rows = view[name]["rows"]
        view[name]["rows"] = [{**rows[at % len(rows)], "name": f"{name}-{at}"} for at in range(most)]
        view[name]["count"] = 10_000
    for row in view["running"]["rows"]:
        row["workers"] = [{**row["workers"][0], "id": at} for at in range(1, 17)]
    page.send(event(view))
    tab.wait("document.querySelectorAll('#waiting .row').length === 200")
    spent = """(() => {
        const from = performance.now();
        document.querySelector('#leaderboard').dispatchEvent(new Event('change'));
        return performance.now() - from;
    })()"""
    took = float(tab.run(spent))
    need(took < DRAW_MS, f"it takes {took:.0f} ms to draw")
    need(
        "9,800 more" in str(tab.run("document.querySelector('#waiting').innerText")),
        "it does not say that there are more",
    )
    return f"320 rows, 960 workers, drawn again in {took:.0f} ms"


CHECKS: dict[str, Callable[[Tab, Page], str]] = {
    "what it shows": shows,
    "names and messages of strangers": texts_stay_texts,
    "keyboard": keyboard,
    "news": updates,
    "a connection that ends, and no place": connection,
    "widths": narrow,
    "reduced motion": motion,
    "no JavaScript": without_scripts,
    "the longest lists": largest,
}


def accessible(tab: Tab, page: Page, script: str) -> None:
    """axe-core, in both colours and at both ends of the widths."""
    rules = 0
    started = time.monotonic()
    for colours in ("light", "dark"):
        for width in (320, 1280):
            fresh(tab, page, width, colours)
            tab.run(script)
            done = json.loads(str(tab.run(AXE)))
            need(not done["violations"], f"axe-core, {colours}, {width} pixels: {done['violations']}")
            rules = max(rules, done["passes"])
    need(rules > 20, f"axe-core has looked at {rules} rules only")
    print(
        f"ok    {'axe-core, light and dark, 320 and 1280 pixels':<48} {rules} rules ({seconds(time.monotonic() - started)})"
    )


AXE = """axe.run().then(({ passes, violations }) => JSON.stringify({
    passes: passes.length,
    violations: violations.map((one) => [one.id, one.help, one.nodes.slice(0, 3).map((node) => node.html)]),
}))"""


def take(tab: Tab, page: Page, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in pictures(tab, page.address):
        keep(folder / f"{name}.png", data)


def pictures(tab: Tab, address: str) -> Iterator[tuple[str, bytes]]:
    """The page at an address in both colours, on a wide screen and on a phone's."""
    for name, (width, height, colours) in PICTURES.items():
        show(tab, address, width, colours)
        tab.size(width, height)
        yield name, tab.picture(width, height)


def keep(file: Path, data: bytes) -> None:
    need(len(data) <= LARGEST_PICTURE, f"{file.name} has {len(data)} bytes, more than {LARGEST_PICTURE}")
    file.write_bytes(data)
    say(f"{file}, {len(data) // 1024} KiB")
