"""A page in headless Chromium: its width, its contrasts, its keys, its console."""

import base64
import json
import re
import shutil
import subprocess
from html import unescape
from html.parser import HTMLParser
from pathlib import Path

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
