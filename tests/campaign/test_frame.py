"""The trials of a campaign as a table."""

import numpy as np
import pandas as pd
import pytest
import torch

from sbi_active import (
    BoxActions,
    Campaign,
    CampaignOptions,
    DiscreteActions,
    GaussianNoise,
    MixedActions,
    SimulatorModel,
)
from sbi_active.campaign.display.frame import health_after, outcome_labels
from sbi_active.campaign.state import CampaignState, ModelVersion, Trial

from .storage.campaigns import MODEL, OPTIONS, PRIOR, go_on, new


@pytest.fixture(scope="module")
def campaign():
    c = new(simulator=MODEL, method="asbi")
    go_on(c, 2)
    c.ask()
    c.tell(status="missing")
    c.update()
    c.ask()
    return c


def test_a_row_is_a_trial(campaign):
    frame = campaign.to_dataframe()
    assert [*frame.index] == [0, 1, 2, 3]
    assert frame.index.name == "trial"
    assert [*frame["status"]] == ["ok", "ok", "missing", "pending"]
    assert [*frame["target"]] == ["theta"] * 4
    assert not frame.columns.duplicated().any()
    for trial in campaign.state.trials:
        row = frame.loc[trial.index]
        assert row["speed [m/s]"] == float(trial.action)
        own = [row[f"x_{i + 1}"] for i in range(4)]
        told = [np.nan] * 4 if trial.x is None else trial.x
        np.testing.assert_array_equal(np.float32(own), told)
        design = trial.design
        gain = float(design.expected_information_gain[design.index])
        assert row["expected_information"] == gain
        assert row["expected_information_error"] > 0
        assert row["seconds"] == sum(trial.seconds.values())
        assert row["num_simulations"] == trial.num_simulations
        for name in ("surprise", "information_gained", "log_score", "misfit"):
            value = getattr(trial, name)
            assert row[name] == value or (value is None and np.isnan(row[name]))
    assert frame["health"][2] == "ok"
    assert pd.isna(frame["health"][3])
    assert frame["health"][1] == campaign.health
    assert frame.attrs["units"]["speed [m/s]"] == "m/s"
    assert frame.attrs["parameter_names"] == ["a", "b"]
    assert frame["surprise"].dtype == float


def test_a_campaign_without_trials_is_an_empty_table():
    frame = new(simulator=MODEL).to_dataframe()
    assert isinstance(frame, pd.DataFrame)
    assert len(frame) == 0
    assert "speed [m/s]" in frame.columns


def test_it_is_the_same_without_the_simulator(tmp_path):
    named = SimulatorModel(
        MODEL.fn,
        noise=MODEL.noise,
        parameter_names=["a", "b"],
        channel_names=["left", "right", "up", "down"],
    )
    c = go_on(new(tmp_path / "c", simulator=named), 2)
    before = c.to_dataframe()
    c.close()
    after = Campaign.load(tmp_path / "c").to_dataframe()
    pd.testing.assert_frame_equal(after, before)
    assert "left" in after.columns
    assert after.attrs["parameter_names"] == ["a", "b"]


def test_many_numbers_are_an_array_and_names_stay_apart():
    model = SimulatorModel(
        lambda theta, action: theta[:, :1] * torch.linspace(0, 1, 30),
        noise=GaussianNoise(0.1),
    )
    actions = MixedActions(
        BoxActions(0.0, 1.0, names=["surprise"]), DiscreteActions([0, 1], names=["x"])
    )
    c = Campaign(model, PRIOR, actions, options=OPTIONS)
    x = torch.linspace(0, 1, 30)
    c.attach([0.5, 1.0], x)
    frame = c.to_dataframe()
    assert frame["action surprise"][0] == 0.5
    assert frame["x"][0] == 1.0
    np.testing.assert_array_equal(frame["outcome x"][0], x)


def test_channels_name_the_numbers():
    assert outcome_labels((1,)) == ["x"]
    assert outcome_labels((1,), ["angle"]) == ["angle"]
    assert outcome_labels((2, 3))[:2] == ["x_1_1", "x_1_2"]


def test_health_is_that_of_then():
    """Three outcomes that nothing predicted raise the alarm; a new model ends it."""
    surprises = [0.5, 1e-3, 1e-3, 1e-3, 0.5]
    versions = [0, 0, 0, 0, 1]
    state = CampaignState("asbi", 0, CampaignOptions(), processed=[0, 1, 2, 3, 4, 5])
    pairs = enumerate(zip(surprises, versions, strict=True))
    for index, (surprise, version) in pairs:
        trial = Trial(index, torch.zeros(1), torch.zeros(1), "ok")
        state.trials.append(trial)
        state.change(index, surprise=surprise, version=version)
    state.trials.append(Trial(5, torch.zeros(1), torch.zeros(1), "ok"))
    state.versions.append(ModelVersion(1, ("bias",), trials=(0, 1, 2, 3)))
    found = [health_after(state, trial) for trial in state.trials]
    assert found[0] == "ok"
    assert found[3] == "alarm"
    assert found[4] == "ok"
    assert found[5] is None  # it was not scored
