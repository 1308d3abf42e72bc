"""Owns a headless Chromium and how it is spoken to: the DevTools protocol over two pipes, as `--remote-debugging-pipe` reads it."""

import base64
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from .errors import LabError

# Debian's package of the same name is the smallest.
PACKAGE = "chromium-headless-shell"
PROGRAMS = (PACKAGE, "chromium", "chromium-browser", "google-chrome")
# No sandbox: it shows our own files, and root can't have one. Nothing of it may call home.
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--disable-background-networking",
    "--disable-component-update",
    "--hide-scrollbars",
    "--no-first-run",
    "--remote-debugging-pipe",
)
# A busy machine may be slow; what hangs is an error.
LIMIT = 60.0
WAIT = """new Promise((done) => {
    const until = performance.now() + LIMIT;
    const look = () => {
        if (CONDITION) done(true);
        else if (performance.now() > until) done(false);
        else setTimeout(look, 20);
    };
    look();
})"""


def program() -> str | None:
    """A Chromium of this machine."""
    return next((found for name in PROGRAMS if (found := shutil.which(name))), None)


class Tab:
    """One page of a browser. Messages that are not asked for are kept in `events`."""

    def __init__(self, to: int, back: int) -> None:
        self.to, self.back = to, back
        self.last, self.rest, self.session = 0, b"", ""
        self.events: list[dict[str, Any]] = []

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """A command and its result; LabError if the browser refuses it."""
        self.last += 1
        message: dict[str, Any] = {"id": self.last, "method": method, "params": params}
        if self.session:
            message["sessionId"] = self.session
        data = json.dumps(message).encode() + b"\0"
        while data:
            data = data[os.write(self.to, data) :]
        while True:
            answer = self.receive(time.monotonic() + LIMIT)
            if answer.get("id") == self.last:
                if "error" in answer:
                    raise LabError(f"Chromium refuses {method}: {answer['error']['message']}")
                return dict(answer["result"])
            self.events.append(answer)

    def receive(self, until: float) -> dict[str, Any]:
        while b"\0" not in self.rest:
            left = until - time.monotonic()
            if left <= 0 or not select.select([self.back], [], [], left)[0]:
                raise LabError(f"Chromium has not answered for {LIMIT:.0f} s")
            part = os.read(self.back, 1 << 20)
            if not part:
                raise LabError("Chromium has ended: start it by hand to see why")
            self.rest += part
        one, _, self.rest = self.rest.partition(b"\0")
        return dict(json.loads(one))

    def run(self, script: str) -> Any:
        """The value of an expression in the page; a promise is awaited."""
        done = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in done:
            raise LabError(f"{script[:80]}: {done['exceptionDetails']}")
        return done["result"].get("value")

    def wait(self, condition: str) -> None:
        """Until an expression is true in the page."""
        script = WAIT.replace("CONDITION", condition).replace("LIMIT", str(LIMIT * 1000))
        if not self.run(script):
            raise LabError(f"the page has not come to: {condition}")

    def size(self, width: int, height: int, scale: int = 1) -> None:
        metrics = {"width": width, "height": height, "deviceScaleFactor": scale, "mobile": width < 500}
        self.call("Emulation.setDeviceMetricsOverride", **metrics)

    def prefer(self, **features: str) -> None:
        """Media features, such as prefers_color_scheme="dark"."""
        given = [{"name": name.replace("_", "-"), "value": value} for name, value in features.items()]
        self.call("Emulation.setEmulatedMedia", features=given)

    def key(self, key: str, code: int, text: str = "") -> None:
        for kind in ("keyDown", "keyUp"):
            self.call(
                "Input.dispatchKeyEvent",
                type=kind,
                key=key,
                code=key,
                windowsVirtualKeyCode=code,
                text=text if kind == "keyDown" else "",
            )

    def fill(self, markup: str) -> None:
        """Puts this page in place of the one that is shown."""
        frame = self.call("Page.getFrameTree")["frameTree"]["frame"]["id"]
        self.call("Page.setDocumentContent", frameId=frame, html=markup)

    def picture(self, width: float, height: float) -> bytes:
        """A PNG of so much of the page from its upper left corner."""
        clip = {"x": 0, "y": 0, "width": width, "height": height, "scale": 1}
        return base64.b64decode(self.call("Page.captureScreenshot", format="png", clip=clip)["data"])

    def open(self, address: str) -> None:
        """Goes to an address, and returns when it is loaded."""
        self.events.clear()
        self.call("Page.navigate", url=address)
        until = time.monotonic() + LIMIT
        while not any(event.get("method") == "Page.loadEventFired" for event in self.events):
            self.events.append(self.receive(until))


@contextmanager
def tab() -> Iterator[Tab]:
    """A browser with one empty page; it ends with the block."""
    found = program()
    if found is None:
        raise LabError(f"there is no Chromium on this machine: install it (Debian: apt-get install {PACKAGE})")
    with tempfile.TemporaryDirectory() as home:
        (theirs_in, to), (back, theirs_out) = os.pipe(), os.pipe()
        # The browser reads file 3 and writes file 4. Debian's sh can't name a file above 9.
        shell = f'exec "$0" "$@" 3<&{theirs_in} 4>&{theirs_out}'
        argv = ["bash", "-c", shell, found, *FLAGS, f"--user-data-dir={home}", "about:blank"]
        process = subprocess.Popen(
            argv, pass_fds=(theirs_in, theirs_out), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        os.close(theirs_in)
        os.close(theirs_out)
        try:
            yield attached(Tab(to, back))
        finally:
            os.close(to)
            os.close(back)
            ended(process)


def ended(process: "subprocess.Popen[bytes]") -> None:
    """A browser whose pipe is closed ends by itself."""
    try:
        process.wait(10)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def attached(one: Tab) -> Tab:
    target = one.call("Target.createTarget", url="about:blank")["targetId"]
    one.session = one.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
    for domain in ("Page", "Runtime", "Log"):
        one.call(f"{domain}.enable")
    return one


def complaints(one: Tab) -> list[str]:
    """What the browser reports against the page: errors of scripts, and what the policy of its content forbids."""
    found = []
    for event in one.events:
        params = event.get("params", {})
        if event.get("method") == "Runtime.exceptionThrown":
            found.append(str(params["exceptionDetails"].get("exception", params["exceptionDetails"])))
        if event.get("method") == "Log.entryAdded" and params["entry"]["level"] == "error":
            found.append(str(params["entry"]["text"]))
    return found
