"""The workers as one value."""

import pytest
import torch

from sbi_active import CampaignOptions, RefinementOptions, simulate
from sbi_active.simulation import Workers


@pytest.mark.parametrize(
    "wrong",
    [
        {"num_workers": 0},
        {"num_workers": -2},
        {"time_limit": 0.0},
        {"time_limit": float("nan")},
        {"num_retries": -1},
    ],
)
def test_what_makes_no_sense_is_refused_where_it_is_said(wrong):
    (name,) = wrong
    with pytest.raises(ValueError, match=f"expected {name}"):
        Workers(**wrong)
    with pytest.raises(ValueError, match=f"expected {name}"):
        CampaignOptions(**wrong)


def test_a_simulation_takes_one_value_or_its_parts():
    attempts = []

    def fails_twice(theta, action):
        attempts.append(len(theta))
        if len(attempts) <= 2:
            raise RuntimeError("licence server")
        return theta + action

    rows = torch.ones(1, 1), torch.ones(1, 1)
    kept = simulate(fails_twice, *rows, seed=0, workers=Workers(num_retries=2))
    assert kept.counts["ok"] == 1
    with pytest.raises(ValueError, match="pass one of them"):
        simulate(fails_twice, *rows, seed=0, workers=Workers(2), num_retries=1)


def test_a_campaign_does_not_overwrite_workers_of_its_refinement_silently():
    own = RefinementOptions(workers=Workers(num_workers=3))
    with pytest.raises(ValueError, match="to CampaignOptions alone"):
        CampaignOptions(num_workers=2, refinement=own)
    assert CampaignOptions(num_workers=3, refinement=own).workers == own.workers
