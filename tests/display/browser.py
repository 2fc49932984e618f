"""A page in headless Chromium: its width, its contrasts, its keys, its console."""

import base64
import json
import re
import shutil
import socket
import subprocess
import time
from contextlib import contextmanager
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from urllib.error import URLError
from urllib.request import Request, urlopen

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic"),
    *("--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--hide-scrollbars"),
    *("--enable-logging=stderr", "--virtual-time-budget=5000", "--dump-dom"),
)
#: Measures the page in frames of both widths, and writes what it found as JSON.
PROBE = Path(__file__).with_name("probe.html")


def look(page: str, folder: Path, *, dark: bool = False) -> tuple[dict, list[str]]:
    """Return what a browser measures of a page at 390 and 1280 px, and its console."""
    if CHROMIUM is None:
        pytest.skip("Chromium is not installed here: the page is not looked at")
    code = base64.b64encode(page.encode()).decode()
    probe = folder / "probe.html"
    text = PROBE.read_text(encoding="utf-8").replace("PAGE", code)
    probe.write_text(text, encoding="utf-8")
    color = f"--blink-settings=preferredColorScheme={0 if dark else 1}"
    done = subprocess.run(
        [CHROMIUM, *FLAGS, color, f"--user-data-dir={folder / 'profile'}", str(probe)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    console = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    text = re.search(r'<pre id="found">(.*?)</pre>', done.stdout, re.DOTALL)
    assert text is not None, done.stderr[-2_000:]
    return json.loads(unescape(text.group(1)))["frames"], console


def assert_reads_well(page: str, folder: Path) -> None:
    """Assert what must hold of a page at both widths, light and dark."""
    for dark in (False, True):
        place = folder / str(dark)
        place.mkdir()
        frames, console = look(page, place, dark=dark)
        assert console == []
        for width, found in frames.items():
            assert found["dark"] is dark
            assert found["width"] <= int(width)
            assert found["wide"] == []
            assert found["low"] == []
            assert found["texts"] > 20
            assert found["focusable"]
            assert found["images"]
            for is_drawn, words in found["images"]:
                assert is_drawn
                assert len(words) > 40


# A browser that goes on: chromedriver, spoken to in JSON over HTTP as W3C has it


DRIVER = shutil.which("chromedriver")


class Browser:
    """A session of a browser.

    Args:
        url: Address of the session.
    """

    def __init__(self, url: str) -> None:
        self.url = url

    def open(self, page: str) -> None:
        """Open an address."""
        said(f"{self.url}/url", {"url": page})

    def run(self, script: str):
        """Return what a script in the page returns."""
        return said(f"{self.url}/execute/sync", {"script": script, "args": []})

    def text(self) -> str:
        """Return what a reader of the page sees."""
        return self.run("return document.body ? document.body.innerText : ''")

    def wait_for(self, text: str, seconds: float = 120.0) -> str:
        """Return the page's text once it has a text; it may load itself again."""
        until = time.monotonic() + seconds
        while text not in (shown := self.text()):
            assert time.monotonic() < until, shown
            time.sleep(0.2)
        return shown


@contextmanager
def browser(folder: Path):
    """Yield a browser whose profile is in a folder."""
    if CHROMIUM is None or DRIVER is None:
        pytest.skip("Chromium and chromedriver are not installed here: nobody watches")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    own = [flag for flag in FLAGS if flag.startswith("--") and "dump" not in flag]
    own = [flag for flag in own if "virtual" not in flag and "logging" not in flag]
    own += [f"--user-data-dir={folder / 'profile'}"]
    driver = subprocess.Popen(
        [DRIVER, f"--port={port}"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        base = f"http://127.0.0.1:{port}"
        until = time.monotonic() + 60
        while not ready(base):
            assert time.monotonic() < until
            time.sleep(0.1)
        options = {"binary": CHROMIUM, "args": own}
        wanted = {"alwaysMatch": {"goog:chromeOptions": options}}
        session = said(f"{base}/session", {"capabilities": wanted})["sessionId"]
        try:
            yield Browser(f"{base}/session/{session}")
        finally:  # which ends the browser
            said(f"{base}/session/{session}", None, "DELETE")
    finally:
        driver.terminate()
        driver.wait(timeout=60)


def ready(base: str) -> bool:
    """Return whether the driver takes sessions."""
    try:
        return said(f"{base}/status", None, "GET")["ready"]
    except (URLError, OSError):
        return False


def said(url: str, content, method: str = "POST"):
    """Return the value that a request is answered with."""
    data = None if content is None else json.dumps(content).encode()
    with urlopen(Request(url, data, method=method), timeout=120) as answer:
        return json.loads(answer.read())["value"]


# The elements and texts of a page


VOID = {"br", "img", "meta"}


class Parsed(HTMLParser):
    """Tags with their attributes, and texts, of a page that must be balanced."""

    def __init__(self, page):
        super().__init__()
        self.elements, self.open, self.texts = [], [], []
        self.feed(page)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)
