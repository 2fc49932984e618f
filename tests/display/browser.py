"""A page in headless Chromium: its width, its contrasts, its keys, its console."""

import base64
import json
import re
import shutil
import subprocess
from html import unescape
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
PROBE = """<!doctype html><meta charset="utf-8"><body><script>
const source = new TextDecoder().decode(
  Uint8Array.from(atob("PAGE"), (c) => c.charCodeAt(0)));
const found = { frames: {} };
function channel(v) { v /= 255;
  return v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4; }
function parse(color) { return (color.match(/[\\d.]+/g) || []).map(Number); }
function luminance(c) {
  return 0.2126 * channel(c[0]) + 0.7152 * channel(c[1]) + 0.0722 * channel(c[2]); }
function ground(view, node) {
  for (let n = node; n; n = n.parentElement) {
    const c = parse(view.getComputedStyle(n).backgroundColor);
    if (c.length === 3 || c[3] > 0) return c;
  }
  return [255, 255, 255];
}
function measure(frame) {
  const view = frame.contentWindow, page = frame.contentDocument;
  const got = { width: page.documentElement.scrollWidth, low: [], dark:
    view.matchMedia("(prefers-color-scheme: dark)").matches };
  got.wide = [...page.querySelectorAll("body *")].filter((n) =>
    !n.closest(".wide") && n.getBoundingClientRect().right > frame.clientWidth + 1)
    .map((n) => n.tagName);
  const walker = page.createTreeWalker(page.body, NodeFilter.SHOW_TEXT);
  let least = 99, texts = 0;
  while (walker.nextNode()) {
    const node = walker.currentNode.parentElement;
    const box = node.getBoundingClientRect();
    if (!walker.currentNode.textContent.trim() || !box.width) continue;
    const a = luminance(parse(view.getComputedStyle(node).color));
    const b = luminance(ground(view, node));
    const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
    texts += 1; least = Math.min(least, ratio);
    if (ratio < 4.5) got.low.push([node.tagName, node.textContent.slice(0, 30), ratio]);
  }
  got.least = least; got.texts = texts;
  got.images = [...page.images].map((i) => [i.complete && i.naturalWidth > 0, i.alt]);
  const wide = [...page.querySelectorAll(".wide")];
  got.focusable = [...wide, ...page.querySelectorAll("th button, nav a")].every((n) => {
    n.focus(); return page.activeElement === n; });
  got.buttons = page.querySelectorAll("th button").length;
  got.sorted = [...page.querySelectorAll("table")].map((table) => {
    const last = table.tHead.rows[0].cells.length - 1;
    const button = table.querySelectorAll("th button")[last];
    if (!button) return null;
    const read = () => [...table.tBodies[0].rows].map((r) =>
      r.cells[last].textContent.trim());
    button.click(); const up = read(); button.click();
    const state = table.tHead.rows[0].cells[last].getAttribute("aria-sort");
    return [up, read(), state]; });
  return got;
}
let left = 2;
for (const width of [390, 1280]) {
  const frame = document.createElement("iframe");
  frame.style.cssText = `width:${width}px;height:900px;border:0`;
  frame.onload = () => { found.frames[width] = measure(frame);
    if (--left === 0) {
      const out = document.createElement("pre"); out.id = "found";
      out.textContent = JSON.stringify(found); document.body.replaceChildren(out); } };
  frame.srcdoc = source; document.body.append(frame);
}
</script></body>"""


def look(page: str, folder: Path, *, dark: bool = False) -> tuple[dict, list[str]]:
    """Return what a browser measures of a page at 390 and 1280 px, and its console."""
    if CHROMIUM is None:
        pytest.skip("Chromium is not installed here: the page is not looked at")
    code = base64.b64encode(page.encode()).decode()
    probe = folder / "probe.html"
    probe.write_text(PROBE.replace("PAGE", code), encoding="utf-8")
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
