"""``watch``: a page that follows a campaign which another process runs."""

import re
import signal
import subprocess
import time
from pathlib import Path
from urllib.parse import urlparse

from sbi_active.cli import main
from tests.cli.sled import run
from tests.display.browser import assert_reads_well


def wait_for(text, path):
    until = time.monotonic() + 60
    while text not in (page := path.read_text(encoding="utf-8")):
        assert time.monotonic() < until
        time.sleep(0.2)
    return page


def test_the_page_follows_a_campaign_of_another_process(camp, tmp_path):
    before = {p.name: p.read_bytes() for p in camp.iterdir()}
    process = run(["watch", "camp", "--out", "page.html"], stdout=subprocess.PIPE)
    said = process.stdout.readline()
    place = re.fullmatch(r"open (file://.*), until Ctrl-C\n", said)
    assert place is not None, said
    path = Path(urlparse(place[1]).path)
    assert path == tmp_path / "page.html"
    page = wait_for("1 trials told; trial 1 is pending", path)
    assert {p.name: p.read_bytes() for p in camp.iterdir()} == before  # it is only read
    assert '<meta http-equiv="refresh" content="5">' in page
    assert "https:" not in page
    assert main(["tell", "camp", "0.7"]) == 0
    page = wait_for("2 trials told", path)
    assert_reads_well(page, tmp_path)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert error == "sbi-active: interrupted; what was told before is kept\n"


def test_what_is_no_campaign_is_said(capsys):
    assert main(["watch", "nowhere"]) == 2
    assert "expected a campaign; got no nowhere" in capsys.readouterr().err
