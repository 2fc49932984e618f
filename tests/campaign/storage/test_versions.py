"""Folders that earlier releases wrote are brought up to date, and go on."""

import json
import shutil

import numpy as np
import pytest
import torch

from sbi_active import Bank, Campaign
from sbi_active.cli import main
from sbi_active.migration import migrate
from sbi_active.simulation.bank import CorruptSegmentError
from tests.campaign.storage.version_1 import FOLDER, simulator

BANK = FOLDER / "simulations" / "drawn"
ROWS = 1156


@pytest.fixture
def old(tmp_path):
    return shutil.copytree(FOLDER, tmp_path / "c")


@pytest.fixture
def folder(old):
    migrate(old)
    return old


def require_trials(campaign):
    history = campaign.history
    assert [t.status for t in history] == ["ok", "ok", "ok"]
    assert history[1].reason == "told in cm"
    assert history[1].x.tolist() == pytest.approx([0.62, 0.88, 1.21])
    assert history[2].x.isnan().tolist() == [False, True, False]
    assert campaign.pending.index == 3


def test_what_is_to_be_done_is_said(old, capsys):
    with pytest.raises(ValueError, match="sbi-active migrate"):
        Campaign.load(old)
    assert main(["migrate", str(old)]) == 0
    said = f"log: 5\ndrawn: {ROWS}\nthe files of before are in {old / 'version-1'}\n"
    assert capsys.readouterr().out == said
    names = sorted(path.name for path in old.iterdir())
    assert names == ["campaign.toml", "store.db", "version-1"]
    for path in FOLDER.rglob("*.*"):
        copy = old / "version-1" / path.relative_to(FOLDER)
        assert not path.is_file() or path.read_bytes() == copy.read_bytes()
    assert main(["migrate", str(old)]) == 2
    assert "expected a bank or campaign of release 0.1" in capsys.readouterr().err


def test_read(folder):
    # Its trials stay, and the belief is the prior until an update computes it again.
    campaign = Campaign.load(folder)
    require_trials(campaign)
    assert campaign.not_in_belief == [0, 1, 2]
    assert campaign.actions.units == ["m/s"]
    belief = campaign.belief
    assert belief.mean.tolist() == pytest.approx([0.5, 0.5], abs=0.02)
    campaign.close()
    with Campaign.load(folder, simulator=simulator) as campaign:
        campaign.update()
        mean = campaign.belief.mean.tolist()
        assert mean == pytest.approx([0.2913, 0.6018], abs=0.05)


def test_gone_on_with_to_the_last_bit(folder):
    def finished(campaign):
        campaign.tell([0.4, 0.7, 1.0])
        torch.manual_seed(0)
        return campaign.update().sample((300,))

    with Campaign.load(folder, simulator=simulator) as campaign:
        require_trials(campaign)
        draws = finished(campaign)
    given = {"method": "nsbi", "options": campaign.state.options, "seed": 1}
    anew = Campaign(simulator, campaign.first_prior, campaign.actions, **given)
    anew.attach([1.0], [0.31, 0.62, 0.9])
    anew.attach([2.0], [62.0, 88.0, 121.0])
    anew.correct(1, [0.62, 0.88, 1.21], reason="told in cm")
    anew.attach([1.5], [0.4, float("nan"), 1.0])
    anew.ask()
    assert torch.equal(draws, finished(anew))


def test_what_was_simulated_is_there_row_by_row(folder):
    h5py = pytest.importorskip("h5py")
    bank = Bank(folder, name="drawn")
    bank.verify()
    columns = {name: bank.table()[name] for name in ("theta", "index", "log_proposal")}
    columns["x"] = bank.read().x.numpy()
    for name, column in columns.items():
        files = sorted(BANK.glob("segments/*.h5"))
        parts = []
        for path in files:
            with h5py.File(path) as file:
                parts.append(file[name][()])
        assert np.array_equal(np.concatenate(parts), column, equal_nan=True)
    header = json.loads((BANK / "bank.json").read_text())
    assert bank.header["simulator"] == header["simulator"]


def test_a_bank_alone_and_several_in_a_folder(tmp_path):
    shutil.copytree(BANK, tmp_path / "bank")
    assert migrate(tmp_path / "bank") == {"rows": ROWS}
    assert len(Bank(tmp_path / "bank")) == ROWS
    with Bank(tmp_path / "bank", simulator=simulator) as bank:
        assert (bank.table()["status"] == 0).sum() == ROWS
    for name in ("drawn", "noise-free"):
        shutil.copytree(BANK, tmp_path / "banks" / name)
    assert migrate(tmp_path / "banks") == {"drawn": ROWS, "noise-free": ROWS}
    assert len(Bank(tmp_path / "banks", name="noise-free")) == ROWS


def test_one_that_was_cut_short_is_done_again(old, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr("sbi_active.migration.folders.copy_bank", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            migrate(old)
    assert {p.name for p in FOLDER.iterdir()} <= {p.name for p in old.iterdir()}
    migrate(old)
    require_trials(Campaign.load(old))
    (old / "version-1" / "campaign.json").rename(old / "campaign.json")
    assert migrate(old) == {}
    assert not (old / "campaign.json").exists()


@pytest.mark.parametrize("name", ["trials.jsonl", "campaign.json", "a segment"])
def test_damage_is_named_and_nothing_is_moved(old, name):
    if name == "a segment":
        path = next(old.glob("simulations/drawn/segments/*.h5"))
    else:
        path = old / name
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)
    if name == "campaign.json":
        (old / "campaign.json.copy").unlink()
    with pytest.raises(CorruptSegmentError, match=path.name):
        migrate(old)
    assert not (old / "store.db").exists()
    assert (old / "campaign.json").exists()


def test_a_log_that_ends_within_a_line_is_said(old):
    path = old / "trials.jsonl"
    content = path.read_bytes()
    path.write_bytes(content[:-20])  # as after a kill
    with pytest.warns(UserWarning, match="ends within line 5, which is left out"):
        assert migrate(old)["log"] == 4
    assert (old / "version-1" / "trials.jsonl").read_bytes() == content[:-20]
