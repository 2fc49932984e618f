"""``watch``: a page that follows a campaign which another process runs."""

import json
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest

from sbi_active import Campaign
from sbi_active.campaign.watch import server_of
from sbi_active.cli import main
from tests.cli.sled import forked
from tests.display.browser import assert_reads_well
from tests.simulation.bank.filled import execute

ROOT = Path(__file__).parents[2]


def ask(url, path="/", **headers):
    with urlopen(Request(f"{url}{path}", headers=headers), timeout=60) as answer:
        return answer.read().decode()


def refused(url, path="/", method="GET", **headers):
    """Return the status of a request that is refused, and what it says."""
    request = Request(f"{url}{path}", method=method, headers=headers)
    with pytest.raises(HTTPError) as raised:
        urlopen(request, timeout=60)
    return raised.value.code, raised.value.read().decode()


def wait_for(text, url):
    until = time.monotonic() + 60
    while text not in (page := ask(url)):
        assert time.monotonic() < until
        time.sleep(0.2)
    return page


@contextmanager
def watched(folder):
    """Yield the address of a campaign's page, shown by a thread."""
    with server_of(folder) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()


def test_the_page_follows_a_campaign_of_another_process(camp, tmp_path):
    before = {p.name: p.read_bytes() for p in camp.iterdir()}
    process = forked(["watch", "camp"], stdout=subprocess.PIPE)
    said = process.stdout.readline()
    place = re.fullmatch(r"open (http://127\.0\.0\.1:\d+), until Ctrl-C\n", said)
    assert place is not None, said
    page = wait_for("1 trial told; trial 1 is pending", place[1])
    state = json.loads(ask(place[1], "/state"))
    assert state["doing"] == "trial 1 waits for its outcome"
    assert f'now.seal !== "{state["seal"]}"' in page  # else it is loaded again
    assert {p.name: p.read_bytes() for p in camp.iterdir()} == before  # it is only read
    assert "https:" not in page
    assert main(["tell", "camp", "0.7"]) == 0
    assert json.loads(ask(place[1], "/state"))["seal"] != state["seal"]
    page = wait_for("2 trials told", place[1])
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert error == "sbi-active: interrupted; what was told before is kept\n"
    assert_reads_well(page.replace("\nfollow();", ""), tmp_path)  # nobody answers there


ROUNDS = """
import sys
from tests.campaign.storage.campaigns import go_on, new
campaign = new(sys.argv[1])
for num in range(1, 4):
    input()
    go_on(campaign, num)
input()
campaign.ask()
campaign.close()
"""


def test_rounds_of_another_process_come_in(tmp_path):
    folder = tmp_path / "c"
    words = [sys.executable, "-c", ROUNDS, str(folder)]
    process = subprocess.Popen(words, cwd=ROOT, stdin=subprocess.PIPE, text=True)
    while not (folder / "campaign.toml").exists():
        assert process.poll() is None
        time.sleep(0.1)
    with watched(folder) as url:
        for num in range(1, 4):
            print(file=process.stdin, flush=True)
            wait_for(f"{num} trial{'s' * (num > 1)} told", url)
        print(file=process.stdin, flush=True)
        assert process.wait(timeout=60) == 0
        state = json.loads(ask(url, "/state"))
        assert state["doing"] == "trial 3 waits for its outcome"
    assert len(Campaign.load(folder).history) == 3


def test_what_is_going_on_is_said(camp):
    def doing():
        return json.loads(ask(url, "/state"))["doing"]

    with watched(camp) as url:
        with Campaign.load(camp) as campaign:
            campaign.tell([0.7])
            assert doing() == "a process has it open; to be learned: trial 1"
        assert doing() == "no process has the campaign open"


def test_nothing_else_is_answered(camp):
    (camp / "mine.txt").write_text("precious")
    with watched(camp) as url:
        port = int(url.rpartition(":")[2])
        with socket.create_connection(("127.0.0.1", port)) as left:
            left.sendall(b"GET / HTTP/1.0\r\n")  # and leaves
        for path in ("/mine.txt", "/../camp/mine.txt", "//etc/passwd", "/?a"):
            assert refused(url, path)[0] == 404
        for method in ("POST", "PUT", "DELETE"):
            assert refused(url, method=method)[0] == 501
        # A site whose name was made to lead here is not told anything.
        assert refused(url, Host="evil.example")[0] == 404
        assert refused(url, "/state", Host=f"127.0.0.1.evil.example:{port}")[0] == 404
        assert "1 trial told" in ask(url, Host="localhost:8000")  # through a tunnel
        with suppress(OSError), socket.create_connection((own_address(), port), 1):
            raise AssertionError("others on the network are answered")


def own_address():
    """Return an address of this machine that others may use."""
    found = socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)
    return next((a[4][0] for a in found if not a[4][0].startswith("127.")), "0.0.0.1")


def test_a_file_that_is_damaged_meanwhile_is_said(camp):
    with watched(camp) as url:
        assert "1 trial told" in ask(url)
        execute(camp, "UPDATE records SET digest = x'00' WHERE kind = 'log'")
        status, text = refused(url)
        assert status == 503
        assert "with another checksum" in text
