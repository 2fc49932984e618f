"""``watch``: a page of a campaign that another process runs, for this machine alone."""

import http.client
import os
import re
import signal
import socket
import subprocess
import threading
from pathlib import Path

import pytest

from sbi_active.cli import main, watch
from tests.campaign.storage.campaigns import MODEL, go_on, new
from tests.cli.sled import run
from tests.display.browser import CHROMIUM, FLAGS, assert_reads_well


class Campaigner:
    """A campaign in a process of its own, which goes on one step when it is told to."""

    def __init__(self, folder):
        (theirs, self.told), (self.heard, ours) = os.pipe(), os.pipe()
        self.pid = os.fork()
        if self.pid == 0:
            status = 1
            try:
                campaign = new(folder / "camp", simulator=MODEL)
                steps = (
                    campaign.ask,
                    lambda: go_on(campaign, 1),
                    lambda: go_on(campaign, 2),
                )
                for step in (*steps, campaign.close):
                    os.write(ours, b".")
                    os.read(theirs, 1)
                    step()
                status = 0
            finally:
                os._exit(status)
        os.close(ours)
        assert os.read(self.heard, 1) == b"."

    def goes_on(self):
        os.write(self.told, b".")
        assert os.read(self.heard, 1) == b"."

    def ends(self):
        os.write(self.told, b".")
        assert os.waitpid(self.pid, 0)[1] == 0


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder, as a campaign of two trials leaves it; with the pages on the way."""
    folder = tmp_path_factory.mktemp("watched")
    campaigner = Campaigner(folder)
    watched = watch.Watched(folder / "camp")
    pages, versions = [], []
    for _ in range(3):
        versions += [watched.version()]
        pages += [watched.page()]
        campaigner.goes_on()
    campaigner.ends()
    return folder / "camp", [*pages, watched.page()], [*versions, watched.version()]


@pytest.fixture
def server(place):
    """A server in a thread, and the port where it listens."""
    with watch.Server(watch.Watched(place[0]), 0) as made:
        thread = threading.Thread(target=made.serve_forever, daemon=True)
        thread.start()
        yield made
        made.shutdown()
        thread.join()


def asked(server, path="/", method="GET", **headers):
    connection = http.client.HTTPConnection(watch.HOST, server.server_port, timeout=60)
    connection.request(method, path, headers=headers)
    answer = connection.getresponse()
    return answer.status, answer.read().decode(), answer.headers


def news(page):
    return re.findall('<p role="status">(.*)</p>', page)


def test_the_page_follows_a_campaign_of_another_process(place):
    folder, pages, versions = place
    assert len({*versions}) == 4
    assert all(version in page for page, version in zip(pages, versions, strict=True))
    first, asked_, told, last = pages
    assert ": trial 0 is to be designed." in news(first)[0]
    assert ": trial 0 waits for its outcome" in news(asked_)[0]
    assert re.search(r"trial 1 is to be designed \(design of trial 0: .* s\)", told)
    assert "1 trials told" in told
    assert "2 trials told" in last
    assert news(last)[0].startswith(f"{folder}: ")
    for page in pages:
        assert "Belief by round" in page or "belief of each parameter by round" in page
        assert "http:" not in page
        assert "https:" not in page


def test_a_browser_is_answered(server):
    status, page, headers = asked(server)
    assert status == 200
    assert headers["Content-Type"] == "text/html; charset=utf-8"
    assert headers["Cache-Control"] == "no-store"
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    status, version, _ = asked(server, "/version")
    assert status == 200
    assert f'!== "{version}"' in page


def test_it_listens_on_this_machine_alone(server):
    assert server.server_address[0] == "127.0.0.1"
    assert asked(server, Host="example.org")[0] == 403
    assert asked(server, Host=f"localhost:{server.server_port}")[0] == 200


def test_it_is_only_read_and_gives_no_file(server):
    assert [asked(server, method=m)[0] for m in ("POST", "HEAD")] == [501, 501]
    for path in ("/store.db", "/../store.db", "/%2e%2e/store.db", "/version/.."):
        status, text, _ = asked(server, path)
        assert status == 404
        assert "SQLite" not in text


def test_a_reader_that_leaves_is_no_error(server, capfd):
    for _ in range(3):
        with socket.create_connection((watch.HOST, server.server_port)) as leaving:
            leaving.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
            leaving.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
    assert asked(server)[0] == 200
    assert "Traceback" not in capfd.readouterr().err


def test_the_command_ends_by_an_interrupt(place):
    words = ["watch", str(place[0]), "--port", "0"]
    process = run(words, stdout=subprocess.PIPE)
    said = process.stdout.readline()
    port = re.fullmatch(r".* is shown at http://127.0.0.1:(\d+) until Ctrl-C\n", said)
    assert port is not None, said
    socket.create_connection(("127.0.0.1", int(port[1])), timeout=10).close()
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert error == "sbi-active: interrupted; what was told before is kept\n"


def test_nothing_of_the_folder_changes(place, capsys):
    def content():
        return {p.name: p.read_bytes() for p in place[0].iterdir()}

    before = content()
    assert main(["watch", str(place[0]), "--once", "page.html"]) == 0
    assert capsys.readouterr().out == "saved: page.html\n"
    assert content() == before
    page = Path("page.html").read_text(encoding="utf-8")
    assert "2 trials told" in page
    assert "setInterval" not in page


def test_it_reads_well_in_a_browser(place, tmp_path):
    assert_reads_well(watch.Watched(place[0]).drawn(), tmp_path)


def test_a_browser_loads_the_page_again(place, server, tmp_path, monkeypatch):
    if CHROMIUM is None:
        pytest.skip("Chromium is not installed here: the page is not looked at")
    made, drawn = [], watch.Watched.drawn

    def counted(self):
        made.append(self)
        monkeypatch.setattr(watch, "digest", lambda _: "changed")
        return drawn(self)

    monkeypatch.setattr(watch.Watched, "drawn", counted)
    done = subprocess.run(
        [
            CHROMIUM,
            *FLAGS,
            f"--user-data-dir={tmp_path / 'profile'}",
            f"http://{watch.HOST}:{server.server_port}/",
        ],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert "2 trials told" in done.stdout
    assert len(made) == 2  # drawn, found changed, and loaded again
    assert not [line for line in done.stderr.splitlines() if "CONSOLE" in line]
