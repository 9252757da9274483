"""The page in a headless Chromium, spoken to over its DevTools protocol. Run with `make test-browser`."""

from __future__ import annotations

import contextlib
import json
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import connect

from mbdpg.reports.comparison import run_folders
from mbdpg.reports.contents import compared, contents
from mbdpg.reports.page import write_page
from mbdpg.reports.record import read_records

pytestmark = pytest.mark.browser

FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--remote-debugging-port=0"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync", "--hide-scrollbars"),
)
PATIENCE = 60.0
"""Seconds for the browser to start, or for an answer."""


class Browser:
    """One page in a browser of its own. Use it in a `with` block."""

    def __init__(self, folder: Path):
        """Start it with its profile in `folder`, which is new."""
        program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
        if program is None:
            pytest.fail("these tests need Chromium (Debian and Ubuntu: apt install chromium)", pytrace=False)
        self.errors: list[str] = []
        """What the page's console said, exceptions and violations of its policy."""
        self.requests: list[str] = []
        self._loaded = 0
        self._number = 0
        self._session: dict[str, str] = {}
        command = [program, *FLAGS, f"--user-data-dir={folder}", "about:blank"]
        silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        with contextlib.ExitStack() as started:
            self._process = subprocess.Popen(command, **silent)
            started.callback(self._process.wait, timeout=PATIENCE)
            killed = started.enter_context(contextlib.ExitStack())
            killed.callback(self._process.kill)
            self._socket = started.enter_context(connect(self._address(folder / "DevToolsActivePort"), max_size=None))
            target = self.ask("Target.createTarget", url="about:blank")["targetId"]
            session = self.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
            killed.pop_all()  # from here on it is asked to end
            self._started = started.pop_all()
        self._session = {"sessionId": session}
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.ask(f"{domain}.enable")

    def _address(self, file: Path) -> str:
        until = time.monotonic() + PATIENCE
        while time.monotonic() < until:
            lines = file.read_text().splitlines() if file.exists() else []
            if len(lines) == 2:
                return f"ws://127.0.0.1:{lines[0]}{lines[1]}"
            assert self._process.poll() is None, "Chromium ended at once"
            time.sleep(0.05)
        raise AssertionError(f"Chromium did not start within {PATIENCE:.0f} s")

    def ask(self, method: str, **parameters: Any) -> Any:
        """The protocol's answer."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters} | self._session
        self._socket.send(json.dumps(message))
        while True:
            answer = self._receive()
            if answer.get("id") == self._number:
                assert "error" not in answer, f"{method}: {answer['error']}"
                return answer["result"]

    def _receive(self) -> Any:
        message = json.loads(self._socket.recv(timeout=PATIENCE))
        method, parameters = message.get("method"), message.get("params", {})
        if method == "Runtime.exceptionThrown":
            details = parameters["exceptionDetails"]
            self.errors.append(details.get("exception", {}).get("description", details["text"]))
        elif method == "Runtime.consoleAPICalled":
            self.errors.append(f"console.{parameters['type']}: {parameters['args']}")
        elif method == "Log.entryAdded":
            self.errors.append(parameters["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            self.requests.append(parameters["request"]["url"])
        elif method == "Page.loadEventFired":
            self._loaded += 1
        return message

    def open(self, page: Path, *, width: int = 1000, height: int = 900, dark: bool = False) -> None:
        """Load a file into a window of this size."""
        self.errors.clear()
        self.requests.clear()
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.ask("Emulation.setDeviceMetricsOverride", **metrics)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.ask("Emulation.setEmulatedMedia", features=[scheme])
        before = self._loaded
        self.ask("Page.navigate", url=page.absolute().as_uri())
        while self._loaded == before:
            self._receive()
        self.do("await new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")

    def get(self, expression: str) -> Any:
        """An expression's value in the page; a promise is awaited."""
        return self._evaluate(expression)

    def do(self, statements: str) -> None:
        """Run statements in the page."""
        self._evaluate(f"(async () => {{ {statements} }})()")

    def _evaluate(self, expression: str) -> Any:
        found = self.ask("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def point(self, x: float, y: float, *, click: bool = False) -> None:
        """Move the mouse there, in CSS pixels of the window, and perhaps click."""
        self.ask("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        if click:
            for kind in ("mousePressed", "mouseReleased"):
                self.ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def point_at(self, selector: str, *, across: float = 0.5, click: bool = False) -> None:
        """Move the mouse to a place in the first element that matches, and perhaps click."""
        quoted = json.dumps(selector)
        self.do(f"document.querySelector({quoted}).scrollIntoView({{block: 'center'}})")
        box = self.get(f"document.querySelector({quoted}).getBoundingClientRect().toJSON()")
        self.point(box["x"] + across * box["width"], box["y"] + box["height"] / 2, click=click)

    def press(self, key: str) -> None:
        """Press a key, by its name in DOM."""
        code = {"Enter": 13, "Tab": 9, " ": 32, "ArrowLeft": 37, "ArrowRight": 39, "Escape": 27}[key]
        text = {"Enter": {"text": "\r"}, " ": {"text": " "}}.get(key, {})
        for kind in ("keyDown", "keyUp"):
            self.ask("Input.dispatchKeyEvent", type=kind, key=key, windowsVirtualKeyCode=code, **text)

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *reason: object) -> None:
        self._session = {}
        with self._started:
            self.ask("Browser.close")


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("profile")) as running:
        yield running


HOSTILE = "</script><img src=http://127.0.0.1:9/x onerror=console.error(1)>"


@pytest.fixture
def shown(tmp_path: Path, make: Callable[..., Path]) -> Path:
    """A page of three groups, one of which has two runs, diagnostics and an expert; one has a hostile name."""
    steps = range(0, 1001, 100)
    for seed in range(2):
        rows = {
            step: {
                **{"dynamics/rmse_k05": 1.0 + seed, "dynamics/persistence_k05": 2.0, "expert_env_steps": 5000},
                **{"critic/q_bias": 1.0, "critic/realized_return": 9.0, "time/seconds": 3.6 * step},
            }
            for step in steps
        }
        returns = {step: float(step + 10 * seed + 100 * (step % 200 > 0)) for step in steps}
        make(tmp_path / f"a/long/path-{seed}", returns, evaluations=rows, config={"schedule": {"steps": 5000}})
    make(tmp_path / "b", {step: 500.0 if step != 300 else float("nan") for step in steps}, algorithm="sac")
    make(tmp_path / "c", {0: 1.0, 1000: 2.0}, algorithm=HOSTILE, note="word" * 60)
    (tmp_path / "b" / "film.mp4").write_bytes(b"no film")
    runs = read_records(run_folders([tmp_path]), leave_out=pytest.fail)
    write_page(tmp_path / "page.html", contents(compared(runs, at=None), [f"d: {HOSTILE}"]))
    return tmp_path / "page.html"


def test_it_loads_in_silence_and_asks_nothing_of_the_network(browser: Browser, shown: Path) -> None:
    browser.open(shown)
    assert browser.errors == []
    assert {url for url in browser.requests if not url.startswith("data:")} == {shown.as_uri()}
    assert browser.get("document.querySelectorAll('path.mean').length") == 3 + 1 + 2  # return, error, critic
    text = browser.get("document.body.innerText")
    assert HOSTILE in text and f"d: {HOSTILE}" in text and browser.get("document.images.length") == 0


def test_its_policy_stops_whatever_would_go_out(browser: Browser, shown: Path) -> None:
    browser.open(shown)
    browser.do("new Image().src = 'http://127.0.0.1:9/x'; await fetch('http://127.0.0.1:9/y').catch(() => 0)")
    refused = " ".join(error for error in browser.errors if "Content Security Policy" in error)
    assert "127.0.0.1:9/x" in refused and "127.0.0.1:9/y" in refused
    assert (
        browser.get(
            "(() => { const s = document.createElement('script'); s.textContent = 'window.hit = 1';"
            "document.body.append(s); return window.hit ?? 0; })()"
        )
        == 0
    )


def test_a_click_in_the_legend_hides_a_group_in_all_charts_and_a_key_shows_it_again(
    browser: Browser, shown: Path
) -> None:
    curves = "document.querySelectorAll('path.mean[data-group=\"0\"]').length"
    pressed = "document.querySelector('.legend button').getAttribute('aria-pressed')"
    browser.open(shown)
    before = browser.get(curves)
    assert before >= 3 and browser.get(pressed) == "true"
    browser.point_at(".legend button", click=True)
    assert browser.get(curves) == 0 and browser.get(pressed) == "false"
    browser.press(" ")  # the click has left the focus there
    assert browser.get(curves) == before and browser.get(pressed) == "true"


def test_a_single_run_is_hidden_and_the_mean_is_of_the_others(browser: Browser, shown: Path) -> None:
    tooltip = "document.querySelector('.tooltip').innerText"
    browser.open(shown)
    browser.point_at("svg", across=0.99)
    assert "1,000 to 1,010" in browser.get(tooltip)
    assert browser.get("document.querySelectorAll('.runs button').length") == 2  # of the one group that has several
    browser.point_at(".runs summary", click=True)
    browser.point_at(".runs button", click=True)
    assert browser.get("document.querySelectorAll('path.run').length") == 0
    browser.point_at("svg", across=0.99)
    assert "1,010" in browser.get(tooltip) and " to " not in browser.get(tooltip)
    browser.press(" ")  # the click has left the focus on the button
    browser.point_at("svg", across=0.99)
    assert "1,000 to 1,010" in browser.get(tooltip)


def test_the_pointer_and_the_arrow_keys_read_values(browser: Browser, shown: Path) -> None:
    tooltip = "(() => { const t = document.querySelector('.tooltip'); return t.hidden ? '' : t.innerText; })()"
    browser.open(shown)
    assert browser.get(tooltip) == ""
    browser.point_at("svg", across=0.99)
    text = browser.get(tooltip)
    assert "1,000 environment steps" in text and "1,005" in text and "1,000 to 1,010" in text and "500" in text
    browser.point(1, 1)
    assert browser.get(tooltip) == ""
    browser.do("document.querySelector('svg').focus()")
    browser.press("ArrowRight")
    browser.press("ArrowRight")
    assert "100 environment steps" in browser.get(tooltip) and "205" in browser.get(tooltip)
    browser.press("Escape")
    assert browser.get(tooltip) == ""


def test_the_axis_can_be_switched(browser: Browser, shown: Path) -> None:
    labels = "[...document.querySelector('svg').querySelectorAll('text.x')].map((text) => text.textContent)"
    browser.open(shown)
    assert browser.get(labels)[-1] == "1,000"
    browser.point_at("[data-axis=expert]", click=True)
    assert browser.get(labels)[-1] == "6,000"
    assert "expert's" in browser.get("document.querySelector('p.axis').textContent")
    browser.point_at("[data-axis=hours]", click=True)
    assert browser.get(labels)[-1] == "1.0"
    assert browser.get(
        "[...document.querySelectorAll('.switch button')].map((b) => b.getAttribute('aria-pressed'))"
    ) == [
        "false",
        "false",
        "true",
    ]


def test_the_slider_smooths(browser: Browser, shown: Path) -> None:
    turns = """(() => {
        const d = document.querySelector('path.mean[data-group="0"]').getAttribute('d');
        const y = d.slice(1).split('L').map((point) => Number(point.split(',')[1]));
        return y.slice(2).reduce((sum, value, i) => sum + Math.abs(value - 2 * y[i + 1] + y[i]), 0);
    })()"""
    browser.open(shown)
    rough = browser.get(turns)
    browser.do("document.querySelector('input[type=range]').focus()")
    for _ in range(12):
        browser.press("ArrowRight")
    assert browser.get("document.querySelector('output').textContent") == "0.60"
    assert browser.get(turns) < rough / 2


def test_no_line_crosses_an_evaluation_that_failed(browser: Browser, tmp_path: Path, make: Callable[..., Path]) -> None:
    """A mean, also that of a single run, went straight on from the evaluation before to the one after."""
    steps, nan = range(0, 801, 100), float("nan")
    make(tmp_path / "a-0", dict.fromkeys(steps, 1.0), algorithm="pair")
    make(tmp_path / "a-1", {step: 2.0 if step not in (300, 500) else nan for step in steps}, algorithm="pair")
    make(tmp_path / "b", {step: 3.0 if step != 700 else nan for step in steps}, algorithm="single")
    runs = read_records(run_folders([tmp_path]), leave_out=pytest.fail)
    write_page(tmp_path / "page.html", contents(compared(runs, at=None)))
    browser.open(tmp_path / "page.html")
    assert browser.errors == []

    def drawn(kind: str, group: int) -> list[list[int]]:
        """How many points each part of each line has: a point that is alone is a part of one."""
        paths = browser.get(
            f"[...document.querySelector('svg').querySelectorAll('path.{kind}[data-group=\"{group}\"]')]"
            ".map((path) => path.getAttribute('d'))"
        )
        return [[part.count("L") + 1 for part in path.split("M")[1:]] for path in paths]

    assert drawn("mean", 0) == [[3, 1, 3]] and drawn("run", 0) == [[9], [3, 1, 3]]
    assert drawn("mean", 1) == [[7, 1]] and drawn("run", 1) == []
    dots = "[...document.querySelector('svg').querySelectorAll('circle')].map((dot) => dot.getAttribute('class'))"
    assert browser.get(dots) == ["dot run colored", "dot mean colored", "dot mean colored"]  # a path shows none of them
    tooltip = "document.querySelector('.tooltip').innerText"
    browser.do("document.querySelector('svg').focus()")
    for _ in range(4):
        browser.press("ArrowRight")
    assert "300 environment steps" in browser.get(tooltip) and "pair" not in browser.get(tooltip)
    browser.press("ArrowRight")
    assert "pair" in browser.get(tooltip) and "1.000 to 2.000" in browser.get(tooltip)


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", [375, 1000])
def test_nothing_is_wider_than_the_window(browser: Browser, shown: Path, width: int, dark: bool) -> None:
    browser.open(shown, width=width, dark=dark)
    browser.do("document.querySelectorAll('details').forEach((details) => { details.open = true; })")
    root = browser.get("(({scrollWidth, clientWidth}) => [scrollWidth, clientWidth])(document.documentElement)")
    assert root[0] <= root[1] == width
    browser.point_at("svg", across=0.6)
    box = browser.get("document.querySelector('.tooltip').getBoundingClientRect().toJSON()")
    assert box["left"] >= 0 and box["right"] <= width
    assert browser.get("document.documentElement.scrollWidth") <= width
    back = browser.get("getComputedStyle(document.body).backgroundColor")
    assert (back == "rgb(255, 255, 255)") != dark


def test_a_page_without_a_run_says_so_quietly(browser: Browser, tmp_path: Path) -> None:
    write_page(tmp_path / "page.html", contents([]))
    browser.open(tmp_path / "page.html")
    assert browser.errors == [] and "0 runs" in browser.get("document.body.innerText")
