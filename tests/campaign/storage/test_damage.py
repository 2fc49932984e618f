"""Full disks, flipped bits, files of others: a clear error, and nothing lost."""

import contextlib
import json
import os
import pickle
import resource
import shutil
import stat
import zlib

import pytest
import torch

from sbi_active import Campaign
from sbi_active.campaign.storage import DamagedCampaignError
from sbi_active.campaign.storage.log import TrialLog
from tests.campaign.storage.campaigns import drawn, draws, facts, go_on, new

LOG = "trials.jsonl"


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


def flip(path, position):
    content = bytearray(path.read_bytes())
    content[position] ^= 4
    path.write_bytes(bytes(content))


def test_a_last_line_that_was_not_finished_is_no_line(made, folder):
    whole = (folder / LOG).read_bytes()
    for num_bytes in (1, 40, len(whole.splitlines()[-1])):
        (folder / LOG).write_bytes(whole + whole.splitlines()[-1][:num_bytes])
        campaign = Campaign.load(folder, simulator=drawn)
        assert facts(campaign) == facts(made[1])
    campaign.tell([0.1, 0.2, 0.3, 0.4])
    campaign.close()
    assert len(Campaign.load(folder).history) == 3


def test_every_byte_of_the_log_is_looked_at(folder):
    content = (folder / LOG).read_bytes()
    for position in range(0, len(content) - 1, 97):
        flip(folder / LOG, position)
        with pytest.raises(DamagedCampaignError, match="line . with another checksum"):
            Campaign.load(folder)
        flip(folder / LOG, position)
    Campaign.load(folder)


def test_a_damaged_line_is_given_up_by_name(made, folder):
    lines = (folder / LOG).read_text().splitlines()
    flip(folder / LOG, len(lines[0]) + len(lines[1]) // 2)  # the first tell
    with pytest.raises(
        DamagedCampaignError, match=r"1 of 5 lines damaged.*repair=True"
    ):
        Campaign.load(folder)
    with pytest.warns(UserWarning, match="given up, tell it again: .*told"):
        campaign = Campaign.load(folder, simulator=drawn, repair=True)
    assert (folder / "trials.damaged").exists()
    assert campaign.history[-1].x is not None
    campaign.tell(made[1].history[0].x, trial=0)
    campaign.update()
    assert torch.equal(draws(campaign), draws(made[1]))


def test_a_trial_without_any_line_leaves_a_gap(tmp_path):
    campaign = new(tmp_path / "c")
    for action, x in (([0.8], 0.3), ([1.0], 0.4), ([1.9], 0.6)):
        campaign.attach(action, [x] * 4)
    campaign.close()
    lines = (tmp_path / "c" / LOG).read_text().splitlines()
    flip(tmp_path / "c" / LOG, len(lines[0]) // 2)
    with pytest.warns(UserWarning, match="given up, tell it again: .*attached"):
        again = Campaign.load(tmp_path / "c", simulator=drawn, repair=True)
    assert [t.status for t in again.history] == ["withdrawn", "ok", "ok"]
    assert again.history[0].reason == "its record was lost"
    again.correct(0, [0.3] * 4, action=[0.8])
    again.update()
    apart = new()
    for trial in campaign.history:
        apart.attach(trial.action, trial.x)
    apart.update()
    assert torch.equal(draws(again), draws(apart))
    again.close()
    assert Campaign.load(tmp_path / "c", repair=True).history[0].status == "ok"


@pytest.mark.parametrize("name", ["state.bin", "belief"])
def test_what_can_be_computed_again_is(made, folder, name):
    path = next(folder.glob(f"{name}*"))
    for damage in (lambda f: flip(f, 100), lambda f: f.write_bytes(b""), os.unlink):
        damage(path)
        campaign = Campaign.load(folder, simulator=drawn)
        campaign.update()
        assert torch.equal(draws(campaign), draws(made[1]))
        campaign.close()
        path = next(folder.glob(f"{name}*"))


def test_a_manifest_has_a_copy(made, folder):
    flip(folder / "campaign.json", 200)
    with pytest.raises(DamagedCampaignError, match="the log of the trials untouched"):
        Campaign.load(folder)
    campaign = Campaign.load(folder, simulator=drawn, repair=True)
    assert facts(campaign) == facts(made[1])
    Campaign.load(folder)


def test_another_schema_names_the_release(folder):
    import hashlib

    manifest = json.loads((folder / "campaign.json").read_text())
    del manifest["sha256"]
    manifest["schema"] = 2
    manifest["packages"]["sbi-active"] = "9.9"
    text = json.dumps(manifest, sort_keys=True)
    manifest["sha256"] = hashlib.sha256(text.encode()).hexdigest()
    (folder / "campaign.json").write_text(json.dumps(manifest))
    with pytest.raises(ValueError, match=r"schema 1; got .* of schema 2.*9\.9"):
        Campaign.load(folder)


class Bomb:
    def __reduce__(self):
        return (os.mkdir, ("exploded",))


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """A campaign of one trial, to copy."""
    folder = tmp_path_factory.mktemp("short") / "c"
    go_on(new(folder), 1).close()
    return folder


@pytest.mark.parametrize("name", ["state.bin", "belief", "campaign.json", LOG])
def test_nothing_is_executed(short, tmp_path, name):
    import hashlib

    folder = shutil.copytree(short, tmp_path / "c")
    path = next(folder.glob(f"{name}*"))
    for content in (
        pickle.dumps(Bomb()),
        zlib.compress(pickle.dumps(Bomb())),
        zlib.compress(_saved({"structure": "{}", "arrays": Bomb()})),
    ):
        digest = hashlib.sha256(content).hexdigest().encode()
        for prefix in (b"", digest + b"\n"):
            path.write_bytes(prefix + content)
            with contextlib.suppress(ValueError, OSError):
                Campaign.load(folder, simulator=drawn).update()
            path = folder / path.name
            assert not (tmp_path / "exploded").exists()


def _saved(value):
    import io

    buffer = io.BytesIO()
    torch.save(value, buffer)
    return buffer.getvalue()


def test_a_full_disk_refuses_and_loses_nothing(made, folder):
    size = (folder / LOG).stat().st_size
    pid = os.fork()
    if pid == 0:
        import signal

        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        campaign = Campaign.load(folder, simulator=drawn)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size + 50, size + 50))
        try:
            campaign.tell([0.1, 0.2, 0.3, 0.4])
        except OSError as error:
            told = "what was told before is whole" in str(error)
            os._exit(0 if told and campaign.pending is not None else 2)
        os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    assert (folder / LOG).stat().st_size == size
    campaign = Campaign.load(folder, simulator=drawn)
    assert facts(campaign) == facts(made[1])
    campaign.tell([0.1, 0.2, 0.3, 0.4])


def test_a_directory_that_cannot_be_written(made, folder, monkeypatch):
    campaign = Campaign.load(folder, simulator=drawn)
    if os.geteuid() == 0:  # whom no permission stops

        def refuse(self, entry):
            raise PermissionError(13, "Permission denied", str(self.path))

        monkeypatch.setattr(TrialLog, "append", refuse)
    else:
        folder.chmod(stat.S_IRUSR | stat.S_IXUSR)
    with pytest.raises(OSError):
        campaign.tell([0.1, 0.2, 0.3, 0.4])
    assert campaign.pending is not None
    assert facts(campaign) == facts(made[1])
    folder.chmod(stat.S_IRWXU)
