"""Full disks, flipped bits, files of others: a clear error, and nothing lost."""

import contextlib
import io
import json
import os
import pickle
import resource
import shutil
import signal
import stat
import zlib

import pytest
import torch

from sbi_active import Campaign
from sbi_active.campaign.storage.codec import decode, encode
from sbi_active.messages import StorageWarning
from sbi_active.simulation.bank import CorruptSegmentError
from sbi_active.simulation.bank.store import Store
from tests.campaign.storage.campaigns import MODEL, PRIOR, draws, facts, go_on, new
from tests.campaign.storage.test_codec import Called
from tests.simulation.bank.filled import FILE, crafted, execute, filled, flip


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A campaign of two trials and one pending, to copy."""
    folder = tmp_path_factory.mktemp("made") / "c"
    campaign = go_on(new(folder), 2)
    campaign.ask()
    campaign.close()
    return folder, campaign


@pytest.fixture
def folder(made, tmp_path):
    return shutil.copytree(made[0], tmp_path / "c")


def test_what_was_not_committed_is_not_there(made, folder):
    with Campaign.load(folder, simulator=MODEL) as campaign:
        with campaign._storage.writing():
            pass
        campaign.tell([0.1, 0.2, 0.3, 0.4])
        log = (folder / "store.db-wal").read_bytes().rstrip(b"\0")
        before = (folder / FILE).read_bytes()
    for num_bytes in (0, 20, 40, len(log) // 2, len(log) - 1):
        (folder / FILE).write_bytes(before)
        (folder / "store.db-wal").write_bytes(log[:num_bytes])
        (folder / "store.db-shm").unlink(missing_ok=True)
        campaign = Campaign.load(folder, simulator=MODEL)
        assert facts(campaign) == facts(made[1])
    campaign.tell([0.1, 0.2, 0.3, 0.4])
    campaign.close()
    assert len(Campaign.load(folder).history) == 3


@pytest.mark.parametrize("number", [1, 3])
def test_every_byte_of_the_log_is_looked_at(made, folder, number):
    execute(folder, "VACUUM")  # no page of before holds the line as well
    lines = execute(folder, "SELECT content FROM records WHERE kind = 'log'")
    text, content = lines[number - 1][0], (folder / FILE).read_bytes()
    start = content.index(text)
    for position in range(start, start + len(text), 23):
        flip(folder / FILE, position)
        text = rf"'log' {number} with another .*from a copy"
        with pytest.raises(CorruptSegmentError, match=text):
            Campaign.load(folder)
        (folder / FILE).write_bytes(content)
    Campaign.load(folder)
    told = json.loads(lines[-2][0])  # of each line by itself
    assert told["trial"]["x"] == made[1].history[1].x.tolist()


@pytest.mark.parametrize("name", ["state", "belief"])
def test_what_can_be_computed_again_is(made, folder, name):
    for change in (
        "UPDATE records SET content = x'00' WHERE kind = ?",
        "UPDATE records SET digest = x'00' WHERE kind = ?",
        "DELETE FROM records WHERE kind = ?",
    ):
        execute(folder, change, name)
        campaign = Campaign.load(folder, simulator=MODEL)
        campaign.update()
        assert torch.equal(draws(campaign), draws(made[1]))
        campaign.close()


def test_a_belief_of_other_code_is_computed_again(made, folder):
    known = {"simulator": MODEL, "prior": PRIOR}
    store = Store(folder)
    with store.writing():
        belief = decode(store.get("belief"), known=known)
        del belief._defensive  # what it was called when it was stored
        store.put("belief", encode(belief, known=known))
    store.close()
    campaign = Campaign.load(folder, simulator=MODEL)
    with pytest.warns(StorageWarning, match="computed again.*SA601"):
        campaign.update()
    assert torch.equal(draws(campaign), draws(made[1]))
    campaign.close()


def test_a_damaged_manifest_another_format_or_a_bank_is_no_campaign(folder, tmp_path):
    manifest = folder / FILE
    content = manifest.read_bytes()
    execute(folder, "UPDATE records SET content = x'00' WHERE kind = 'campaign'")
    with pytest.raises(CorruptSegmentError, match="'campaign' 0 with another checksum"):
        Campaign.load(folder)
    manifest.write_bytes(content)
    execute(folder, "PRAGMA user_version = 99")
    with pytest.raises(ValueError, match="a campaign of format 4; got 99 .*release"):
        Campaign.load(folder)
    with pytest.raises(ValueError, match="expected a campaign; got a bank"):
        Campaign.load(filled(tmp_path / "bank"))


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """A campaign of one trial, to copy."""
    folder = tmp_path_factory.mktemp("short") / "c"
    go_on(new(folder), 1).close()
    return folder


@pytest.mark.parametrize("kind", ["state", "belief", "campaign", "log", "prior"])
def test_nothing_is_executed(short, tmp_path, kind):
    folder, saved = shutil.copytree(short, tmp_path / "c"), io.BytesIO()
    exploding = Called(os.mkdir, "exploded")
    torch.save({"lines": exploding}, saved)
    bomb = pickle.dumps(exploding)
    for content in (bomb, zlib.compress(bomb), zlib.compress(saved.getvalue())):
        crafted(folder, kind, int(kind == "log"), content)
        with contextlib.suppress(ValueError, OSError):
            Campaign.load(folder, simulator=MODEL).update()
        assert not (tmp_path / "exploded").exists()
    (folder / FILE).write_bytes(bomb)
    with pytest.raises(CorruptSegmentError):
        Campaign.load(folder)
    assert not (tmp_path / "exploded").exists()


def test_a_full_disk_refuses_and_loses_nothing(made, folder):
    size = (folder / FILE).stat().st_size
    pid = os.fork()
    if pid == 0:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        campaign = Campaign.load(folder, simulator=MODEL)
        with campaign._storage.writing():
            pass
        resource.setrlimit(resource.RLIMIT_FSIZE, (50, 50))
        try:
            campaign.tell([0.1, 0.2, 0.3, 0.4])
        except OSError as error:
            told = "what was stored before is whole" in str(error)
            os._exit(0 if told and campaign.pending is not None else 2)
        os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    assert (folder / FILE).stat().st_size == size
    campaign = Campaign.load(folder, simulator=MODEL)
    assert facts(campaign) == facts(made[1])
    campaign.tell([0.1, 0.2, 0.3, 0.4])


def test_who_may_not_write_the_file_leaves_no_notes_beside_it(folder, monkeypatch):
    # They would be another user's, and keep its owner from writing.
    monkeypatch.setattr(os, "access", lambda path, mode: path.name != FILE)
    with Store(folder).reading():
        assert [*folder.glob(f"{FILE}-*")] == []


def test_a_directory_that_cannot_be_written(made, folder, monkeypatch):
    campaign = Campaign.load(folder, simulator=MODEL)
    if os.geteuid() == 0:  # whom no permission stops

        def refuse(self):
            raise PermissionError(13, "Permission denied", str(self.path))

        monkeypatch.setattr(Store, "acquire", refuse)
    else:
        folder.chmod(stat.S_IRUSR | stat.S_IXUSR)
    with pytest.raises(OSError):
        campaign.tell([0.1, 0.2, 0.3, 0.4])
    assert campaign.pending is not None
    assert facts(campaign) == facts(made[1])
    folder.chmod(stat.S_IRWXU)
