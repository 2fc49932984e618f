"""Directories that earlier releases wrote are read as they were meant."""

import shutil

import pytest
import torch

from sbi_active import Campaign
from tests.campaign.storage.version_1 import FOLDER, simulator


@pytest.fixture
def folder(tmp_path):
    return shutil.copytree(FOLDER, tmp_path / "c")


def require_trials(campaign):
    history = campaign.history
    assert [t.status for t in history] == ["ok", "ok", "ok"]
    assert history[1].reason == "told in cm"
    assert history[1].x.tolist() == pytest.approx([0.62, 0.88, 1.21])
    assert history[2].x.isnan().tolist() == [False, True, False]
    assert campaign.pending.index == 3


def test_read(folder):
    campaign = Campaign.load(folder)
    require_trials(campaign)
    assert campaign.actions.units == ["m/s"]
    # What made its belief is gone: trials stay, and the belief is the prior until an
    # update computes it again.
    with pytest.warns(UserWarning, match="the belief has to be computed again"):
        belief = campaign.belief
    assert belief.mean.tolist() == pytest.approx([0.5, 0.5], abs=0.02)
    campaign.close()
    with Campaign.load(folder, simulator=simulator) as campaign:
        campaign.update()
        mean = campaign.belief.mean.tolist()
        assert mean == pytest.approx([0.2913, 0.6018], abs=0.05)


def test_gone_on_with(folder):
    with Campaign.load(folder, simulator=simulator) as campaign:
        require_trials(campaign)
        campaign.tell([0.4, 0.7, 1.0])
        belief = campaign.update()
        truth = torch.tensor([0.3, 0.6])
        assert bool(((belief.mean - truth).abs() < 0.15).all())


def test_computed_again_from_its_log(folder):
    for path in folder.glob("*.bin"):
        path.unlink()
    with Campaign.load(folder, simulator=simulator) as campaign:
        campaign.update()
        mean = campaign.belief.mean.tolist()
        assert mean == pytest.approx([0.2913, 0.6018], abs=0.05)
