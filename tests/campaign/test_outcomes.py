"""Campaigns whose trials, or simulators, give no measurement."""

import os
import time

import pytest
import torch

from sbi_active.seeding import row_normals
from sbi_active.simulation import Workers
from tests.campaign.problem import campaign, noisy
from tests.campaign.sizes import REFINEMENT


def falls_off(theta, action):
    """Falls off the table where theta times action is above .8."""
    return torch.where(theta * action > 0.8, torch.nan, noisy(theta, action))


def test_each_kind_of_outcome_counts():
    """Above .4 by one trial, below .8 by another, .6 by a measurement."""
    c = campaign(simulator=falls_off)
    told = c.tell([3.0], status="invalid", action=[2.0])
    assert told.x.isnan().all()  # numbers told along with it are no measurement
    assert float(c.update().mean) == pytest.approx(0.7, abs=0.03)
    assert c.belief.label == "refined"
    assert c.belief.diagnostics.share_invalid > 0.2
    c.tell([0.62], action=[1.0])
    mean = float(c.update().mean)
    assert mean == pytest.approx(0.62, abs=0.05)
    c.tell(status="missing", action=[1.0])
    assert float(c.update().mean) == mean


class Faulty:
    """Raises on 5 % of the rows, NaN on 10 %; with a marker it hangs and dies, too."""

    def __init__(self, marker=None):
        self.marker = marker and str(marker)

    def __call__(self, theta, action, seeds):
        kind = seeds % 100
        if self.marker:
            if bool((kind == 50).any()) and not os.path.exists(self.marker):
                open(self.marker, "w").close()
                os._exit(1)
            if bool((kind == 5).any()):
                time.sleep(60)
        if bool((kind < 5).any()):
            raise RuntimeError("licence server")
        x = theta * action + 0.1 * row_normals(seeds, 1)
        return torch.where(((kind >= 10) & (kind < 20))[:, None], torch.nan, x)


@pytest.mark.parametrize("dies", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_faulty_simulator_completes_a_campaign(tmp_path, dies):
    c = campaign(
        "asbi",
        Faulty(tmp_path / "killed" if dies else None),
        network="each round",
        refinement=REFINEMENT,
        workers=Workers(2, time_limit=0.05) if dies else Workers(),
    )
    with pytest.warns(UserWarning, match="are missing"):
        c.run(lambda action: 0.6 * action, num_rounds=2 if dies else 1)
    assert (tmp_path / "killed").exists() == dies
    for trial in c.history:
        # 5 or 6 % of the rows, and 3 times the Monte Carlo error.
        share = trial.num_missing / trial.num_simulations
        assert abs(share - 0.055) < 3 * (0.06 / trial.num_simulations) ** 0.5 + 0.01
    diagnostics = c.belief.diagnostics
    assert 0.05 < diagnostics.share_invalid < 0.15
    assert diagnostics.num_missing > 0
    assert float(c.belief.mean) == pytest.approx(0.6, abs=0.1)


def test_infinite_numbers_count_as_not_measured():
    def three(theta, action):
        return theta + 0.1 * torch.randn(len(theta), 3)

    c = campaign(simulator=three)
    with pytest.warns(UserWarning, match="2 of 3 told numbers are infinite"):
        trial = c.tell([0.6, torch.inf, -torch.inf], action=[2.0])
    assert trial.status == "ok"
    assert torch.equal(trial.x.isnan(), torch.tensor([False, True, True]))
    with pytest.warns(UserWarning, match="infinite"):
        assert c.tell([0.6, torch.inf, -torch.inf], trial=0, action=[2.0]) is trial
    assert float(c.update().mean) == pytest.approx(0.6, abs=0.1)
    assert c.history[0].surprise > 0.01
    with pytest.warns(UserWarning, match="3 of 3"):
        assert c.tell([torch.inf] * 3, action=[2.0]).status == "invalid"
