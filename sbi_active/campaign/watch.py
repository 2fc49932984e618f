"""A page for browsers on this machine that follows the file of a campaign.

Another process runs the campaign; here its file is only read. A browser gets the page
and, each second, what is going on; it gets nothing else, of the file system least of
all, and neither does a site elsewhere, whatever name it gives this machine.
"""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from functools import partial
from html import escape
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

from sbi_active.campaign.campaign import Campaign
from sbi_active.display.campaign_page import page
from sbi_active.display.page import templates
from sbi_active.simulation.bank.store import LOCK, Store


class Watched:
    """A campaign in a folder as it is shown, read again when its file has changed.

    Args:
        folder: Folder of the campaign.

    Raises:
        ValueError: If there is none.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._seal, self._page = folder, "", ""
        self.page()

    def page(self) -> str:
        """Return the page, which asks for :meth:`state` each second."""
        if (seal := self._now()) != self._seal:
            self._campaign = Campaign.load(self._folder)
            follow = templates().get_template("follow.html.jinja").render(seal=seal)
            self._page = page(self._campaign).replace("<main>", follow, 1)
            self._seal = seal
        return self._page

    def state(self) -> str:
        """Return, as JSON, a seal that changes with the file, and what goes on."""
        self.page()
        return json.dumps({"seal": self._seal, "doing": self._doing()})

    def _now(self) -> str:
        return Store(self._folder, "campaign").seal("-wal")

    def _doing(self) -> str:
        """Return what the campaign waits for: the robot, or a process that has it."""
        pending, late = self._campaign.pending, self._campaign.not_in_belief
        if pending is not None:
            return f"trial {pending.index} waits for its outcome"
        if not is_written(self._folder):
            return "no process has the campaign open"
        told = ", ".join(map(str, late))
        work = f"learned: trial {told}" if late else "designed: the next trial"
        return f"a process has it open; to be {work}"


def is_written(folder: Path) -> bool:
    """Return whether a process has the right to write to a folder's store."""
    place = f"file:{quote(str((folder / LOCK).absolute()))}?mode=ro"
    try:
        with closing(sqlite3.connect(place, uri=True, timeout=0)) as lock:
            lock.execute("PRAGMA schema_version").fetchall()
    except sqlite3.OperationalError as error:
        return "locked" in str(error)
    return False


class Handler(BaseHTTPRequestHandler):
    """Answers a GET of the page or of its state, and nothing else.

    Args:
        shown: The campaign that is shown.
    """

    timeout = 10.0  # s: one that asks nothing keeps nobody waiting

    def __init__(self, shown: Watched, *request: Any) -> None:
        self._answers = {"/": shown.page, "/state": shown.state}
        super().__init__(*request)

    def do_GET(self) -> None:  # noqa: N802
        """Answer what was asked for; other methods are refused already."""
        make = self._answers.get(self.path)
        host = urlsplit(f"//{self.headers['Host']}").hostname
        if make is None or host not in ("127.0.0.1", "localhost"):
            status, content = 404, "there is a page and its /state, for this machine"
        else:
            try:
                status, content = 200, make()
            except (OSError, ValueError) as error:  # as of a file damaged meanwhile
                status, content = 503, escape(str(error))
        kind = "text/html" if self.path == "/" else "text/plain"
        self.send_response(status)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.end_headers()
        self.wfile.write(content.encode())

    def log_message(self, format: str, *args: Any) -> None:
        """Print nothing."""


def server_of(folder: Path, port: int = 0) -> HTTPServer:
    """Return a server of the page of a campaign, on this machine alone.

    Args:
        folder: Folder of the campaign.
        port: Port; 0 is a free one.
    """
    server = HTTPServer(("127.0.0.1", port), partial(Handler, Watched(folder)))
    server.handle_error = lambda request, client_address: None  # of a browser that left
    return server
