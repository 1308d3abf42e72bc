"""Owns the test of the operator's page in a headless Chromium, and how pictures of it are taken.

Called by `lab test` and `lab page-test`. The page's files and the policy of their content are those that the operator serves
(`src/page/web`), the view is the one that its unit tests assert (`src/page/golden`); the operator's own server has its tests in
`src/page` and `tests/api/page.rs`.
"""

import hashlib
import json
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from . import browser, packages, pythonenv
from .browser import Tab, complaints
from .console import say, seconds
from .errors import LabError
from .pageserver import Page, event
from .settings import Settings
from .tools import lock

NAMESPACE = "leaderboard"
IS_OPEN = "document.querySelector('#detail').open"
FOCUS = "document.activeElement"
# name -> width, height, colours, whether a submission is open
PICTURES = {
    "page-light": (1280, 1000, "light", False),
    "page-dark": (1280, 1000, "dark", False),
    "page-detail": (1280, 900, "light", True),
    "page-phone-light": (360, 780, "light", False),
    "page-phone-dark": (360, 780, "dark", False),
    "page-phone-detail": (360, 780, "light", True),
}
LARGEST_PICTURE = 400 * 1024
FONT = ("fonts-inter", Path("/usr/share/fonts/opentype/inter"))


def run(settings: Settings, pictures: bool) -> None:
    """All checks; raises with the first one that fails. `pictures`: of the view of the tests, to look at a change of the page."""
    ensure_browser(settings, pictures)
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


def ensure_browser(settings: Settings, pictures: bool = False) -> None:
    """A browser, and for pictures a typeface that people have."""
    wanted = [browser.PACKAGE] if browser.program() is None else []
    if pictures and not FONT[1].is_dir():
        wanted.append(FONT[0])
    if wanted:
        say(f"installing {' '.join(wanted)} with apt-get, usually 30 s")
        packages.install(settings, wanted)


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
    # An address that differs by its fragment alone loads nothing.
    tab.open("about:blank")
    tab.open(address)
    tab.wait(
        "document.querySelector('#connection')?.dataset.state === 'live' && document.querySelector('#ended p, #ended .row')"
    )


def open_one(tab: Tab, name: str) -> None:
    """Opens a submission by its address."""
    tab.run(f"location.hash = '#/{NAMESPACE}/{name}'")
    tab.wait(f"{IS_OPEN} && document.querySelector('#detail-title').textContent === '{name}'")
    tab.wait("document.querySelector('#detail .steps, #detail .empty') && document.getAnimations().length === 0")


def need(holds: object, what: str) -> None:
    if not holds:
        raise LabError(what)


def shows(tab: Tab, page: Page) -> str:
    fresh(tab, page)
    while tab.run("document.querySelector('.more')?.click() ?? document.querySelector('.more')"):
        pass
    text = str(tab.run("document.querySelector('main').innerText"))
    found = [row for name in ("running", "waiting", "ended", "failures") for row in page.view[name]["rows"]]
    for row in [*found, *page.view["leaderboards"]["rows"]]:
        need(row["name"] in text, f"{row['name']} is not shown")
    parts = ("41 of 60 requests per minute", "Worker 2: 2 crashes", "All four slots", "until it starts", "Typical run")
    for part in parts:
        need(part in text, f"`{part}` is not shown")
    need(text.count("All four slots") == 1, "a reason is shown once for each that waits for it")
    need(tab.run("document.title") == "4 running, 6 queued · challenge-eu-1", "the title does not count")
    said = complaints(tab)
    need(not said, f"the browser complains: {said}")
    return f"{len(found)} rows"


def ranks(tab: Tab, page: Page) -> str:
    """Standings come first; the track with results is chosen, and another one by a click."""
    fresh(tab, page)
    first = "document.querySelector('main section').id"
    need(tab.run(first) == "standings", "the standings are not the first section")
    rows = "[...document.querySelectorAll('#ranking tbody tr')].map((row) => row.innerText.replace(/\\s+/g, ' '))"
    shown = tab.run(rows)
    need(len(shown) == 7, f"{len(shown)} rows")
    need(shown[0].startswith("1 Autobahn Labs") and shown[0].endswith("68.05"), shown[0])
    tab.run("[...document.querySelectorAll('[role=tab]')].at(-1).click()")
    need(str(tab.run(rows)[0]).startswith("1 Team Seven"), "another track is not shown")
    need("EvalAI" in str(tab.run("document.querySelector('#leaderboards a').innerText")), "no link leads to EvalAI")
    return f"{len(shown)} teams, 4 tracks"


def details(tab: Tab, page: Page) -> str:
    """One submission: by a click, by its address, back by the browser and by Escape."""
    fresh(tab, page)
    tab.run("document.querySelector('#running .open').focus(); document.activeElement.click()")
    tab.wait(f"{IS_OPEN} && document.querySelector('#detail .steps')")
    text = str(tab.run("document.querySelector('#detail').innerText"))
    for part in ("submission-4200", "Driving score so far", "kubectl leaderboard logs submission-4200 -n leaderboard"):
        need(part in text, f"`{part}` is not shown")
    for part in ("s3://results-20/v2/submission-4200", "Submission 4200 in the hosts' list", "Conditions", "Worker 4"):
        need(part in text, f"`{part}` is not shown")
    tab.run("history.back()")
    tab.wait(f"!{IS_OPEN} && location.hash === ''")
    need(tab.run(f"{FOCUS}.className") == "open", "the focus is not where it was")
    show(tab, f"{page.address}#/{NAMESPACE}/submission-4193", 1280, "light")
    tab.wait(f"{IS_OPEN} && document.querySelector('#detail .cause')")
    need(
        "not charged" in str(tab.run("document.querySelector('#detail').innerText")),
        "it does not say whose failure it is",
    )
    page.details[f"{NAMESPACE}/submission-4193"]["failure"]["message"] = "Another cause."
    page.send(event(page.view))
    tab.wait("document.querySelector('#detail .cause').innerText.includes('Another cause.')")
    tab.key("Escape", 27)
    tab.wait(f"!{IS_OPEN} && location.hash === ''")
    need(tab.run(f"{FOCUS}.id") == "title", "the focus is lost after a dialog that an address opened")
    open_one(tab, "submission-1")
    need(
        "no submission submission-1" in str(tab.run("document.querySelector('#detail').innerText")),
        "what is missing is not said",
    )
    return "click, address, back, Escape, news, missing"


def copies(tab: Tab, page: Page) -> str:
    fresh(tab, page)
    tab.call("Browser.grantPermissions", permissions=["clipboardReadWrite", "clipboardSanitizedWrite"])
    tab.call("Emulation.setFocusEmulationEnabled", enabled=True)
    open_one(tab, "submission-4200")
    tab.run("[...document.querySelectorAll('[data-copy]')].at(-1).click()")
    tab.wait("document.querySelector('#copied').textContent === 'Copied.'")
    found = tab.run("navigator.clipboard.readText()")
    need(found == "s3://results-20/v2/submission-4200", f"the clipboard has {found!r}")
    return "address of the results"


def empty(tab: Tab, page: Page) -> str:
    """A cluster that has nothing yet."""
    page.send(event(nothing(page.view)))
    show(tab, page.address, 1280, "light")
    text = str(tab.run("document.querySelector('main').innerText"))
    for part in (
        "No Leaderboard is here yet",
        "Nothing runs.",
        "Nobody waits.",
        "Nothing has failed.",
        "Nothing has ended yet.",
    ):
        need(part in text, f"`{part}` is not shown")
    return "each section says so"


def nothing(view: dict[str, Any]) -> dict[str, Any]:
    lists = {
        name: {**part, "count": 0, "rows": []}
        for name, part in view.items()
        if isinstance(part, dict) and "rows" in part
    }
    lists["failures"]["classes"] = []
    return {**view, **lists}


def texts_stay_texts(tab: Tab, page: Page) -> str:
    """Names of strangers with markup, in every field that has a text, of the page and of a submission."""
    evil = "<img src=x onerror=\"document.title='gone'\"><script>document.title='gone'</script>\u202e"

    def poisoned(value: Any, key: str = "") -> Any:
        if isinstance(value, dict):
            return {name: poisoned(one, name) for name, one in value.items()}
        if isinstance(value, list):
            return [poisoned(one, key) for one in value]
        return value + evil if isinstance(value, str) and key not in ("class", "state", "link", "title") else value

    fresh(tab, page)
    open_one(tab, "submission-4193")
    kept = page.details
    page.details = {key: poisoned(one) for key, one in kept.items()}
    page.send(event(poisoned(page.view)))
    tab.wait("document.querySelector('main').innerText.includes('onerror')")
    tab.wait("document.querySelector('#detail .content').innerText.includes('onerror')")
    page.details = kept
    inside = "document.querySelectorAll(':is(main, dialog) :is(img, script), [onerror]').length"
    need(tab.run(inside) == 0, "a name became an element")
    need(tab.run("document.title") == "4 running, 6 queued · challenge-eu-1", "a name was run as a script")
    refused = "(() => { try { document.body.innerHTML = '<b>x</b>'; return false } catch { return true } })()"
    need(tab.run(refused), "the policy of the content lets a script make markup of a text")
    return "no element, no script"


def keyboard(tab: Tab, page: Page) -> str:
    fresh(tab, page)
    reached = []
    for _ in range(5):
        tab.key("Tab", 9)
        reached.append(tab.run(f"{FOCUS}.id || {FOCUS}.className"))
    need(reached[:3] == ["skip", "leaderboard", "text"], f"Tab reaches {reached}")
    need(reached[3] == f"tab-{NAMESPACE}/carla-20/sensors" and reached[4] == "open", f"Tab reaches {reached}")
    tab.key("Enter", 13, "\r")
    tab.wait(f"{IS_OPEN} && {FOCUS}.id === 'detail-title' && document.querySelector('#detail .steps')")
    for _ in range(30):
        tab.key("Tab", 9)
        need(tab.run(f"{FOCUS} === document.body || !!{FOCUS}.closest('dialog')"), "Tab leaves the dialog for the page")
    tab.key("Escape", 27)
    tab.wait(f"!{IS_OPEN} && location.hash === '' && {FOCUS}.className === 'open'")
    tab.run("document.querySelector('[role=tab][aria-selected=true]').focus()")
    tab.key("ArrowRight", 39)
    tab.wait(f"{FOCUS}.getAttribute('aria-selected') === 'true' && {FOCUS}.textContent.includes('map')")
    tab.run("document.querySelector('.skip').focus()")
    tab.key("Enter", 13, "\r")
    tab.wait(f"{FOCUS}.id === 'standings'")
    tab.run("document.querySelector('#text').focus()")
    for letter in "seven":
        tab.key(letter, ord(letter.upper()), letter)
    tab.wait("document.querySelectorAll('#running .row').length === 1")
    need("Team Seven" in str(tab.run("document.querySelector('#running').innerText")), "the filter shows others")
    return "skip link, tabs, dialog, filter"


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
    for width in (320, 360, 768, 1280):
        fresh(tab, page, width)
        for place in ("document.documentElement", "document.querySelector('#detail')"):
            wide = tab.run(f"{place}.scrollWidth")
            need(wide <= width, f"{wide} pixels do not fit into {width}")
            open_one(tab, "submission-4200")
        # A node's name of AWS has 45 characters.
        beyond = tab.run("""[...document.querySelectorAll('.row')]
            .filter((row) => [...row.children].some((one) => one.getBoundingClientRect().right > row.getBoundingClientRect().right + 1))
            .map((row) => row.textContent)""")
        need(not beyond, f"parts of rows reach out of them at {width} pixels: {beyond}")
    return "320 to 1280 pixels, with a submission open too"


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
    """A view with every list at its longest, of 10,000 submissions: it is drawn in part, and all of it on request."""
    fresh(tab, page)
    view = json.loads(json.dumps(page.view))
    for name, most in (("running", 60), ("waiting", 200), ("ended", 40), ("failures", 20)):
        rows = view[name]["rows"]
        view[name]["rows"] = [{**rows[at % len(rows)], "name": f"{name}-{at}"} for at in range(most)]
        view[name]["count"] = 10_000
    for row in view["running"]["rows"]:
        row["workers"] = [{**row["workers"][0], "id": at} for at in range(1, 17)]
    page.send(event(view))
    tab.wait("document.querySelector('#waiting .count').textContent === '10,000'")
    need(tab.run("document.querySelectorAll('.row').length") < 50, "all rows are drawn at once")
    clicks = """(() => {
        let clicks = 0;
        for (let more; (more = document.querySelector('.more')); clicks += 1) more.click();
        return clicks;
    })()"""
    asked = tab.run(clicks)
    need(tab.run("document.querySelectorAll('#waiting .row').length") == 200, "not all rows come")
    spent = """(() => {
        const from = performance.now();
        document.querySelector('#leaderboard').dispatchEvent(new Event('change'));
        return performance.now() - from;
    })()"""
    took = float(tab.run(spent))
    left = str(tab.run("document.querySelector('#waiting').innerText"))
    need("9,800 more" in left, "it does not say that there are more")
    return f"320 rows after {asked} clicks, 960 workers, drawn again in {took:.0f} ms"


CHECKS: dict[str, Callable[[Tab, Page], str]] = {
    "what it shows": shows,
    "standings": ranks,
    "one submission": details,
    "copy": copies,
    "nothing yet": empty,
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
    """axe-core over each state of the page, in both colours and at both ends of the widths."""
    rules, pages = 0, 0
    started = time.monotonic()
    states: tuple[str | None, ...] = (None, "submission-4200", "submission-4193", "submission-4215", "submission-1")
    for colours in ("light", "dark"):
        for width in (320, 1280):
            page.send(event(nothing(page.view)))
            show(tab, page.address, width, colours)
            rules = max(rules, without_barriers(tab, script, f"nothing yet, {colours}, {width} pixels"))
            fresh(tab, page, width, colours)
            for name in states:
                if name:
                    open_one(tab, name)
                rules = max(rules, without_barriers(tab, script, f"{name or 'the page'}, {colours}, {width} pixels"))
            pages += 1 + len(states)
    need(rules > 20, f"axe-core has looked at {rules} rules only")
    what = "axe-core, each state, both colors, 320 and 1280"
    print(f"ok    {what:<48} {pages} pages, {rules} rules ({seconds(time.monotonic() - started)})")


def without_barriers(tab: Tab, script: str, what: str) -> int:
    """The number of rules that axe-core finds kept; raises with those that it finds broken."""
    tab.run(script)
    done = json.loads(str(tab.run(AXE)))
    need(not done["violations"], f"axe-core, {what}: {done['violations']}")
    return int(done["passes"])


# All rules, those that are experimental or ask for more than WCAG's AA among them.
AXE = """axe.run({ runOnly: axe.getRules().map((rule) => rule.ruleId) }).then(({ passes, violations }) => JSON.stringify({
    passes: passes.length,
    violations: violations.map((one) => [one.id, one.help, one.nodes.slice(0, 3).map((node) => [node.html, node.failureSummary])]),
}))"""


def take(tab: Tab, page: Page, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in pictures(tab, page.address):
        keep(folder / f"{name}.png", data)


def pictures(tab: Tab, address: str) -> Iterator[tuple[str, bytes]]:
    """The page at an address in both colours, on a wide screen and on a phone's; and with the first submission that runs open."""
    for name, (width, height, colours, is_open) in PICTURES.items():
        show(tab, address, width, colours)
        tab.size(width, height)
        if is_open:
            tab.run("document.querySelector('#running .open').click()")
            tab.wait("document.querySelector('#detail .steps') && document.getAnimations().length === 0")
        yield name, tab.picture(width, height)


def keep(file: Path, data: bytes) -> None:
    need(len(data) <= LARGEST_PICTURE, f"{file.name} has {len(data)} bytes, more than {LARGEST_PICTURE}")
    file.write_bytes(data)
    say(f"{file}, {len(data) // 1024} KiB")
