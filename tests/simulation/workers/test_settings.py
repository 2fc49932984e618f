"""The workers as one value."""

from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch

from sbi_active import CampaignOptions, simulate
from sbi_active.campaign.options import CampaignDetails
from sbi_active.campaign.storage.codec import decode, encode
from sbi_active.messages import RenamedWarning
from sbi_active.migration.described import options_from
from sbi_active.simulation import Workers

ROWS = torch.ones(1, 1), torch.ones(1, 1)


def fails(theta, action, *, times, attempts):
    attempts.append(len(theta))
    if len(attempts) <= times:
        raise RuntimeError("licence server")
    return theta + action


def test_a_simulation_takes_them_as_one_value_or_their_number():
    simulator = partial(fails, times=2, attempts=[])
    assert simulate(simulator, *ROWS, seed=0, workers=Workers(1, None, 2)).x == 2
    assert simulate(torch.add, *ROWS, seed=0, workers=1).x == 2
    assert CampaignOptions(workers=2).workers == Workers(2)  # pyright: ignore


def test_former_options_of_a_campaign_are_taken_for_one_version():
    former: Any = {"num_workers": 2, "time_limit": 9.0, "num_scored": 200}
    with pytest.warns(RenamedWarning) as noted:
        options = CampaignOptions(**former, num_samples=10)
    assert {note.message.code for note in noted} == {"SA701"}
    assert {note.filename for note in noted} == {__file__}
    assert options.workers == Workers(2, 9.0)
    assert options.details == CampaignDetails(num_scored=200)
    assert CampaignOptions.of({**former, "num_samples": 10}) == options
    assert replace(options, eliminate=False).details.num_scored == 200
    assert options.num_scored == 200
    with pytest.raises(AttributeError, match="num_rows"):
        _ = options.num_rows
    stored = {"settings": "CampaignOptions", **former, "num_samples": 10}
    assert options_from(stored) == options
    assert decode(encode(options, known={}), known={}) == options
    state = options.__getstate__()
    del state["workers"], state["details"]
    loaded = object.__new__(CampaignOptions)
    loaded.__setstate__({**state, **former})
    assert loaded == options
