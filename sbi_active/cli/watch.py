"""``sbi-active watch DIR``: a campaign in a browser, while another process runs it.

The page is made of the folder alone, which is only read; nothing that it names is
imported. Requests from other machines, or for anything else, are refused.
"""

from __future__ import annotations

import sys
import threading
from html import escape
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from click import IntRange

from sbi_active.cli import declare as cli
from sbi_active.cli.record import digest

HOST = "127.0.0.1"
#: What a browser lets the page do: show itself, and ask for its version.
POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "img-src data:; connect-src 'self'; base-uri 'none'; frame-ancestors 'none'"
)
#: Asks every two seconds whether there is another page, and says when nobody answers.
SCRIPT = """<script>
setInterval(async () => {
  try {
    const answer = await fetch("/version", { cache: "no-store" });
    if (answer.ok && await answer.text() !== "VERSION") location.reload();
  } catch { document.querySelector("[role=status]").textContent =
    "Nobody watches any more: this is the campaign as it was last."; }
}, 2000);
</script>
"""


class Watched:
    """The page of a campaign, drawn again where the folder's store has changed.

    Args:
        folder: Folder of the campaign.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._drawing = folder, threading.Lock()
        self._page = self._version = ""

    def version(self) -> str:
        """Text that changes with the store."""
        return digest(self._folder) or "unknown"

    def page(self) -> str:
        """Return the page, which asks for newer ones."""
        with self._drawing:
            version = self.version()  # of before, so that nothing later is missed
            if version != self._version:
                try:
                    text = self.drawn()
                except (ValueError, OSError) as error:
                    from sbi_active.display import Page

                    text = _with_news(Page("Campaign", []).html(), str(error))
                script = SCRIPT.replace("VERSION", version)
                self._page = text.replace("</body>", f"{script}</body>")
                self._version = version
            return self._page

    def drawn(self) -> str:
        """Return the page as it is now."""
        from sbi_active.campaign import Campaign
        from sbi_active.campaign.display.page import page

        with Campaign.load(self._folder) as campaign:
            return _with_news(page(campaign), _news(campaign))


@cli.command(
    cli.DIR,
    cli.option(
        "--port",
        "of this machine alone; 0 is any free one",
        IntRange(0, 65_535),
        default=8642,
    ),
    cli.option("--once", "write the page, and end", cli.FILE, "FILE.html"),
)
def watch(folder: Path, port: int, once: Path | None) -> None:
    """Show a campaign in a browser while another process runs it.

    The page is drawn again when the folder changes; the folder is only read.
    """
    import matplotlib

    matplotlib.use("Agg")  # figures are drawn by threads, which may open no window
    watched = Watched(folder)
    text = watched.drawn()  # what is wrong with it is said here
    if once is not None:
        once.write_text(text, encoding="utf-8")
        print(f"saved: {once}")
        return
    with Server(watched, port) as server:
        place = f"http://{HOST}:{server.server_port}"
        print(f"{folder} is shown at {place} until Ctrl-C", flush=True)
        server.serve_forever()


class Server(ThreadingHTTPServer):
    """Serves a page, for this machine alone.

    Args:
        watched: Object that has the page.
        port: Port where it listens; 0 is any that is free.

    Raises:
        ValueError: If another program listens there, or only others may.
    """

    def __init__(self, watched: Watched, port: int) -> None:
        self.texts = {
            "/": ("html", watched.page),
            "/version": ("plain", watched.version),
        }
        try:
            super().__init__((HOST, port), _Answering)
        except OSError as error:
            raise ValueError(
                f"expected a port that is free; got {port} ({error.strerror}); choose "
                "another by --port, or 0 for any"
            ) from error

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of a reader that leaves, nor of what an interrupt cuts off."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)


class _Answering(BaseHTTPRequestHandler):
    server: Server

    def do_GET(self) -> None:  # noqa: N802
        # A page from elsewhere that has its name point here asks by that name.
        is_here = self.headers.get("Host", "").partition(":")[0] in (HOST, "localhost")
        kind, text = self.server.texts.get(self.path, ("", None))
        if text is None or not is_here:
            self.send_error(404 if is_here else 403)
            return
        content = text().encode()
        self.send_response(200)
        self.send_header("Content-Type", f"text/{kind}; charset=utf-8")
        self.send_header("Content-Security-Policy", POLICY)
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *_: object) -> None:
        """Say nothing of each request."""


def _news(campaign: Any) -> str:
    """Return what is being computed, as far as the folder says."""
    from sbi_active.progress import in_words

    late = campaign.not_in_belief
    if campaign.pending is not None:
        doing, stage = f"trial {campaign.pending.index} waits for its outcome", ""
    elif late:
        doing, stage = f"trials not in the belief yet: {late}", "update"
    else:
        doing, stage = f"trial {len(campaign.history)} is to be designed", "design"
    took = [(t.index, t.seconds[stage]) for t in campaign.history if stage in t.seconds]
    for index, seconds in took[-1:]:
        doing += f" ({stage} of trial {index}: {in_words(seconds)})"
    return f"{campaign.directory}: {doing}."


def _with_news(text: str, news: str) -> str:
    """Return a page with a line in front."""
    line = f'<main>\n<p role="status">{escape(news)}</p>'
    return text.replace("<main>", line, 1)
